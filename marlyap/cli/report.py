"""`marlyap report`: one page about runs."""

import dataclasses
import shlex
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from marlyap.cli.common import Overrides, Result, say, starts_of
from marlyap.cli.environment import prepare
from marlyap.cli.options import SEED, SUBJECT, measured_on, number, place, seed_of_starts
from marlyap.errors import UserError


SUMMARY = "write one HTML file (and PNGs) about runs"
EPILOG = SUBJECT
EXAMPLES = """
  marlyap report runs/demo
  marlyap report runs/demo/seed0 --task rendezvous-late --out late.html"""


def options(p: ArgumentParser) -> None:
    p.add_argument("runs", type=place, nargs="+", metavar="RUN", help="run directories")
    where = "HTML file (default: in the run; of several runs, ./report.html)"
    p.add_argument("--out", type=place, default=None, help=where)
    p.add_argument("--episodes", type=number, default=500, help="held-out starts (default 500)")
    p.add_argument("--seed", type=seed_of_starts, default=0, help=SEED)
    beside = "the hand-written controller to film beside the runs, or none (default: the cheapest)"
    p.add_argument("--beside", metavar="CONTROLLER", default="", help=beside)
    measured_on(p, "the task to measure on (default: that of each run)")


def run(args: Namespace, overrides: Overrides) -> Result:
    """Write the HTML page and the pictures."""
    prepare()
    from marlyap.runs.hosted import outside
    from marlyap.runs.run import expand
    from marlyap.runs.subject import subject

    if outside(args.runs):
        from marlyap.cli import hosted

        return hosted.report(args, overrides)
    opened = [subject(d, args.task, args.algorithm, overrides) for d in expand(args.runs)]
    runs, games = [run for run, _ in opened], [game for _, game in opened]
    default = runs[0].directory / "report.html" if len(runs) == 1 else Path("report.html")
    out, starts = args.out or default, starts_of(args.seed)
    return write(runs, games, out, args.episodes, starts, args.task or "", args.beside), 0


def write(
    runs: Sequence[Any],
    games: Sequence[Any],
    out: Path,
    episodes: int,
    starts: int,
    task: str = "",
    beside: str = "",
) -> dict[str, Any]:
    """The page about each run on its game, and its pictures; returns its figures.

    `task` is what the user called the games, where they are not the runs' own; `beside` the
    controller that is filmed beside them.
    """
    from marlyap.report.contents import gather
    from marlyap.report.page import html
    from marlyap.report.png import learning_curves_png, trajectories_png
    from marlyap.storage import store

    if out.exists() and not is_report(out):
        raise UserError(f"out: {out} exists and is not a report of marlyap; choose another file.")
    command = shlex.join(["marlyap", *sys.argv[1:]])
    begin = say if sys.stderr.isatty() else lambda text: None
    page = gather(list(runs), episodes, starts, command, list(games), task, beside, begin)
    store.write_text_atomic(out, html(page))
    pictures = [out.with_name(f"{out.stem}-{name}") for name in ("starts.png", "learning.png")]
    trajectories_png(page.films, pictures[0])
    learning_curves_png(page.runs, pictures[1])
    say(f"Report: {out.resolve()}")
    for note in page.notes:
        say(note)
    told = [_printed(group) for group in page.groups]
    result: dict[str, Any] = {"start_seed": page.starts, "groups": told}
    if len(told) == 1:
        result = {k: v for k, v in told[0].items() if k != "text"} | result
    return result | {"report": str(out), "pictures": [str(p) for p in pictures]}


def _printed(group: Any) -> dict[str, Any]:
    """The figures of a group for --json, without what only charts show."""
    told = dataclasses.asdict(dataclasses.replace(group, finals=(), along=None))
    return {k: v for k, v in told.items() if k not in ("finals", "along")}


def is_report(path: Path) -> bool:
    """Whether a file was written by `report`, and may be replaced by it."""
    from marlyap.report.data import MARK

    try:
        with path.open("rb") as file:
            return MARK.encode() in file.read(10_000_000)
    except OSError as error:
        raise UserError(f"out: {path} cannot be read ({error.strerror}).") from None
