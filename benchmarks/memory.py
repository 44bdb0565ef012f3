"""How much memory a training takes: the whole process, and what it is made of.

`learner` and `memory` are the arrays that training carries (the replay memory with room for the
whole run), `scratch` is what XLA sets aside for an iteration; each team is a process of its own.

    python benchmarks/memory.py
"""

import json
import sys

import harness


def child(args):
    """One training, two iterations."""
    import equinox as eqx
    import jax

    from marlyap import MASAC, Lyapunov, Rendezvous, Schedule, Trainer

    size = lambda tree: sum(x.nbytes for x in jax.tree.leaves(tree) if hasattr(x, "nbytes")) / 2**20
    quick = {"steps": 24, "environments": 2, "steps_per_update": 4, "warmup": 8}
    game = Rendezvous(agents=args.agents[0], horizon=4 if args.quick else 40)
    trainer = Trainer(game, MASAC(constraint=Lyapunov()), Schedule(**(quick if args.quick else {})))
    carry, _ = eqx.filter_jit(trainer.begin)(jax.random.key(0))
    iterate = eqx.filter_jit(trainer.iterate, donate="all").lower(carry).compile()
    parts = {"learner MB": size(carry.learner.networks), "memory MB": size(carry.learner.memory)}
    scratch = iterate.compiled.memory_analysis().temp_size_in_bytes / 2**20
    for _ in range(2):
        carry = jax.block_until_ready(iterate(carry)[0])
    print(json.dumps(parts | {"scratch MB": scratch, "peak MB": harness.peak()}))


def main(argv=None):
    args = harness.arguments(argv, __doc__, agents=[3, 5, 16], child=0)
    if args.quick:
        args.agents = args.agents[:1]
    if args.child:
        return child(args)
    rows = [{"agents": "none, imports alone", "peak MB": harness.peak()}]
    for n in args.agents:
        harness.note(f"{n} agents")
        command = [sys.executable, __file__, "--child", "1", "--agents", str(n)]
        said = harness.usage(command + ["--quick"] * args.quick)["said"]
        rows.append({"agents": n} | json.loads(said.splitlines()[-1]))
    return harness.report("memory", rows, args)


if __name__ == "__main__":
    main()
