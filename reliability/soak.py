"""Training that is killed and resumed at random, against the same training left alone.

    python reliability/soak.py [--minutes 120] [--seed 0] [--out FILE]

A child trains a tiny team, saving about once a second, and is ended by SIGKILL, SIGTERM or SIGINT
after a random time, again and again. Then as many iterations are trained in one go, and every array
of the two last checkpoints is compared to the last bit. The memory of the process that was left
alone is read as it goes.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path


ROOT = Path(__file__).parent.parent
CHILD = """
import sys
import marlyap.runs.fit as f
f.PATIENCE, f.SHARE = 1.0, 1e9
from marlyap.cli import main
sys.exit(main(["train", "--resume", sys.argv[1]]))
"""
ENDS = [signal.SIGKILL] * 3 + [signal.SIGTERM, signal.SIGINT]


def resident() -> int:
    """Memory of this process (bytes)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=120.0, help="of kills and resumes")
    parser.add_argument("--seed", type=int, default=0, help="of the times and signals")
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    args = parser.parse_args()
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "soak"))
    sys.path.insert(0, str(ROOT))
    import numpy as np

    from marlyap.games.dynamics import SingleIntegrator
    from marlyap.learning.algorithms import MASAC
    from marlyap.learning.constraints import Lyapunov
    from marlyap.learning.trainer import Schedule, Trainer
    from marlyap.runs.run import Run, begin, flatten
    from marlyap.tasks import Rendezvous

    game = Rendezvous(agents=2, horizon=4, dynamics=SingleIntegrator())
    algorithm = MASAC(actor_width=4, critic_width=4, batch=4, constraint=Lyapunov())
    schedule = Schedule(
        steps=10**9,
        environments=2,
        steps_per_update=4,
        warmup=8,
        capacity=4_000,
        select_every=10**9,
    )
    trainer, dice = Trainer(game, algorithm, schedule), random.Random(args.seed)
    with tempfile.TemporaryDirectory() as place:
        names = {"task": "rendezvous", "algorithm": "masac-lyapunov", "preset": "tuned"}
        run = Run.create(Path(place) / "run", trainer, 5, names)
        end, ends, warnings = time.monotonic() + 60 * args.minutes, [], 0
        while time.monotonic() < end or not run.checkpoints.steps():
            before = (run.directory / "log.jsonl").exists() and len(run.history())
            command = [sys.executable, "-c", CHILD, str(run.directory)]
            env = os.environ | {"PYTHONPATH": str(ROOT)}
            quiet = subprocess.DEVNULL
            child = subprocess.Popen(command, env=env, stdout=quiet, stderr=quiet)
            while child.poll() is None and len(run.history()) <= before + 2:
                time.sleep(0.1)
            time.sleep(dice.expovariate(1 / 4.0))
            number = dice.choice(ENDS)
            child.send_signal(number)
            code = child.wait(300)
            wanted = -number if number == signal.SIGKILL else 128 + number
            if code != wanted:
                print(f"it ended with {code}, not {wanted}")
                return 1
            if run.checkpoints.steps():
                warnings += len(run.checkpoints.latest().warnings)
            ends.append(number.name)
        saved = run.checkpoints.latest()
        counts = ", ".join(f"{ends.count(name)} {name}" for name in sorted(set(ends)))
        print(f"{len(ends)} ends ({counts}), {warnings} damaged checkpoints, ", end="")
        print(f"{saved.step} iterations", flush=True)

        first, sizes = begin(trainer, 5), []
        for done, carry, _ in trainer.advance(first):  # noqa: B007
            sizes.append(resident())
            if done == saved.step:
                break
        alone = flatten(carry)
        same = alone.keys() == saved.arrays.keys() and all(
            x.dtype == alone[k].dtype and np.array_equal(x, alone[k])
            for k, x in saved.arrays.items()
        )
        early = sizes[len(sizes) // 10]
        growth = (max(sizes[-len(sizes) // 10 :]) - early) / 2**20
        print(f"{'equal' if same else 'DIFFERENT'} to the last bit in {len(alone)} arrays")
        print(f"memory {early / 2**20:.0f} MiB after a tenth, {growth:+.1f} MiB by the end")
        if args.out:
            found = {"minutes": args.minutes, "seed": args.seed, "iterations": saved.step}
            found |= {"ends": {name: ends.count(name) for name in sorted(set(ends))}}
            found |= {"damaged": warnings, "arrays": len(alone), "equal": same}
            found |= {"memory_mib": round(early / 2**20, 1), "growth_mib": round(growth, 1)}
            args.out.write_text(json.dumps(found, indent=1) + "\n")
    return int(not same)


if __name__ == "__main__":
    sys.exit(main())
