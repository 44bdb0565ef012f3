"""Coverage-guided fuzzing of all that reads what others made.

    pip install atheris
    python reliability/fuzz.py [--minutes 10] [--seed 0]

Fed are JSON files, stored directories (manifest and payload as raw bytes, and sound ones with odd
values in a manifest that is sealed again), run.json, and certificates up to `recheck`. Each has to
be read, or refused by a UserError of one line; anything else, a hang of a minute, or 4 GB of memory
ends the search with the input that did it.
"""

import argparse
import copy
import json
import random
import sys
import tempfile
from pathlib import Path
from typing import Any


ROOT = Path(__file__).parent.parent
ODD = [None, True, False, -1, 0, 1, 2**31, -1e308, 1e308, 0.5, "", "x", "../x", [], {}, [[]], [{}]]


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

    from marlyap import store
    from marlyap.algorithms import MASAC
    from marlyap.certificates.basin import Basin
    from marlyap.certificates.composition import Composition
    from marlyap.certificates.contraction import Contraction
    from marlyap.certificates.quantiles import Quantiles
    from marlyap.certificates.reach import Reach
    from marlyap.certificates.robustness import Robustness
    from marlyap.certify import certify, save
    from marlyap.constraints import Lyapunov
    from marlyap.fit import fit
    from marlyap.lyapunov_function import Quadratic
    from marlyap.recheck import recheck
    from marlyap.run import Run
    from marlyap.tasks import Rendezvous
    from marlyap.trainer import Schedule, Trainer

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
        (place / "two" / store.MANIFEST).write_bytes(store._sealed(edited(data, manifest)))
        recheck(place / "two")

    def verdicts(data: Any) -> None:
        meta = manifest | {"meta": edited(data, manifest["meta"])}
        (place / "two" / store.PAYLOAD).write_bytes(payload)
        (place / "two" / store.MANIFEST).write_bytes(store._sealed(meta))
        recheck(place / "two")

    def config(data: Any) -> None:
        (place / "run" / "run.json").write_text(json.dumps(edited(data, about)))
        Run.open(place / "run")

    return [plain, lines, raw, sealed, verdicts, config]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    import atheris

    sys.path.insert(0, str(ROOT))
    with atheris.instrument_imports(include=["marlyap"]):
        from marlyap.errors import UserError

        place = Path(tempfile.mkdtemp())
        kinds = loaders(place)
    seen = {kind.__name__: [0, 0] for kind in kinds}  # fed, refused

    def one(raw: bytes) -> None:
        data = atheris.FuzzedDataProvider(raw)
        kind = kinds[data.ConsumeIntInRange(0, len(kinds) - 1)]
        seen[kind.__name__][0] += 1
        try:
            kind(data)
        except UserError as error:
            seen[kind.__name__][1] += 1
            assert "\n" not in str(error), error
        if sum(fed for fed, _ in seen.values()) % 500 == 0:
            print(json.dumps(seen), flush=True)

    search = [f"-max_total_time={60 * args.minutes:.0f}", f"-seed={args.seed + 1}"]
    limits = ["-timeout=60", "-rss_limit_mb=4096", "-max_len=4096", "-len_control=0"]
    (place / "corpus").mkdir()
    for number in range(100):
        (place / "corpus" / str(number)).write_bytes(random.Random(number).randbytes(200))
    atheris.Setup([sys.argv[0], *search, *limits, str(place / "corpus")], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
