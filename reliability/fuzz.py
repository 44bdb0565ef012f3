"""Fuzzing of all that reads what others made: coverage-guided by atheris if that is installed.

    pip install atheris
    python reliability/fuzz.py [--minutes 10] [--seed 0]

Fed are JSON files, stored directories (manifest and payload as raw bytes, and sound ones with odd
values in a manifest that is sealed again), run.json, and certificates up to `recheck`. Each has to
be read, or refused by a UserError of one line; anything else (for atheris a hang of a minute, or
4 GB of memory, too) ends the search.
"""

import argparse
import copy
import json
import random
import shutil
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any


ROOT = Path(__file__).parent.parent
ODD = [None, True, False, -1, 0, 1, 2**31, -1e308, 1e308, 0.5, "", "x", "../x", [], {}, [[]], [{}]]


class Dice:
    """What atheris makes of its bytes, from plain random numbers."""

    def __init__(self, seed: int):
        self.random = random.Random(seed)

    def ConsumeIntInRange(self, low: int, high: int) -> int:
        return self.random.randint(low, high)

    def ConsumeInt(self, size: int) -> int:
        return self.random.getrandbits(8 * size) - 2 ** (8 * size - 1)

    def ConsumeRegularFloat(self) -> float:
        return self.random.uniform(-1, 1) * 10.0 ** self.random.randint(-300, 300)

    def ConsumeUnicodeNoSurrogates(self, count: int) -> str:
        return "".join(chr(self.random.randrange(0xD800)) for _ in range(count))

    def ConsumeBytes(self, count: int) -> bytes:
        return self.random.randbytes(self.random.randint(0, count))


def edited(data: Any, value: Any) -> Any:
    """A copy of nested JSON with odd values in up to three places."""
    value = copy.deepcopy(value)
    for _ in range(data.ConsumeIntInRange(1, 3)):
        node = value
        while True:
            keys = [*node] if isinstance(node, dict) else [*range(len(node))]
            if not keys:
                break
            key = keys[data.ConsumeIntInRange(0, len(keys) - 1)]
            if isinstance(node[key], dict | list) and node[key] and data.ConsumeIntInRange(0, 7):
                node = node[key]
                continue
            node[key] = odd(data)
            break
    return value


def odd(data: Any) -> Any:
    """A value of any type."""
    kind = data.ConsumeIntInRange(0, len(ODD) + 2)
    if kind < len(ODD):
        return copy.deepcopy(ODD[kind])
    number = data.ConsumeInt(8) if kind == len(ODD) else data.ConsumeRegularFloat()
    return data.ConsumeUnicodeNoSurrogates(12) if kind == len(ODD) + 2 else number


