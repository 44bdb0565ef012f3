"""Trained policies in a game that is not quite the one they were made for.

The policies are those of headline.py (trained here if they are not there), but for the strict
condition's, and the hand-written tree pursuit beside them; all from the same held-out starts.

    ./run python experiments/robustness.py
"""

from collections import defaultdict

from common import (
    RADIUS,
    after,
    canvas,
    counted,
    estimate,
    measure,
    only,
    options,
    put,
    read,
    save,
    train,
)
from headline import cases

from marlyap import statistics
from marlyap.certificates.loop import seen_through
from marlyap.controllers import CONTROLLERS
from marlyap.games.perturbed import Perturbed, edge_to_cut, follower_to_lose, traced
from marlyap.runs.provenance import provenance
from marlyap.storage.hashing import policy_hash
from marlyap.tasks import TASKS


KINDS = {
    "gain": (0.5, 0.75, 1.0, 1.5, 2.0),
    "noise": (0.0, 0.1, 0.2, 0.3, 0.5),
    "delay": (0, 1, 2, 3),
    "drop": (0.0, 0.1, 0.3, 0.5),
    "spread": (1.0, 1.5, 2.0),
}
MEANING = {
    "gain": "inputs this many times as strong",
    "noise": "noise on each action",
    "delay": "delay of actions (steps)",
    "drop": "share of messages lost",
    "spread": "starts this many times as far",
    "gone": "without an agent",
    "cut": "without an edge",
}
WHOSE = ("masac", "masac-lyapunov", "masac-critic")
COLUMNS = ["task", "algorithm", "seed", "perturbation", "level"]


def perturbed(game, quick):
    """(kind, level, game) of every perturbation."""
    kinds = {"gain": (0.5, 1.0)} if quick else KINDS
    for kind, levels in kinds.items():
        for level in levels:
            yield kind, level, traced(Perturbed(inner=game, **{kind: level}))
    agent, edge = follower_to_lose(game), edge_to_cut(game)
    if agent is not None and not quick:
        yield "gone", agent, traced(Perturbed(inner=game, gone=(agent,)))
    if edge is not None and not quick:
        yield "cut", f"{edge[0]}-{edge[1]}", traced(Perturbed(inner=game, cut=(edge,)))


def teams(args):
    """(name, seed, controller) of all that is to be disturbed."""
    chosen = [case for case in only(cases(args), args) if case.label in WHOSE]
    if args.quick:
        chosen = [case.quick() for case in chosen[:1]]
    for case in chosen:
        runs = [case.run(args.runs / "headline", seed) for seed in args.seeds]
        train([run for run in runs if not (run.directory / "policy").is_dir()], args.quick)
        for run in runs:
            yield case.label, run.seed, run.controller()
    if not args.quick:
        name = "tree-pursuit"
        yield name, "", CONTROLLERS[name](TASKS[args.task])


def table(args):
    """Success under every perturbation, one row each."""
    game, name = TASKS[args.task], f"robustness-{args.task}"
    there = {tuple(row[c] for c in COLUMNS) for row in read(args, name)}
    for algorithm, seed, controller in teams(args):
        for kind, level, other in perturbed(game, args.quick):
            key = (args.task, algorithm, seed, kind, level)
            if tuple(map(str, key)) not in there:
                found, _ = measure(other, seen_through(other, controller), args.episodes)
                about = dict(zip(COLUMNS, key, strict=True)) | {"radius": RADIUS}
                made = after(found) | {"policy": policy_hash(controller)} | provenance()
                put(args, name, COLUMNS, [about | counted(found.final <= RADIUS) | made])


def beside(kind, algorithm, points, algorithms):
    """How probably a policy of this algorithm succeeds more often than one of those before it."""
    for other in list(algorithms)[: list(algorithms).index(algorithm)]:
        for level, rows in algorithms[other].items():
            a, b = points[level].seeds, estimate(rows).seeds
            if len(a) == len(b) > 1:
                p, (low, high) = statistics.probability_of_improvement(a, b)
                said = f"P({algorithm} above {other}) = {p:.2f} [{low:.2f}, {high:.2f}]"
                print(f"{kind} {level:<5} {said}")


def curves(args):
    """A panel for each kind of perturbation, a line for each algorithm."""
    found = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in read(args, f"robustness-{args.task}"):
        found[row["perturbation"]][row["algorithm"]][row["level"]].append(row)
    figure, panels = canvas(len(found), 2.2, 2.8)
    for axes, (kind, algorithms) in zip(panels, found.items(), strict=True):
        for place, (algorithm, levels) in enumerate(algorithms.items()):
            points = {level: estimate(rows) for level, rows in levels.items()}
            for level, e in points.items():
                interval = f"{e.mean:.3f} [{e.low:.3f}, {e.high:.3f}]"
                print(f"{kind} {level:<5} {algorithm:<16} {interval}, {len(e.seeds)} policies")
            beside(kind, algorithm, points, algorithms)
            x = [float(level) if kind in KINDS else place for level in points]
            (line,) = axes.plot(x, [e.mean for e in points.values()], ".-", label=algorithm)
            ends = [[e.low for e in points.values()], [e.high for e in points.values()]]
            axes.vlines(x, *ends, color=line.get_color(), alpha=0.5)
        one = "" if kind in KINDS else f" ({', '.join(levels)})"
        axes.set(ylim=(-0.03, 1.03), title=MEANING[kind] + one)
        axes.set_xticks(x if kind in KINDS else [])
        axes.margins(x=0.05 if kind in KINDS else 0.2)
    panels[0].set_ylabel(f"success within {RADIUS} m", fontsize=8)
    panels[0].legend(frameon=False, fontsize=7)
    save(figure, args.results / f"robustness-{args.task}.png")


if __name__ == "__main__":
    args = options(__doc__, seeds=range(10))
    args.results.mkdir(parents=True, exist_ok=True)
    if args.quick:
        args.seeds, args.episodes = args.seeds[:2], 20
    if not args.draw:
        table(args)
    curves(args)
