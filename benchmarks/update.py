"""How fast is one update, and how far from the least time its arithmetic could take?

MASAC and MASAC with the Lyapunov term at the paper's sizes (3 and 5 agents, 64x64 networks, 256
transitions), on one core. Per algorithm and team:

needed    multiplications and additions in the matrix products of one update, counted by hand
done      the same in the program that XLA made; more than needed is work done twice or for nothing
xla       XLA's own count for that program, all other arithmetic included
floor     the time `needed` takes at the speed of one large matrix product on this core, by
          whichever of XLA's kernels is the faster at it
products  the time the update's own products take, each measured alone: its own floor

    python benchmarks/update.py --core 0
"""

from collections import Counter

import harness

from marlyap import MASAC, Lyapunov, Rendezvous
from marlyap.learning.algorithms import PRESETS
from marlyap.learning.source import shape
from marlyap.nets.nets import Shape


def needed(algorithm: MASAC, s: Shape) -> float:
    """Multiplications and additions of one update, by hand: 2 for each weight and transition.

    A pass back to the parameters costs twice a pass forward, less the gradient of the input in the
    first layer; a pass back to the input alone costs one pass forward.
    """
    width, joint = algorithm.actor_width, s.agents * (s.features + s.du)
    heads = s.agents if algorithm.heads == "agent" else 1
    actor = [s.obs, width, width, 2 * s.du]
    critic = [joint, algorithm.critic_width, algorithm.critic_width, heads]
    L = [joint, 64, 64, 16]

    forward = lambda sizes: 2 * sum(a * b for a, b in zip(sizes[:-1], sizes[1:], strict=True))
    first = lambda sizes: 2 * sizes[0] * sizes[1]
    learn = lambda sizes: 3 * forward(sizes) - first(sizes)  # forward, back to the parameters
    through = lambda sizes: 2 * forward(sizes)  # forward, back to the input

    one = s.agents * (learn(actor) + forward(actor))  # a at s, and a' at s'
    one += 2 * (forward(critic) + learn(critic) + through(critic))  # y, J_Q, J_pi
    if isinstance(algorithm.constraint, Lyapunov):
        one += s.agents * (learn(actor) - forward(actor))  # J_pi reaches the actors through a' too
        one += learn(L) + through(L)  # J_L, and L(s', a')
    return float(algorithm.batch * one)


def main(argv=None):
    args = harness.arguments(
        argv, __doc__, agents=[3, 5], presets=["tuned", "paper"], rounds=40, count=20
    )
    if args.quick:
        args.agents, args.presets, args.rounds, args.count = [2], ["tuned"], 2, 2
    size = 256 if args.quick else 2048
    smaller = {"batch": 16, "actor_width": 8, "critic_width": 8} if args.quick else {}

    cases = {}
    for preset in args.presets:
        for n in args.agents:
            for name, constraint in (("masac", {}), ("masac-lyapunov", {"constraint": Lyapunov()})):
                plain = MASAC(**smaller, **constraint)
                algorithm = PRESETS[preset](plain)
                game = Rendezvous(agents=n)
                harness.note(f"compiling {name}, {n} agents, {preset}")
                cases[preset, n, name] = (
                    harness.updates(game, algorithm, args.count, 4 if args.quick else 64),
                    needed(algorithm, shape(game)),
                )

    squares, operations = harness.ceilings(size)
    kinds = Counter()
    for case, _ in cases.values():
        kinds |= case.products
    repeats = 2 if args.quick else 100
    singles = {p: p.job(repeats) for p in kinds}
    jobs = {case: updates.run for case, (updates, _) in cases.items()}
    times = harness.turns(squares | jobs | singles, args.rounds)

    top = operations / min(times[name].cpu for name in squares)
    rows = []
    for (preset, n, name), (case, arithmetic) in cases.items():
        time = times[preset, n, name].per(case.count)
        own = sum(times[p].per(repeats).cpu * count for p, count in case.products.items())
        plain = times[preset, n, "masac"].per(case.count)
        rows.append(
            {
                "preset": preset,
                "agents": n,
                "algorithm": name,
                "updates/s": 1 / time.median,
                "best": 1 / time.best,
                "by cpu": 1 / time.cpu,
                "needed MFLOP": arithmetic / 1e6,
                "done MFLOP": harness.flops(case.products) / 1e6,
                "xla MFLOP": case.xla / 1e6,
                "floor us": 1e6 * arithmetic / top,
                "of floor": arithmetic / top / time.cpu,
                "products us": 1e6 * own,
                "of products": own / time.cpu,
                "to plain": time.cpu / plain.cpu,
            }
        )
    return harness.report(
        "update",
        rows,
        args,
        batch=MASAC().batch if not args.quick else 16,
        gflops={name: operations / times[name].cpu / 1e9 for name in squares},
    )


if __name__ == "__main__":
    main()
