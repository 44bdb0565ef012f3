"""How long a checkpoint takes, flushed to the disk, and its share of the time of a training.

A checkpoint is the whole learner and the replay memory, with room for the transitions named. The
share follows from the rule of training: no sooner than 20 s after the last, and never so often that
it would take more than 2 %.

    python benchmarks/checkpoint.py --core 0
"""

import statistics
import tempfile
import time
from pathlib import Path

import equinox as eqx
import harness
import jax
import jax.numpy as jnp
import numpy as np

from marlyap import MASAC, Lyapunov, Rendezvous, Schedule, Trainer
from marlyap.runs.fit import PATIENCE, SHARE
from marlyap.runs.run import Run, begin


def main(argv=None):
    args = harness.arguments(
        argv, __doc__, agents=[3, 5], transitions=[10_000, 100_000, 1_000_000], repeats=7
    )
    if args.quick:
        args.agents, args.transitions, args.repeats = [3], [400], 2
    rows = []
    for n in args.agents:
        for count in args.transitions:
            harness.note(f"{n} agents, {count} transitions")
            schedule = Schedule(steps=count, capacity=count)
            trainer = Trainer(Rendezvous(agents=n), MASAC(constraint=Lyapunov()), schedule)
            carry = begin(trainer, 0)
            size = sum(np.asarray(x).nbytes for x in jax.tree.leaves(carry.learner.memory))
            seconds = []
            with tempfile.TemporaryDirectory() as place:
                run = Run.create(Path(place) / "run", trainer, 0, {})
                for number in range(args.repeats):
                    carry = eqx.tree_at(lambda c: c.iteration, carry, jnp.asarray(number))
                    start = time.perf_counter()
                    run.save(carry, 0.0)
                    seconds.append(time.perf_counter() - start)
            cost = statistics.median(seconds)
            share = 100 * cost / max(PATIENCE, cost / SHARE)
            row = {"agents": n, "transitions": count, "memory MB": size / 2**20}
            row |= {"save s": cost, "slowest s": max(seconds), "share %": share}
            rows.append(row)
    return harness.report("checkpoint", rows, args)


if __name__ == "__main__":
    main()