def loaders(place: Path) -> list[Any]:
    """One function of `data` for each kind of input, from sound examples made in `place`."""
    import jax.numpy as jnp

    from marlyap.certificates.basin import Basin
    from marlyap.certificates.certify import certify, save
    from marlyap.certificates.composition import Composition
    from marlyap.certificates.contraction import Contraction
    from marlyap.certificates.lyapunov import Quadratic
    from marlyap.certificates.quantiles import Quantiles
    from marlyap.certificates.reach import Reach
    from marlyap.certificates.robustness import Robustness
    from marlyap.learning.algorithms import MASAC
    from marlyap.learning.constraints import Lyapunov
    from marlyap.learning.trainer import Schedule, Trainer
    from marlyap.recheck import recheck
    from marlyap.runs.fit import fit
    from marlyap.runs.run import Run
    from marlyap.storage import store
    from marlyap.tasks import Rendezvous

    small = {"actor_width": 4, "critic_width": 4, "batch": 4}
    game, algorithm = Rendezvous(agents=2, horizon=8), MASAC(**small, constraint=Lyapunov())
    schedule = Schedule(steps=64, environments=2, steps_per_update=8, warmup=16, capacity=32)
    run = Run.create(place / "run", Trainer(game, algorithm, schedule), 0, {"task": "rendezvous"})
    for _ in fit([run]):
        pass
    few = {"rollouts": 40, "share": 0.5}
    table = {
        "reach": Reach(**few),
        "contraction": Contraction(**few, calibration=40, T=4),
        "basin": Basin(**few, calibration=40, stay=4),
        "quantiles": Quantiles(rollouts=40, q=0.5),
        "robustness": Robustness(**few, gains=(0.5,), delays=(1,), spreads=()),
        "composition": Composition(**few, calibration=40, T=4, stay=0),
    }
    policy, V = run.controller(), Quadratic(jnp.eye(4))
    save(place / "sound", certify(game, policy, table, 0, 0.9, V=V), game, policy, V)
    recheck(place / "sound")
    about = json.loads((place / "run" / "run.json").read_bytes())
    manifest = json.loads((place / "sound" / store.MANIFEST).read_bytes())
    payload = (place / "sound" / store.PAYLOAD).read_bytes()
    del manifest["sha256"]
    for name in ("one", "two"):
        (place / name).mkdir()

    def plain(data: Any) -> None:
        (place / "one" / "x").write_bytes(data.ConsumeBytes(4_000))
        store.read_json(place / "one" / "x")

    def lines(data: Any) -> None:
        (place / "one" / "x").write_bytes(data.ConsumeBytes(4_000))
        store.read_jsonl(place / "one" / "x")

    def raw(data: Any) -> None:
        (place / "two" / store.PAYLOAD).write_bytes(data.ConsumeBytes(500))
        (place / "two" / store.MANIFEST).write_bytes(data.ConsumeBytes(4_000))
        store.read(place / "two", "certificate")

    def sealed(data: Any) -> None:
        (place / "two" / store.PAYLOAD).write_bytes(payload)
        (place / "two" / store.MANIFEST).write_bytes(store.sealed(edited(data, manifest)))
        recheck(place / "two")

    def verdicts(data: Any) -> None:
        meta = manifest | {"meta": edited(data, manifest["meta"])}
        (place / "two" / store.PAYLOAD).write_bytes(payload)
        (place / "two" / store.MANIFEST).write_bytes(store.sealed(meta))
        recheck(place / "two")

    def config(data: Any) -> None:
        (place / "run" / "run.json").write_text(json.dumps(edited(data, about)))
        Run.open(place / "run")

    return [plain, lines, raw, sealed, verdicts, config]


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    sys.path.insert(0, str(ROOT))
    try:
        import atheris
    except ImportError:
        atheris = None
    with atheris.instrument_imports(include=["marlyap"]) if atheris else nullcontext():
        from marlyap.errors import UserError

        place = Path(tempfile.mkdtemp())
        kinds = loaders(place)
    seen = {kind.__name__: [0, 0] for kind in kinds}  # fed, refused

    def one(data: Any) -> None:
        kind = kinds[data.ConsumeIntInRange(0, len(kinds) - 1)]
        seen[kind.__name__][0] += 1
        try:
            kind(data)
        except UserError as error:
            seen[kind.__name__][1] += 1
            assert "\n" not in str(error), error
        if sum(fed for fed, _ in seen.values()) % 500 == 0:
            print(json.dumps(seen), flush=True)

    if atheris is None:
        end, dice = time.monotonic() + 60 * args.minutes, Dice(args.seed)
        while time.monotonic() < end:
            one(dice)
        print("fed and refused:", json.dumps(seen))
        shutil.rmtree(place)
        return
    search = [f"-max_total_time={60 * args.minutes:.0f}", f"-seed={args.seed + 1}"]
    limits = ["-timeout=60", "-rss_limit_mb=4096", "-max_len=4096", "-len_control=0"]
    (place / "corpus").mkdir()
    for number in range(100):
        (place / "corpus" / str(number)).write_bytes(random.Random(number).randbytes(200))
    target = lambda raw: one(atheris.FuzzedDataProvider(raw))
    atheris.Setup([sys.argv[0], *search, *limits, str(place / "corpus")], target)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
