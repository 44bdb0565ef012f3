"""How many steps of one environment a second, all agents together: one environment and many.

A step is the dynamics, every agent's observation, the cost and the reward, under actions drawn at
random; whole episodes inside one compiled program, on one core with --core.

    python benchmarks/environment.py --core 0
"""

import equinox as eqx
import harness
import jax

from marlyap import Decentralised, Rendezvous
from marlyap.simulation.rollout import Uniform, rollout


def job(game, environments, episodes):
    """`episodes` episodes one after another in each of `environments` environments."""

    @eqx.filter_jit
    def play(game, controller, key):
        def one(key):
            k_start, k_act = jax.random.split(key)
            out = rollout(game, controller, game.reset(k_start), k_act)
            return out.reward.sum() + out.cost.sum()

        side_by_side = lambda _, k: (None, jax.vmap(one)(jax.random.split(k, environments)))
        return jax.lax.scan(side_by_side, None, jax.random.split(key, episodes))[1]

    controller = Decentralised(Seeing(Uniform(game.dynamics.du)), game)
    return lambda: jax.block_until_ready(play(game, controller, jax.random.key(0)))


class Seeing(eqx.Module):
    """Random actions that look at the observation, so that it has to be made."""

    policy: Uniform

    def __call__(self, obs, key):
        return self.policy(obs, key) + 1e-9 * obs.sum(axis=1, keepdims=True)


def main(argv=None):
    args = harness.arguments(
        argv, __doc__, agents=[3, 5, 32], environments=[1, 64, 1024, 8192], rounds=4
    )
    if args.quick:
        args.agents, args.environments, args.rounds = [2], [1, 2], 2
    horizon = 3 if args.quick else 40
    jobs, steps = {}, {}
    for n in args.agents:
        for many in args.environments:
            episodes = 1 if args.quick else max(1, 256 // many)
            jobs[n, many] = job(Rendezvous(agents=n, horizon=horizon), many, episodes)
            steps[n, many] = many * episodes * horizon
    times = harness.turns(jobs, args.rounds)
    rows = [
        {
            "agents": n,
            "environments": many,
            "steps/s": steps[n, many] / t.median,
            "best": steps[n, many] / t.best,
            "by cpu": steps[n, many] / t.cpu,
        }
        for (n, many), t in times.items()
    ]
    return harness.report("environment", rows, args)


if __name__ == "__main__":
    main()
