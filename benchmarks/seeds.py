"""How many trainings an hour: several seeds in one program, and one process a core.

One training is the tuned schedule (80 iterations: 64 episodes and 320 updates each). `vmap` trains
the seeds side by side in one program, `map` one after the other in one program, `process` gives
each its own program and core. On a GPU look at `vmap` alone (--ways vmap --seeds 1 4 32).

    python benchmarks/seeds.py
"""

import json
import os
import time

import equinox as eqx
import harness
import jax

from marlyap import MASAC, Lyapunov, Rendezvous, Schedule, Trainer


def trainer(quick):
    """What is trained."""
    if quick:
        algorithm = MASAC(batch=8, actor_width=8, critic_width=8, constraint=Lyapunov(horizon=2))
        schedule = Schedule(steps=24, environments=2, steps_per_update=4, warmup=8)
        return Trainer(Rendezvous(horizon=4), algorithm, schedule)
    return Trainer(Rendezvous(), MASAC(constraint=Lyapunov()), Schedule())


def job(trainer, way, seeds):
    """One iteration of all the seeds; the memory is kept, as in training."""
    alone = seeds == 1
    each = lambda f: f if alone else eqx.filter_vmap(f)
    keys = jax.random.split(jax.random.key(0), seeds)
    state = [eqx.filter_jit(each(trainer.begin))(keys[0] if alone else keys)[0]]

    @eqx.filter_jit(donate="all")
    def iterate(carry):
        one = lambda carry: trainer.iterate(carry)[0]
        if way != "map" or alone:
            return each(one)(carry)
        dynamic, static = eqx.partition(carry, eqx.is_array)
        step = lambda d: eqx.filter(one(eqx.combine(d, static)), eqx.is_array)
        return eqx.combine(jax.lax.map(step, dynamic), static)

    def run():
        state[0] = jax.block_until_ready(iterate(state[0]))

    return run


def child(args):
    """One training beside others: its seconds for an iteration, over `rounds` of them."""
    run = job(trainer(args.quick), "alone", 1)
    run()
    harness.ready()
    start = time.perf_counter()
    for _ in range(args.rounds):
        run()
    print(json.dumps({"seconds": (time.perf_counter() - start) / args.rounds}))


def main(argv=None):
    args = harness.arguments(
        argv, __doc__, seeds=[1, 2, 4, 16], ways=["process", "vmap", "map"], rounds=8, child=0
    )
    if args.quick:
        args.seeds, args.rounds = [1, 2], 1
    if args.child:
        return child(args)
    what = trainer(args.quick)
    rows, cores = [], sorted(os.sched_getaffinity(0))

    def add(way, seeds, seconds):
        rate = 3600 * seeds / (what.iterations * seconds)
        rows.append({"way": way, "seeds": seeds, "s/iteration": seconds, "seeds/hour": rate})

    if "process" in args.ways:
        command = [__file__, "--child", "1", "--rounds", str(args.rounds)]
        command += ["--quick"] if args.quick else []
        for n in {1, len(cores)} if not args.quick else {1}:
            answers = harness.children([command] * n, cores[:n])
            add("process", n, max(a["seconds"] for a in answers))
    jobs = {}
    for way in args.ways:
        for n in args.seeds:
            if way != "process" and (n > 1 or way == "vmap"):
                harness.note(f"compiling {way} over {n} seeds")
                jobs["alone" if n == 1 else way, n] = job(what, way, n)
    for (way, n), t in harness.turns(jobs, args.rounds).items():
        add(way, n, t.median)
    for row in rows:
        row["to one"] = row["seeds/hour"] / rows[0]["seeds/hour"]
    return harness.report("seeds", rows, args)


if __name__ == "__main__":
    main()
