"""Every algorithm that learns from transitions, at one budget: references, controls, the paper's.

./run python experiments/references.py
./run python experiments/references.py --task rendezvous-path5 --steps 409600
"""

from common import Case, experiment, options, schedule

from marlyap.learning.algorithms import ALGORITHMS
from marlyap.learning.off_policy import AbstractOffPolicy
from marlyap.tasks import TASKS


def cases(args):
    for name, algorithm in ALGORITHMS.items():
        if not isinstance(algorithm, AbstractOffPolicy):  # model_based.py has those
            continue
        about = {"task": args.task, "algorithm": name, "budget": args.steps}
        yield Case(about, TASKS[args.task], algorithm, schedule(args))


if __name__ == "__main__":
    args = options(__doc__)
    experiment("references", list(cases(args)), args)
