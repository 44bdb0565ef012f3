"""`marlyap demo`: train, evaluate and report the main task."""

import sys
import time
from argparse import ArgumentParser, Namespace
from pathlib import Path

from marlyap.cli import report
from marlyap.cli.common import Overrides, Result, say
from marlyap.cli.environment import prepare
from marlyap.cli.options import Once, number, place
from marlyap.errors import UserError
from marlyap.runs.job import Launch


SUMMARY = "train, evaluate and report the main task, from nothing to a film"
EPILOG = ""
EXAMPLES = """
  marlyap demo
  marlyap demo --seeds 0 1 2 --out runs/three"""


def options(p: ArgumentParser) -> None:
    p.add_argument("--out", type=place, default=Path("runs/demo"), help="directory of the runs")
    p.add_argument(
        "--seeds", nargs="+", action=Once, default=["0"], help="training seeds (default 0)"
    )
    p.add_argument("--steps", type=number, default=None, help="environment steps of each")
    p.add_argument("--again", action="store_true", help="train anew what is there already")


STEPS = 204_800


def run(args: Namespace, overrides: Overrides) -> Result:
    """Train, evaluate and report the main task; what is trained already is kept."""
    prepare(training=True)
    from marlyap.cli import training
    from marlyap.runs import groups
    from marlyap.runs.run import Run

    start = time.monotonic()
    places = [args.out / f"seed{s}" for s in training.seeds(args.seeds)]
    for each in places:
        Run.outside(each)
    there = [d for d in places if (d / "run.json").is_file()]
    again = bool(there) and not args.again
    if again:
        missing = [d for d in places if d not in there]
        if missing:
            raise UserError(
                f"seeds: {missing[0]} is not there beside {there[0]}; train all anew by --again."
            )
        runs = [Run.open(d) for d in places]
        say(f"{args.out} holds these runs, which are used again; to train anew: demo --again")
    else:
        steps = STEPS if args.steps is None else args.steps
        asked = training.Asked("rendezvous", "masac-lyapunov", steps=steps)
        runs = training.create(asked, overrides, args.seeds, args.out, args.again)
    if code := training.trained(runs, Launch(), new=not again):
        return None, code
    result = report.write(runs, [r.game for r in runs], args.out / "report.html", 500, 0)
    rests = f"; the team {result['rests']}" if result["rests"] else ""
    text = f"{result['successes']} of {result['episodes']} held-out starts of seed 0 succeeded: "
    text += f"{groups.words(result)}{rests}. It took {time.monotonic() - start:.0f} s."
    print(text, file=sys.stderr if args.json else sys.stdout)
    return result | {"seconds": time.monotonic() - start}, 0
