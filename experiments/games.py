"""What learners reach on the games of the bench, beside the reference that is published for each.

    ./run python experiments/games.py                           hours; resumes where it stopped
    ./run python experiments/games.py --games consensus --learners apg --seeds 0 1
    ./run python experiments/games.py --table                   the table again, without training
    ./run python experiments/games.py --quick                   seconds, to see that it works

Leaves in --results

    games.csv          one row for each game, learner and training seed: cost, success and failures
                       of the policy and of the reference from the same held-out starts, at the
                       training horizon and at ten times it
    games-verdict.csv  one row for each game and learner: the difference in cost to the reference,
                       mean over seeds with a 95 % interval (Student's t over training seeds), and
                       whether the learner is better, equal or worse

The starts of `marlyap evaluate` (seed 0) are used neither for training nor for choosing a policy.
All seeds of a learner are trained in one vmapped program.
"""

import argparse
import csv
import io
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from marlyap.controllers import CONTROLLERS
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.algorithms import APG, MASAC
from marlyap.learning.constraints import Lyapunov
from marlyap.learning.schedule import Schedule
from marlyap.learning.trainer import Trainer
from marlyap.runs.launch import Launch, launch
from marlyap.runs.progress import show
from marlyap.runs.provenance import provenance
from marlyap.runs.run import Run
from marlyap.runs.stop import Stop
from marlyap.simulation.evaluation import Evaluation, evaluate
from marlyap.storage.hashing import policy_hash
from marlyap.storage.store import write_text_atomic
from marlyap.tasks import TASKS


# What the literature uses on each game, or the law that stands for it.
REFERENCES = {
    "consensus": "laplacian",
    "voltage13": "dead-band",
    "voltage33": "dead-band",
    "formation": "tree-pursuit",
    "formation-di": "formation-consensus",
    "frequency": "droop",
    "platoon-catchup": "platoon-ovm",
    "platoon-slowdown": "platoon-ovm",
    "quads-planar": "quad-chain",
    "quads-space": "quad-chain-space",
    "gnn-flock": "alignment",
    "flock": "olfati-saber",
}


@dataclass(frozen=True)
class Budget:
    """How much a learner is given on one game."""

    updates: int  # of the analytic gradient
    episodes: int  # in each of them
    steps: int = 102_400  # environment steps of the learners without a model


# Chosen on training seed 100, by the cost of the policy from starts of evaluation seed 7.
USUAL = Budget(600, 64)
BUDGETS = {
    "consensus": Budget(1_500, 64),
    "frequency": Budget(300, 32),
    "platoon-catchup": Budget(300, 32),
    "platoon-slowdown": Budget(300, 32),
    "quads-planar": Budget(600, 32),
    "quads-space": Budget(400, 32),
    "flock": Budget(300, 16),
    "gnn-flock": Budget(300, 16),
}
LEARNERS: dict[str, AbstractAlgorithm] = {
    "apg": APG(growth=0.0),
    "masac": MASAC(),
    "masac-lyapunov": MASAC(constraint=Lyapunov()),
    "control": MASAC(constraint=Lyapunov(reading="critic", weight=1.0)),
}
LONGER = 10  # horizons of the second look
FEWER = 5  # a fifth of the starts are watched so long
NEAR = 2_560  # environment steps in an iteration of a learner without a model


