"""`marlyap evaluate`: runs and controllers on the same held-out starts."""

import json
from argparse import ArgumentParser, Namespace

from marlyap.cli.common import Overrides, Result, say, starts_of
from marlyap.cli.environment import prepare
from marlyap.cli.options import OWN_TASK, SEED, SUBJECT, measured_on, number, place, seed_of_starts
from marlyap.errors import UserError


SUMMARY = "measure runs or hand-written controllers on held-out starts"
EPILOG = SUBJECT
EXAMPLES = """
  marlyap evaluate runs/demo
  marlyap evaluate runs/demo/seed0 --task rendezvous-late
  marlyap evaluate runs/demo --starts-scale 3 --push 5
  marlyap evaluate runs/demo/seed0 --shield --shield.sigma 0
  marlyap evaluate runs/demo/seed0 tree-pursuit --task rendezvous --task.size 2"""


def options(p: ArgumentParser) -> None:
    p.add_argument("runs", nargs="+", metavar="RUN", help="run directories or controller names")
    measured_on(p, OWN_TASK)
    p.add_argument("--episodes", type=number, default=500, help="held-out starts (default 500)")
    p.add_argument("--seed", type=seed_of_starts, default=0, help=SEED)
    p.add_argument("--confidence", type=float, default=0.95, help="of the intervals")
    p.add_argument("--out", type=place, default=None, help="file for the figures, as JSON")
    p.add_argument("--horizon", type=number, default=None, help="steps of an episode")
    p.add_argument("--starts-scale", type=float, default=1.0, help="how many times as far they are")
    push = "every horizon all rates of each agent jump by + or - this much (SI units)"
    p.add_argument("--push", type=float, default=0.0, help=push)
    jump = "every horizon the target moves anywhere in [-JUMP, JUMP]^2 (m)"
    p.add_argument("--jump", type=float, default=0.0, help=jump)


def run(args: Namespace, overrides: Overrides) -> Result:
    """Every run and controller on the same held-out starts."""
    if not 0 < args.confidence < 1:
        raise UserError(f"confidence: {args.confidence} must lie between 0 and 1.")
    if args.out is not None and not args.out.parent.is_dir():
        raise UserError(f"out: there is no directory {args.out.parent}.")
    prepare()
    from marlyap.cli import figures
    from marlyap.runs import groups
    from marlyap.runs.hosted import outside
    from marlyap.runs.subject import refuse_all_but_task
    from marlyap.storage import store

    if outside(args.runs):
        from marlyap.cli import hosted

        return hosted.evaluate(args, overrides)
    starts = starts_of(args.seed)
    refuse_all_but_task(overrides)
    harder = figures.Harder(args.horizon, args.starts_scale, args.push, args.jump)
    named = figures.Named(args.runs, args.task, args.algorithm, overrides, args.shield, harder)
    found, notes = figures.measured(named, args.episodes, starts, args.confidence)
    result = {
        "start_seed": starts,
        "runs": [figures.row_of(m, args.confidence) for m in found],
        "groups": [
            {"group": name} | groups.summary(members, args.confidence)
            for name, members in groups.grouped(found).items()
        ],
        "comparisons": groups.comparisons(found),
    }
    if len(result["groups"]) == 1:  # over several configurations there is nothing to say
        result = {k: v for k, v in result["groups"][0].items() if k != "group"} | result
    if args.out is not None:
        store.write_text_atomic(args.out, json.dumps(result, indent=1) + "\n")
    if not args.json:
        figures.show(result, found, harder.words())
    for note in notes:
        say(note)
    return result, 0
