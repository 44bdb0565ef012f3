"""How many agents, on which graph, with how many leaders.

./run python experiments/sizes.py
./run python experiments/sizes.py --only path
"""

from dataclasses import replace

from common import Case, experiment, options, schedule

from marlyap.algorithms import ALGORITHMS
from marlyap.tasks import TASKS


COMPARED = ("masac", "masac-lyapunov")
SIZES = (
    *[(n, "complete", 1) for n in range(2, 9)],
    *[(n, "path", 1) for n in (3, 4, 5)],
    *[(5, graph, 1) for graph in ("ring", "star")],
    *[(5, "path", leaders) for leaders in (2, 5)],
)  # agents, graph, leaders


def cases(args):
    for name in COMPARED:
        for agents, graph, leaders in SIZES:
            team = {"agents": agents, "graph": graph, "leaders": tuple(range(leaders))}
            about = {"task": args.task, "algorithm": name} | team
            about |= {"leaders": leaders, "budget": args.steps}
            game = replace(TASKS[args.task], **team)
            yield Case(about, game, ALGORITHMS[name], schedule(args))


if __name__ == "__main__":
    args = options(__doc__, seeds=range(3))
    experiment("sizes", list(cases(args)), args)
