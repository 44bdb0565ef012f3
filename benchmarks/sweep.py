"""What a sweep costs beside the training: a second cell, many cells, the status of many jobs.

Each is a whole command in a fresh process, the least of several; the caches are empty to begin
with. `the same again` is the first training once more, `another rate` differs from it in a float.

    python benchmarks/sweep.py
"""

import json
import sys
import tempfile
from pathlib import Path

import harness


PYTHON = [sys.executable, "-m", "marlyap"]
TRAIN = "train rendezvous masac-lyapunov --steps 2560 --schedule.environments 16 --force"
MAKE = "sweep make rendezvous masac-lyapunov"
GRID = [f"algorithm.{name}=" for name in ("rate_Q", "rate_pi", "tau", "constraint.decrease")]


def finished(folder: Path) -> int:
    """Put a result into every job of a sweep; returns how many there are."""
    lines = (folder / "cells.jsonl").read_text().splitlines()
    for name in (json.loads(line)["name"] for line in lines):
        run = folder / name / "seed0"
        run.mkdir(parents=True)
        result = {"cell": name, "seed": 0, "steps": 102400, "success": 0.98, "return": -12.5}
        (run / "result.json").write_text(json.dumps(result))
    return len(lines)


def main(argv=None):
    args = harness.arguments(argv, __doc__, repeats=2)
    rows = []

    def add(name, words, environment=None, repeats=1):
        harness.note(name)
        runs = [harness.usage([*PYTHON, *words], environment) for _ in range(repeats)]
        rows.append({"what": name} | {k: min(r[k] for r in runs) for k in ("wall s", "cpu s")})

    with tempfile.TemporaryDirectory() as folder:
        values = ",".join(f"{0.001 * k:g}" for k in range(1, 4 if args.quick else 11))
        grid, count = [f"{name}{values}" for name in GRID], 3**4 if args.quick else 10**4
        make = lambda name, grid: [*MAKE.split(), "--out", f"{folder}/{name}", "--grid", *grid]
        add(f"make {count:,} cells", make("many", grid), repeats=args.repeats)
        harness.usage([*PYTHON, *make("done", grid[:3])])
        count = finished(Path(folder, "done"))
        add(f"status of {count:,} jobs", ["sweep", "status", f"{folder}/done"], None, args.repeats)
        if not args.quick:
            cache = {"JAX_COMPILATION_CACHE_DIR": f"{folder}/cache"}
            train = [*TRAIN.split(), "--out", f"{folder}/run"]
            add("first training", train, cache)
            add("the same again", train, cache, args.repeats)
            add("another rate", [*train, "--algorithm.rate_Q", "1e-3"], cache)
            other = ["--algorithm.tau", "0.01", "--algorithm.gamma", "0.9"]
            add("another tau and discount", [*train, *other], cache)
    return harness.report("sweep", rows, args)


if __name__ == "__main__":
    main()
