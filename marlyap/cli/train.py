"""`marlyap train`: new runs, or runs that are resumed."""

from argparse import ArgumentParser, Namespace
from dataclasses import replace

from marlyap.cli.common import Overrides, Result, say
from marlyap.cli.environment import prepare
from marlyap.cli.options import (
    NAMED,
    OVERRIDES,
    SHIELD,
    TRACKERS,
    Once,
    number,
    place,
)
from marlyap.errors import UserError
from marlyap.runs.job import Launch


SUMMARY = "train a team, one run for each seed"
EPILOG = OVERRIDES
EXAMPLES = """
  marlyap train rendezvous masac-lyapunov
  marlyap train formation masac --seeds 0 1 2 --steps 100000 --task.agents 5
  marlyap train rendezvous masac --shield --shield.action residual
  marlyap train platoon.py:Platoon apg
  marlyap train --resume runs/rendezvous/masac-lyapunov/seed0
  marlyap train --resume runs/rendezvous/masac/seed0 --steps 500000
  marlyap train rendezvous-rest masac --from runs/rendezvous/masac/seed0
  marlyap train pettingzoo:mpe2.simple_spread_v3 masac --task.workers 2"""


def options(p: ArgumentParser) -> None:
    p.add_argument("task", nargs="?", metavar="TASK", help=NAMED)
    p.add_argument("algorithm", nargs="?", metavar="ALGORITHM", help=NAMED)
    p.add_argument("--seeds", nargs="+", action=Once, help="training seeds (default 0)")
    p.add_argument(
        "--steps", type=number, help="environment steps of each seed; with --resume a longer run"
    )
    p.add_argument(
        "--out", type=place, default=None, help="directory (default runs/TASK/ALGORITHM)"
    )
    p.add_argument("--preset", help="tuned (default) or paper")
    p.add_argument("--force", action="store_true", help="overwrite runs that are there")
    p.add_argument("--resume", type=place, nargs="+", metavar="RUN", help="resume these runs")
    p.add_argument(
        "--from", type=place, dest="origin", metavar="RUN", help="begin with this run's networks"
    )
    own = "where a resumed run's is your own code"
    p.add_argument("--task", dest="own_task", help=f"the task, {own}")
    p.add_argument("--algorithm", dest="own_algorithm", help=f"the algorithm, {own}")
    p.add_argument("--shield", action="store_true", help=SHIELD)
    p.add_argument("--parallel", default="auto", help="seeds: auto, process (one a core) or vmap")
    p.add_argument("--device", default=None, help="cpu or gpu (default: what JAX finds)")
    p.add_argument(
        "--on-nan", default="stop", help="when numbers diverge: stop (default) or rollback"
    )
    p.add_argument("--log", nargs="+", default=[], help=TRACKERS)


def run(args: Namespace, overrides: Overrides) -> Result:
    """Make the runs, or open those to be resumed, and train them."""
    how = Launch(args.parallel, args.on_nan, args.device, log=tuple(args.log))
    prepare(args.device, training=True)
    from marlyap.cli import training

    if args.resume:
        given = {"--seeds": args.seeds, "--preset": args.preset, "--from": args.origin}
        given |= {"--out": args.out, "--force": args.force or None}
        given |= {"--shield": args.shield or None}
        given |= {f"--{path}": value for path, value in overrides.items()}
        for option in [k for k, v in given.items() if v is not None]:
            raise UserError(f"{option}: a resumed run keeps its settings; leave it out.")
        task, algorithm = args.task or args.own_task, args.algorithm or args.own_algorithm
        runs = training.reopened(args.resume, task, algorithm)
        runs = [run.lengthened(args.steps) for run in runs] if args.steps is not None else runs
        how = replace(how, task=task, algorithm=algorithm)
    else:
        if args.own_task or args.own_algorithm:
            option = "--task" if args.own_task else "--algorithm"
            raise UserError(f"{option}: it is for --resume; a new run is train TASK ALGORITHM.")
        if not args.task or not args.algorithm:
            raise UserError("train: name a task and an algorithm, as in train rendezvous masac.")
        asked = training.Asked(args.task, args.algorithm, args.preset, args.steps, args.shield)
        runs = training.create(asked, overrides, args.seeds or ["0"], args.out, args.force)
        if args.origin is not None:
            training.start_from(runs, args.origin, args.task, args.algorithm)
        how = replace(how, task=args.task, algorithm=args.algorithm)
    code = training.trained(runs, how, new=not args.resume)
    state = [
        {"run": str(r.directory), "seed": r.seed, "steps": r.steps_done, "finished": r.finished}
        for r in runs
    ]
    say(f"{'Done' if code == 0 else 'Stopped'}: {', '.join(str(r.directory) for r in runs)}")
    return {"runs": state}, code
