"""Our wall time beside BenchMARL's MASAC (TorchRL, VMAS), turn about on one core.

Both train MASAC with an actor for each agent, 64x64 networks, batches of 256, ten environments and
one update for each environment step, from the first step on. Ours meets at a target with unicycles;
BenchMARL plays `simple_spread` of VMAS, since it has no such task. Its environment is made once, in
the user's cache folder; torch is installed at --torch (name a CPU build where pip can find one).

    python benchmarks/peer.py --core 0

The peer's figures are its own timers': collecting and training, without start, compilation or logs.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import harness
import jax

from marlyap import MASAC, Lyapunov, Rendezvous, Schedule, Trainer
from marlyap.compute.cache import cache_directory
from marlyap.learning.algorithms import PRESETS


PACKAGES = ("torchrl==0.11.1", "vmas==1.5.2", "hydra-core", "omegaconf", "tqdm")
PEER = "benchmarl==1.5.2"  # without its dependencies, which ask for CUDA
ENVIRONMENTS, HORIZON, STEPS = 10, 40, 50_000


def environment(torch):
    """The peer's Python, its environment made if it is not there."""
    folder = cache_directory().parent / "benchmarl"
    python = folder / "bin" / "python"
    done = folder / "complete"
    if not done.exists():
        harness.note(f"making {folder}; this happens once")
        pip = [str(python), "-m", "pip", "install", "--quiet"]
        for command in (
            [sys.executable, "-m", "venv", str(folder)],
            [*pip, f"torch=={torch}"],
            [*pip, *PACKAGES],
            [*pip, "--no-deps", PEER],
        ):
            subprocess.run(command, check=True)
        done.touch()
    return python


def ours(agents, constraint, preset, quick):
    """One iteration: ten episodes, and an update for each of their steps."""
    small = {"batch": 16, "actor_width": 8, "critic_width": 8} if quick else {}
    environments, horizon = (2, 4) if quick else (ENVIRONMENTS, HORIZON)
    schedule = Schedule(
        steps=STEPS if not quick else 8, environments=environments, steps_per_update=1, warmup=1
    )
    algorithm = PRESETS[preset](MASAC(**small, **constraint))
    trainer = Trainer(Rendezvous(agents=agents, horizon=horizon), algorithm, schedule)
    carry = [eqx.filter_jit(trainer.begin)(jax.random.key(0))[0]]
    iterate = eqx.filter_jit(lambda carry: trainer.iterate(carry)[0], donate="all")

    def run():
        carry[0] = jax.block_until_ready(iterate(carry[0]))

    return run, trainer.updates_per_iteration


class Peer:
    """BenchMARL in its own process, which does one iteration when it is told to."""

    def __init__(self, python, agents, frames):
        script = Path(__file__).with_name("peer_benchmarl.py")
        env = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [str(python), str(script), str(agents), str(frames), str(ENVIRONMENTS), str(HORIZON)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=env,
        )
        self.frames, self.answers = frames, []

    def __call__(self):
        self.process.stdin.write("go\n")
        self.process.stdin.flush()
        for line in self.process.stdout:
            if line.startswith("{"):
                self.answers.append(json.loads(line))
                return
        raise SystemExit("BenchMARL failed; its message is above.")

    def per_step(self, key, least=False):
        """Seconds of one environment step with its update, from all but the first iteration."""
        values = sorted(a[key] / self.frames for a in self.answers[1:])
        return values[0] if least else values[len(values) // 2]


def main(argv=None):
    args = harness.arguments(
        argv, __doc__, agents=[3, 5], rounds=8, frames=100, preset="paper", torch="2.13.0"
    )
    if args.quick:
        args.agents, args.rounds = [2], 1
    peers, jobs, counts = {}, {}, {}
    for n in args.agents:
        if not args.quick:
            peers[n] = jobs[n, "BenchMARL masac"] = Peer(environment(args.torch), n, args.frames)
        for name, constraint in (("masac", {}), ("masac-lyapunov", {"constraint": Lyapunov()})):
            harness.note(f"compiling {name}, {n} agents")
            jobs[n, name], counts[n, name] = ours(n, constraint, args.preset, args.quick)
    times = harness.turns(jobs, args.rounds)
    rows = []
    for (n, name), t in times.items():
        if (n, name) in counts:
            t = t.per(counts[n, name])
            median, best, cpu = t.median, t.best, t.cpu
        else:
            median, best = peers[n].per_step("wall"), peers[n].per_step("wall", least=True)
            cpu = peers[n].per_step("cpu", least=True)
        row = {"agents": n, "who": name, "steps and updates/s": 1 / median, "best": 1 / best}
        row |= {"by cpu": 1 / cpu, f"{STEPS:,} steps (s)": STEPS * median}
        if peers:
            row["faster (median)"] = peers[n].per_step("wall") / median
            row["faster (cpu)"] = peers[n].per_step("cpu", least=True) / cpu
        rows.append(row)
    versions = peers[args.agents[0]].answers[0]["versions"] if peers else {}
    for peer in peers.values():
        peer.process.stdin.close()
        peer.process.wait()
    return harness.report("peer", rows, args, preset=args.preset, versions=versions)


if __name__ == "__main__":
    main()
