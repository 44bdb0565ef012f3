"""What a sweep costs beside the training: a second cell, many cells, the status of many jobs.

    ./run python benchmarks/sweep.py

Processor seconds of whole commands, each a fresh process, least of --repeats; the caches are empty
to begin with. `repeat` is the first command again; `another rate` differs from it in a float.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path


TRAIN = "rendezvous masac-lyapunov --steps 2560 --schedule.environments 16 --schedule.warmup 320"
GRID = [f"algorithm.{name}=" for name in ("rate_Q", "rate_pi", "tau", "constraint.decrease")]


def seconds(words: list[str], place: Path) -> float:
    """Processor seconds of a command and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(place / "cache")}
    subprocess.run(
        [sys.executable, "-m", "marlyap", *words], cwd=place, env=env, check=True,
        capture_output=True,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def cells(place: Path, repeats: int) -> dict[str, float]:
    """Of a first training, of the same again, and of one with another learning rate."""
    words = ["train", *TRAIN.split(), "--force", "--out", "run"]
    found = {"first": seconds(words, place)}
    found["repeat"] = min(seconds(words, place) for _ in range(repeats))
    rates = [f"{0.001 + 0.0001 * k:g}" for k in range(repeats)]
    each = [seconds([*words, "--algorithm.rate_Q", rate], place) for rate in rates]
    return found | {"another rate": min(each), "another rate, the first": each[0]}


def folder(place: Path, repeats: int) -> dict[str, float]:
    """Of making 10,000 cells, and of the status of 1,000 finished jobs."""
    ten = ",".join(f"{0.001 * k:g}" for k in range(1, 11))
    grid = [f"{name}{ten}" for name in GRID]
    make = ["sweep", "make", "rendezvous", "masac-lyapunov", "--out", "many", "--grid"]
    found = {"make 10,000": min(seconds([*make, *grid], place) for _ in range(repeats))}
    seconds([*make[:5], "done", "--grid", *grid[:3]], place)
    lines = (place / "done" / "cells.jsonl").read_text().splitlines()
    for name in (json.loads(line)["name"] for line in lines):
        run = place / "done" / name / "seed0"
        run.mkdir(parents=True)
        (run.parent / "seed0.lock").touch()
        result = {"cell": name, "seed": 0, "steps": 102400, "success": 0.98, "return": -12.5}
        (run / "result.json").write_text(json.dumps(result))
    status = min(seconds(["sweep", "status", "done"], place) for _ in range(repeats))
    return found | {"status of 1,000": status}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--only", choices=("cells", "folder"))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        found = {} if args.only == "cells" else folder(Path(name), args.repeats)
        found |= {} if args.only == "folder" else cells(Path(name), args.repeats)
    for what, value in found.items():
        print(f"{what:<24} {value:7.2f} s")


if __name__ == "__main__":
    main()