def schedule(learner: str, game: AbstractGame, budget: Budget) -> Schedule:
    """The same number of steps for every game, whatever its horizon."""
    if learner == "apg":
        steps = budget.updates * budget.episodes * game.horizon
        return Schedule(steps=steps, environments=budget.episodes, select_every=25)
    together = max(1, round(NEAR / game.horizon))
    rounds = -(-budget.steps // (together * game.horizon))
    return Schedule(steps=rounds * together * game.horizon, environments=together)


def trainer(name: str, learner: str, quick: bool) -> Trainer:
    game, algorithm = TASKS[name], LEARNERS[learner]
    budget = BUDGETS.get(name, USUAL)
    if quick:
        game = replace(game, horizon=8)
        budget, tiny = Budget(2, 2, 32), {"actor_width": 8, "critic_width": 8, "batch": 8}
        algorithm = replace(algorithm, **{k: v for k, v in tiny.items() if k in vars(algorithm)})
    plan = schedule(learner, game, budget)
    return Trainer(game, algorithm, replace(plan, warmup=8, select_episodes=4) if quick else plan)


def run_of(name: str, learner: str, seed: int, args: argparse.Namespace) -> Run:
    """The run of one seed, made if it is not there."""
    place = args.runs / name / learner / f"seed{seed}"
    if (place / "run.json").is_file():
        return Run.open(place)
    names = {"task": name, "algorithm": learner, "preset": ""}
    return Run.create(place, trainer(name, learner, args.quick), seed, names)


def train(runs: list[Run]) -> None:
    with Stop() as stop:
        show(launch(runs, Launch(parallel="vmap"), stop))
    if stop():
        raise SystemExit(stop.code)


def looks(game: AbstractGame, controller: Any, episodes: int) -> tuple[Evaluation, Evaluation]:
    """At the horizon, and at ten times it."""
    long = replace(game, horizon=LONGER * game.horizon)
    few = max(1, episodes // FEWER)
    return evaluate(game, controller, episodes, beyond=0), evaluate(long, controller, few, beyond=0)


def figures(prefix: str, seen: tuple[Evaluation, Evaluation]) -> dict[str, float]:
    found = {}
    for e, horizons in zip(seen, ("", f"_{LONGER}"), strict=True):
        rates = {"cost": e.cost, "success": e.successes, "failed": e.failed}
        found |= {f"{prefix}{k}{horizons}": float(np.mean(v)) for k, v in rates.items()}
    return found


def measure(name: str, learner: str, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Train what is missing, and a row for each seed."""
    runs = [run_of(name, learner, seed, args) for seed in args.seeds]
    train(runs)
    game, rows = runs[0].game, []
    law = REFERENCES[name]
    held = figures("reference_", looks(game, CONTROLLERS[law](game), args.episodes))
    for run, seed in zip(runs, args.seeds, strict=True):
        controller, last = run.controller(), run.history()[-1]
        rows.append(
            {"game": name, "learner": learner, "seed": seed, "episodes": args.episodes}
            | figures("", looks(game, controller, args.episodes))
            | {"reference": law}
            | held
            | {"steps": last["steps"], "updates": last["updates"]}
            | {"policy": policy_hash(controller)}
            | provenance()
        )
        if not args.keep:
            shutil.rmtree(run.directory / "checkpoints", ignore_errors=True)
    return rows


def read(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    text = io.StringIO()
    table = csv.DictWriter(text, [*rows[0]], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_text_atomic(path, text.getvalue())


def verdicts(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Better, equal or worse than the reference in cost, by an interval over training seeds."""
    found = []
    for name, learner in dict.fromkeys((r["game"], r["learner"]) for r in rows):
        own = [r for r in rows if (r["game"], r["learner"]) == (name, learner)]
        of = lambda key, own=own: np.array([float(r[key]) for r in own])
        gap, n = of("cost") - of("reference_cost"), len(own)
        wide = scipy.stats.t.ppf(0.975, n - 1) * np.std(gap, ddof=1) / n**0.5 if n > 1 else np.inf
        low, high = float(np.mean(gap) - wide), float(np.mean(gap) + wide)
        verdict = "better" if high < 0 else "worse" if low > 0 else "equal"
        found.append(
            {"game": name, "learner": learner, "seeds": n, "reference": own[0]["reference"]}
            | {
                "reference_cost": float(own[0]["reference_cost"]),
                "cost": float(np.mean(of("cost"))),
            }
            | {"worst_cost": float(np.max(of("cost"))), "difference": float(np.mean(gap))}
            | {"low": low, "high": high, "verdict": verdict}
            | {"success": float(np.mean(of("success"))), "worst": float(np.min(of("success")))}
            | {f"failed_{LONGER}": float(np.mean(of(f"failed_{LONGER}")))}
        )
    return found


def options() -> argparse.Namespace:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--games", nargs="+", default=list(REFERENCES), choices=list(REFERENCES))
    p.add_argument("--learners", nargs="+", default=list(LEARNERS), choices=list(LEARNERS))
    p.add_argument("--seeds", type=int, nargs="+", default=list(range(5)), help="of training")
    p.add_argument("--episodes", type=int, default=1_000, help="held-out starts")
    p.add_argument("--runs", type=Path, default=Path("runs/games"), help="where runs go")
    here = Path(__file__).parent / "results"
    p.add_argument("--results", type=Path, default=here, help="where the tables go")
    p.add_argument("--keep", action="store_true", help="keep the checkpoints of measured runs")
    p.add_argument("--quick", action="store_true", help="two games, two seeds, seconds")
    p.add_argument("--table", action="store_true", help="only the verdicts, from the rows")
    args = p.parse_args()
    if args.quick:
        args.games, args.learners = args.games[:1], args.learners[:2]
        args.seeds, args.episodes = args.seeds[:2], 8
    return args


def main() -> None:
    args = options()
    args.results.mkdir(parents=True, exist_ok=True)
    file = args.results / "games.csv"
    rows = read(file)
    for learner in args.learners if not args.table else ():
        for name in args.games:
            key = lambda r: (r["game"], r["learner"], int(r["seed"]))
            there = {key(r) for r in rows}
            if all((name, learner, seed) in there for seed in args.seeds):
                continue
            new = measure(name, learner, args)
            rows = [r for r in rows if key(r) not in {key(n) for n in new}] + new
            write(file, rows)
            write(args.results / "games-verdict.csv", verdicts(rows))
            print(*(f"{k} {v}" for k, v in verdicts(new)[0].items()), sep=", ", flush=True)
    write(args.results / "games-verdict.csv", verdicts(rows))


if __name__ == "__main__":
    main()
