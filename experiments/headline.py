"""MASAC with and without the Lyapunov term, many seeds: learning curves, success over 500 starts.

    ./run python experiments/headline.py            ten seeds of each (about an hour on two cores)
    ./run python experiments/headline.py --quick    a minute, to see that it works
    ./run python experiments/headline.py --draw     the figure again, from the CSV files alone

Runs are kept in --runs and gone on with when the script is started again.
"""

import argparse
import csv
import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from marlyap import statistics
from marlyap.store import read_jsonl


HERE = Path(__file__).parent / "results"
ALGORITHMS = ("masac", "masac-lyapunov")
QUICK = "--schedule.environments 4 --schedule.warmup 160 --algorithm.batch 16".split()


def marlyap(*words: str) -> str:
    """One command of the package; its standard output."""
    return subprocess.run(
        [sys.executable, "-m", "marlyap", *words], check=True, stdout=subprocess.PIPE, text=True
    ).stdout


def train(args: argparse.Namespace) -> None:
    """Make the runs that are missing; go on with those that are not finished."""
    for algorithm in ALGORITHMS:
        place = args.runs / args.task / algorithm
        missing = [s for s in args.seeds if not (place / f"seed{s}" / "run.json").exists()]
        if missing:
            options = ["--seeds", *map(str, missing), "--steps", str(args.steps)]
            extra = QUICK if args.quick else []
            marlyap("train", args.task, algorithm, *options, "--out", str(place), *extra)
        marlyap("train", "--resume", str(place))


def measure(args: argparse.Namespace) -> None:
    """Two tidy tables: one row an iteration, one row a run and radius."""
    curves, success = [], []
    for algorithm in ALGORITHMS:
        place = args.runs / args.task / algorithm
        wanted = [str(place / f"seed{s}") for s in args.seeds]
        result = json.loads(
            marlyap("evaluate", *wanted, "--episodes", str(args.episodes), "--json")
        )
        for row in result["runs"]:
            about = {"task": args.task, "algorithm": algorithm, "seed": row["seed"]}
            for r in row["radii"]:
                low, high = r["interval"]
                numbers = {k: r[k] for k in ("radius", "episodes", "successes", "success_rate")}
                success.append(about | numbers | {"low": low, "high": high})
            for line in read_jsonl(Path(row["name"]) / "log.jsonl"):
                kept = {k: line.get(k, "") for k in ("steps", "updates", "success", "return")}
                curves.append(about | kept)
    for name, rows in (("curves", curves), ("success", success)):
        with open(args.results / f"headline-{args.task}-{name}.csv", "w", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)


def read(args: argparse.Namespace, name: str) -> list[dict[str, str]]:
    with open(args.results / f"headline-{args.task}-{name}.csv", newline="") as file:
        return list(csv.DictReader(file))


def summarise(args: argparse.Namespace) -> None:
    """Interquartile means over seeds with bootstrap intervals, and who is the better."""
    rates = defaultdict(lambda: defaultdict(list))
    for row in read(args, "success"):
        rates[float(row["radius"])][row["algorithm"]].append(float(row["success_rate"]))
    print(f"{args.task}: interquartile mean over seeds of the success rate, 95 % interval")
    for radius, by in rates.items():
        parts = []
        for algorithm, values in by.items():
            scores = np.array(values)
            low, high = statistics.stratified_bootstrap(scores[:, None])
            iqm, worst = statistics.iqm(scores), scores.min()
            parts.append(f"{algorithm} {iqm:.4f} [{low:.4f}, {high:.4f}] worst {worst:.3f}")
        a, b = (np.array(by[name]) for name in ALGORITHMS)
        p, (low, high) = statistics.probability_of_improvement(b, a)
        print(
            f"  r = {radius:<5g}", " | ".join(parts), f"| P(better) {p:.2f} [{low:.2f}, {high:.2f}]"
        )


def draw(args: argparse.Namespace) -> None:
    """The paper's two figures, from the tables alone."""
    from marlyap import draw as pictures

    points = defaultdict(list)
    for row in read(args, "curves"):
        if row["success"]:
            points[row["algorithm"], int(row["seed"])].append(row)
    runs = [
        {
            "label": f"{algorithm} seed {seed}",
            "algorithm": algorithm,
            "seed": seed,
            "log": [{k: float(r[k]) for k in ("steps", "success", "return")} for r in rows],
        }
        for (algorithm, seed), rows in points.items()
    ]
    pictures.learning_curves_png(runs, args.results / f"headline-{args.task}.png")


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--task", default="rendezvous")
    p.add_argument("--seeds", type=int, nargs="+", default=list(range(10)))
    p.add_argument("--steps", type=int, default=204_800)
    p.add_argument("--episodes", type=int, default=500)
    p.add_argument("--runs", type=Path, default=Path("runs/headline"))
    p.add_argument("--results", type=Path, default=HERE)
    p.add_argument("--quick", action="store_true")
    p.add_argument("--draw", action="store_true")
    args = p.parse_args()
    if args.quick:
        args.seeds, args.steps, args.episodes = [0, 1], 960, 20
    args.results.mkdir(parents=True, exist_ok=True)
    if not args.draw:
        train(args)
        measure(args)
    summarise(args)
    draw(args)


if __name__ == "__main__":
    main()
