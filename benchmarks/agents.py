"""What an update costs as the team grows, on a path: joint and mean-field critics, shared actors.

`growth` compares the cost with that of the smallest team, in units of their sizes: 1 is linear.
Each agent sees two neighbours, so that an observation has one size.

    python benchmarks/agents.py --core 0
"""

import harness

from marlyap import MASAC, Lyapunov, Rendezvous


def main(argv=None):
    args = harness.arguments(
        argv,
        __doc__,
        agents=[3, 8, 32, 128, 256],
        critics=["mean-field", "joint"],
        rounds=10,
        count=5,
    )
    smaller = {}
    if args.quick:
        args.agents, args.critics, args.rounds, args.count = [2, 4], ["mean-field"], 1, 1
        smaller = {"batch": 8, "actor_width": 8, "critic_width": 8}
    cases = {}
    for critic in args.critics:
        for n in args.agents:
            for name, extra in (("masac", {}), ("masac-lyapunov", {"constraint": Lyapunov()})):
                if args.quick and extra:
                    continue
                harness.note(f"compiling {name}, {n} agents, {critic}")
                game = Rendezvous(agents=n, graph="path/2", horizon=4 if args.quick else 40)
                algorithm = MASAC(shared=True, critic=critic, **smaller, **extra)
                cases[critic, name, n] = harness.updates(game, algorithm, args.count, 4)
    times = harness.turns({case: u.run for case, u in cases.items()}, args.rounds)
    rows = []
    for (critic, name, n), case in cases.items():
        few = min(args.agents)
        least = times[critic, name, few].cpu
        time = times[critic, name, n].per(case.count)
        rows.append(
            {
                "critic": critic,
                "algorithm": name,
                "agents": n,
                "updates/s": 1 / time.median,
                "by cpu": 1 / time.cpu,
                "scratch MB": case.memory / 2**20,
                "growth": times[critic, name, n].cpu / least / (n / few),
            }
        )
    return harness.report("agents", rows, args)


if __name__ == "__main__":
    main()
