"""MASAC with and without the Lyapunov term, many seeds: learning curves, success over 500 starts.

Two more cases: the condition made five times as strict, so that its learnt weight fades more
slowly; and the control, the same network of the next T costs, with the policy asked to make
it small and not to make it fall.

    ./run python experiments/headline.py            ten seeds of each
    ./run python experiments/headline.py --steps 51200    a quarter of the budget
    ./run python experiments/headline.py --steps 409600 --only masac-lyapunov    twice the budget
    ./run python experiments/headline.py --quick    seconds, to see that it works
    ./run python experiments/headline.py --draw     the figures again, from the tables alone

Runs are kept in --runs and resumed when the script is started again.
"""

from collections import defaultdict

from common import Case, at_budget, experiment, forest, options, read, schedule

from marlyap.learning.algorithms import ALGORITHMS, MASAC
from marlyap.learning.constraints import Lyapunov
from marlyap.report.data import LogRow, Trained
from marlyap.report.png import learning_curves_png
from marlyap.tasks import TASKS


COMPARED = ("masac", "masac-lyapunov")
OTHERS = {
    "masac-critic": MASAC(constraint=Lyapunov(reading="critic", weight=1.0)),
    "masac-lyapunov-strict": MASAC(constraint=Lyapunov(decrease=0.5)),
}


def cases(args):
    for name in (*COMPARED, *OTHERS):
        about = {"task": args.task, "algorithm": name}
        yield Case(about, TASKS[args.task], (ALGORITHMS | OTHERS)[name], schedule(args))


def curves(args, name):
    """The paper's two figures."""
    forest(args, name)
    points = defaultdict(list)
    names = [*COMPARED, *OTHERS]  # each has its colour, whatever was run first
    for row in read(args, f"{name}-curves"):
        if row["success"]:
            points[row["algorithm"], row["seed"]].append(row)
    number = lambda row: [float(row[k]) for k in ("steps", "success", "return")]
    runs = [
        Trained(
            label=f"{algorithm} seed {seed}",
            group=algorithm,
            seed=int(seed),
            log=tuple(LogRow(*number(row)) for row in rows),
        )
        for (algorithm, seed), rows in sorted(points.items(), key=lambda p: names.index(p[0][0]))
    ]
    learning_curves_png(runs, args.results / f"{name}-curves.png")


if __name__ == "__main__":
    args = options(__doc__, seeds=range(10))
    experiment(at_budget("headline", args), list(cases(args)), args, curves, COMPARED[0])
