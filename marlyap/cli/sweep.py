"""`marlyap sweep`: many runs of one plan, made, run, watched and tabled."""

import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from marlyap.cli.common import Overrides, Result, say
from marlyap.cli.environment import prepare
from marlyap.cli.options import TRACKERS, Once, number, place
from marlyap.errors import UserError
from marlyap.runs.job import Launch


SUMMARY = "train many runs of one plan: grids, lists and searches, here, on Ray or on Slurm"
EPILOG = """
WORDS are a TOML file, or TASK and ALGORITHM with --grid: the sweep is made and run. Or a verb:

  make FILE | make TASK ALGORITHM   check every cell and write the sweep down; train nothing
  run DIR                           train what is not trained yet; Ctrl-C saves, run resumes
  status DIR, watch DIR             how the jobs stand, once or until all are over
  table DIR                         table.csv and curves.csv, and the table on the terminal

Each job is a run folder, DIR/CELL/seedN, which evaluate, report, certify and watch take as any
other. The folder is all there is: a sweep may be killed at any time, and run goes on.
"""
EXAMPLES = """
  marlyap sweep sweep.toml
  marlyap sweep rendezvous masac --grid algorithm.rate_Q=1e-3,3e-3 --seeds 0 1 2 --out sweeps/q
  marlyap sweep run sweeps/q --on slurm --engine partition=short timeout_min=30
  marlyap sweep watch sweeps/q"""
VERBS = ("make", "run", "status", "watch", "table")


def options(p: ArgumentParser) -> None:
    p.add_argument("words", nargs="+", metavar="WORDS", help="see below")
    p.add_argument(
        "--grid", nargs="+", action="extend", default=[], metavar="FIELD=A,B", help="values to try"
    )
    p.add_argument("--seeds", nargs="+", action=Once, help="training seeds (default 0)")
    p.add_argument("--evaluate", type=number, help="held-out starts of every finished job")
    p.add_argument("--preset", help="tuned (default) or paper")
    p.add_argument("--out", type=place, help="directory (default sweeps/NAME)")
    p.add_argument("--on", default="local", help="local (default), ray or slurm")
    p.add_argument("--workers", type=number, help="jobs at once (default: one a core)")
    p.add_argument(
        "--engine", nargs="+", default=[], metavar="KEY=VALUE", help="options of Ray or Slurm"
    )
    p.add_argument("--retry", action="store_true", help="try failed jobs again")
    p.add_argument("--device", default=None, help="cpu or gpu (default: what JAX finds)")
    p.add_argument(
        "--parallel", default="process", help="process (one a core) or vmap (one program)"
    )
    p.add_argument(
        "--on-nan", default="stop", help="when numbers diverge: stop (default) or rollback"
    )
    p.add_argument("--log", nargs="+", default=[], help=TRACKERS)


def run(args: Namespace, overrides: Overrides) -> Result:
    """Do what the first word says."""
    verb, *rest = args.words if args.words[0] in VERBS else ("all", *args.words)
    how = Launch(args.parallel, args.on_nan, args.device, log=tuple(args.log))
    if verb in ("all", "make"):
        sweep = _made(args, rest, overrides)
    else:
        _refuse(args, overrides)
        if len(rest) != 1:
            raise UserError(f"sweep: {verb} takes the directory of one sweep.")
        from marlyap.sweeps.folder import Sweep

        sweep = Sweep.open(rest[0])
    if verb == "make":
        jobs = len(sweep.jobs)
        say(
            f"Made: {sweep.directory}, {jobs} jobs. Train with: marlyap sweep run {sweep.directory}"
        )
        return {"sweep": str(sweep.directory), "jobs": jobs}, 0
    if verb in ("status", "watch", "table"):
        return _told(sweep, verb)
    return _run(sweep, args, how)


def _made(args: Namespace, words: list[str], overrides: Overrides) -> Any:
    """The sweep of a TOML file, or of task and algorithm."""
    from marlyap.sweeps import plan as plans

    if len(words) == 1 and (words[0].endswith(".toml") or Path(words[0]).is_file()):
        _refuse(args, overrides)
        plan, name = plans.of_toml(Path(words[0])), Path(words[0]).stem
    elif len(words) == 2:
        task, algorithm = words
        seeds = args.seeds or ["0"]
        plan = plans.of_words(
            task, algorithm, args.grid, overrides, seeds, args.evaluate or 0, args.preset
        )
        short = [Path(w.rpartition(":")[0] or w).stem for w in words]
        name = "-".join(short)
    else:
        raise UserError(
            "sweep: name a TOML file, a task and an algorithm, or a verb and a directory."
        )
    prepare(args.device)
    from marlyap.sweeps.go import make_sweep

    return make_sweep(plan, args.out or Path("sweeps") / name)


def _refuse(args: Namespace, overrides: Overrides) -> None:
    """Raise UserError for an option that a plan which is written down would ignore."""
    given = {"--grid": args.grid, "--seeds": args.seeds, "--preset": args.preset}
    given |= {"--evaluate": args.evaluate} | {f"--{path}": 1 for path in overrides}
    for option in [name for name, value in given.items() if value]:
        raise UserError(f"{option}: the plan says that; change it there, or leave this out.")


def _run(sweep: Any, args: Namespace, how: Launch) -> Result:
    """Train, and draw how it goes; the exit code is 1 where a job failed."""
    from marlyap.runs.stop import Stop
    from marlyap.sweeps import go, live

    options = {}
    for word in args.engine:
        key, equals, value = word.partition("=")
        if not equals:
            raise UserError(f"engine: '{word}' is not KEY=VALUE.")
        options[key] = value
    if sweep.plan.search is not None:
        prepare(args.device)
    tell = lambda: say("\nStopping at the next checkpoint; once more to stop at once.")
    with Stop(tell) as stop:
        seen = go.run_sweep(sweep, args.on, args.workers, how, options, stop, args.retry)
        statuses = live.show(sweep.plan, seen)
    for path in sweep.write(statuses):
        say(str(path))
    if stop():
        say(f"Saved. Resume with: marlyap sweep run {sweep.directory}")
    failed = any(s.state == "failed" for s in statuses)
    return _result(sweep, statuses), stop.code or int(failed)


def _told(sweep: Any, verb: str) -> Result:
    """What the folder says, without JAX."""
    from rich.console import Console

    from marlyap.sweeps import live

    if verb == "watch":
        statuses = live.show(sweep.plan, _looks(sweep))
    else:
        statuses = sweep.statuses()
        Console(stderr=True).print(
            live.drawn(sweep.plan, statuses, 12 * (verb == "status") or None)
        )
    if verb == "table":
        for path in sweep.write(statuses):
            say(str(path))
    return _result(sweep, statuses), 0


def _looks(sweep: Any) -> Iterator[Any]:
    """What the folder says once a second, until every job is over."""
    statuses: list[Any] = []
    while True:
        sweep = type(sweep).open(sweep.directory)  # a search adds cells
        statuses = sweep.statuses(statuses)
        yield statuses
        if all(s.state in ("finished", "failed", "dropped") for s in statuses):
            return
        time.sleep(1.0)


def _result(sweep: Any, statuses: Any) -> dict[str, Any]:
    from marlyap.sweeps.table import rows

    return {"sweep": str(sweep.directory), "jobs": rows(sweep.plan, statuses)}
