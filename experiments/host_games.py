"""What is learnt on games of other libraries: a row for each game and seed, in one table.

    ./run python experiments/host_games.py --games spread listener --seeds 0 1 2

leaves `host_games.csv` in `--results`: return a head over 200 episodes that were not trained on,
with its 95 % interval, environment steps (warm-up left out), updates, CPU seconds of the training
with all its compiling, and where it was made. Runs are kept in `--runs`. A row that is there is not
made again, and a training that was stopped is resumed: started anew, the script goes on where it
was. A row of `random` is the same of uniformly random actions.
"""

import argparse
import csv
import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marlyap.hosts.opening import open_game
from marlyap.hosts.sources import parsed
from marlyap.learning.host_trainer import played_by
from marlyap.runs.provenance import provenance
from marlyap.storage import store


class Game(NamedTuple):
    """What is trained on, and with what it differs from the defaults."""

    source: str
    steps: int
    copies: int = 16
    options: str = ""
    arguments: tuple[str, ...] = ()


FAST = "--algorithm.rate_pi 1e-3 --algorithm.rate_Q 1e-3 --algorithm.rate_alpha 1e-3"
GAMES = {
    "spread": Game("pettingzoo:mpe2.simple_spread_v3", 96_000),
    "listener": Game("pettingzoo:mpe2.simple_speaker_listener_v4", 92_000, 8, FAST),
    "hopper": Game("mamujoco:Hopper:3x1", 250_000, 8, f"{FAST} --algorithm.gamma 0.99"),
    "cheetah": Game("mamujoco:HalfCheetah:2x3", 110_000, 8, f"{FAST} --algorithm.gamma 0.99"),
    "navigation": Game("vmas:navigation", 256_000, 64, FAST, ("n_agents=3",)),
}
EPISODES = 200


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--games", nargs="+", default=list(GAMES), choices=list(GAMES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--runs", type=Path, default=Path("runs/host_games"))
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--quick", action="store_true", help="a few hundred steps, to try it")
    args = parser.parse_args()
    table = args.results / "host_games.csv"
    rows = list(csv.DictReader(table.open())) if table.exists() else []
    done = {(row["game"], row["seed"]) for row in rows}
    for row in missing(args, done):
        rows.append(row)
        rows.sort(key=lambda r: (list(GAMES).index(r["game"]), str(r["seed"])))
        heads = list(dict.fromkeys(name for r in rows for name in r))
        lines = [",".join(str(r.get(name, "")) for name in heads) for r in rows]
        table.parent.mkdir(parents=True, exist_ok=True)
        store.write_text_atomic(table, "\n".join([",".join(heads), *lines]) + "\n")
        print(row, flush=True)


def missing(args: argparse.Namespace, done: set[tuple[str, str]]) -> Iterator[dict[str, Any]]:
    """The rows that are not there yet, one after the other."""
    for name in args.games:
        if (name, "random") not in done:
            yield {"game": name, "seed": "random", "episodes": EPISODES} | random(GAMES[name])
        for seed in args.seeds:
            if (name, str(seed)) not in done:
                yield trained(name, GAMES[name], seed, args.runs / name, args.quick)


def trained(name: str, game: Game, seed: int, out: Path, quick: bool) -> dict[str, Any]:
    """Train, or go on training, then evaluate."""
    place, spent = out / f"seed{seed}", out / f"cpu{seed}.json"
    start = ["--resume", str(place)]
    if not place.exists():
        start = [
            game.source,
            "masac",
            "--seeds",
            str(seed),
            "--out",
            str(out),
            *game.options.split(),
        ]
        start += ["--steps", str(640 if quick else game.steps)]
        start += ["--schedule.environments", str(game.copies)]
        start += ["--task.arguments", ",".join(game.arguments)] if game.arguments else []
    before = json.loads(spent.read_text())["seconds"] if spent.exists() else 0.0
    try:
        marlyap("train", *start)
    finally:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = before + used.ru_utime + used.ru_stime - COUNTED[0]
        COUNTED[0] = used.ru_utime + used.ru_stime
        out.mkdir(parents=True, exist_ok=True)
        store.write_text_atomic(spent, json.dumps({"seconds": round(seconds, 1)}))
    told = json.loads(marlyap("evaluate", str(place), "--episodes", str(EPISODES), "--json"))
    row, last = told["runs"][0], (place / "log.jsonl").read_text().splitlines()[-1]
    log = json.loads(last)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    COUNTED[0] = used.ru_utime + used.ru_stime
    return {
        "game": name,
        "seed": seed,
        "episodes": EPISODES,
        "return": round(row["return_mean"], 3),
        "low": round(row["return_interval"][0], 3),
        "high": round(row["return_interval"][1], 3),
        "steps": log["steps"],
        "updates": log["updates"],
        "cpu_seconds": json.loads(spent.read_text())["seconds"],
    } | provenance()


COUNTED = [0.0]  # CPU seconds of children that are accounted for


def random(game: Game) -> dict[str, Any]:
    """What uniformly random actions return."""
    rng = np.random.default_rng(0)
    with open_game(game.source, 16, arguments=parsed(game.arguments)) as copies:
        size = (16, copies.spec.agents, copies.spec.du)
        act = lambda obs: rng.uniform(-1, 1, size).astype(np.float32)
        each = np.array([r.mean() for r, _ in played_by(copies, act, 0, EPISODES)])
    half = 1.96 * each.std(ddof=1) / len(each) ** 0.5
    found = {"return": each.mean(), "low": each.mean() - half, "high": each.mean() + half}
    return {k: round(float(v), 3) for k, v in found.items()}


def marlyap(*words: str) -> str:
    """Run a command of marlyap; its standard output."""
    command = [sys.executable, "-m", "marlyap", *words]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


if __name__ == "__main__":
    main()
