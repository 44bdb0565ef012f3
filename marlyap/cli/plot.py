"""`marlyap plot`: one figure of runs for a paper."""

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from pathlib import Path

from marlyap.cli.common import Overrides, Result, say, starts_of
from marlyap.cli.environment import prepare
from marlyap.cli.options import SEED, number, place, seed_of_starts
from marlyap.errors import UserError


SUMMARY = "draw one figure of runs for a paper, as PDF, SVG, EPS or PNG"
EPILOG = """
learning and return are drawn from the logs at once; radius, distance and cost evaluate first. In
Python `marlyap.plot(runs, kind)` returns the Matplotlib axes.
"""
EXAMPLES = """
  marlyap plot runs/mine --out fig.pdf
  marlyap plot runs/mine runs/other --what radius --width 7 --out radius.pdf
  marlyap plot runs/mine --band interval --out learning.svg"""
WHAT = ("learning", "return", "radius", "distance", "cost")


def inches(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ArgumentTypeError(f"'{text}' is not a number of inches") from None


def options(p: ArgumentParser) -> None:
    p.add_argument("runs", type=place, nargs="+", metavar="RUN", help="run directories")
    p.add_argument("--out", type=place, default=Path("figure.pdf"), help="file (figure.pdf)")
    p.add_argument("--what", choices=WHAT, default="learning", help="which chart (learning)")
    band = "over seeds: their range, or the 95 %% interval for the expectation (range)"
    p.add_argument("--band", choices=("range", "interval"), default="range", help=band)
    p.add_argument("--width", type=inches, default=3.5, help="inches (3.5, a column)")
    p.add_argument("--episodes", type=number, default=500, help="held-out starts (default 500)")
    p.add_argument("--seed", type=seed_of_starts, default=0, help=SEED)


def run(args: Namespace, overrides: Overrides) -> Result:
    """Draw the figure."""
    if overrides:
        raise UserError(f"--{next(iter(overrides))}: plot draws runs as they were trained.")
    prepare()
    from marlyap.report.paper import plot, save

    said = {"episodes": args.episodes, "seed": starts_of(args.seed), "width": args.width}
    axes = plot(args.runs, args.what, band=args.band, **said)
    save(axes.get_figure(), args.out)
    say(f"Figure: {args.out.resolve()}")
    return {"figure": str(args.out), "what": args.what}, 0
