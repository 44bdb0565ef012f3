"""Analytic policy gradients with and without the decrease condition, and tree pursuit beside them.

    ./run python experiments/model_based.py --task rendezvous-path5
    ./run python experiments/model_based.py --task rendezvous-hard
    ./run python experiments/model_based.py --quick    seconds, to see that it works
    ./run python experiments/model_based.py --draw     the figure again, from the tables alone

The learnt part sees what MASAC sees; only the trainer differentiates the equations of motion.
"""

from dataclasses import replace

from common import (
    RADIUS,
    Case,
    after,
    counted,
    experiment,
    options,
    read,
)

from marlyap.controllers import CONTROLLERS
from marlyap.learning.algorithms import ALGORITHMS
from marlyap.learning.trainer import schedule_for
from marlyap.simulation.evaluation import evaluate
from marlyap.tasks import TASKS


COMPARED = ("apg", "apg-lyapunov")
STARTS = 2_000


def cases(args):
    for name in COMPARED:
        algorithm = ALGORITHMS[name]
        plan = replace(schedule_for(algorithm), steps=args.steps)
        about = {"task": args.task, "algorithm": name, "budget": args.steps}
        yield Case(about, TASKS[args.task], algorithm, plan)


if __name__ == "__main__":
    args = options(__doc__, task="rendezvous-path5", steps=7_680_000, episodes=STARTS)
    experiment("model-based", list(cases(args)), args, plain=COMPARED[0])
    if not (args.quick or args.draw or args.list):
        game = TASKS[args.task]
        by_hand = evaluate(game, CONTROLLERS["tree-pursuit"](game), args.episodes)
        row = counted(by_hand.final <= RADIUS)
        rows = [r for r in read(args, f"model-based-{args.task}-success")]
        rates = [float(r["success_rate"]) for r in rows if float(r["radius"]) == RADIUS]
        print(
            f"tree-pursuit {row}, {after(by_hand)}; "
            f"learnt, worst seed {min(rates):.4f} of {len(rates)}"
        )
