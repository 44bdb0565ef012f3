"""How many agents, on which graph, with how many leaders.

./run python experiments/sizes.py
./run python experiments/sizes.py --only path
"""

from dataclasses import replace

from common import Case, experiment, forest, measured, options, schedule

from marlyap.learning.algorithms import ALGORITHMS
from marlyap.statistics import iqm, mcnemar
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


def drawn(args, name):
    """The figure, and in how many games the Lyapunov term is the better."""
    forest(args, name)
    plain, term = COMPARED
    for measure, tables in measured(args, name).items():
        rates = {c: iqm([float(r["success_rate"]) for r in rows]) for c, rows in tables.items()}
        others = {c: c.replace(plain, term, 1) for c in rates if c.split()[0] == plain}
        pairs = [(rates[a], rates[b]) for a, b in others.items() if b in rates]
        if pairs:
            test = mcnemar([b > a for a, b in pairs], [b < a for a, b in pairs])
            said = f"better in {test.only_a}, worse in {test.only_b} of {len(pairs)} games"
            print(f"{term}: {said} (sign test p = {test.p_value:.4f}), {measure}")


if __name__ == "__main__":
    args = options(__doc__, seeds=range(3))
    experiment("sizes", list(cases(args)), args, drawn)
