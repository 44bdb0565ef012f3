"""Every algorithm on tiny games whose answers are known.

The three games are one object that differs in a number, so that each algorithm is compiled once.
A new algorithm is one line in ALGORITHMS.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Int

from marlyap.games.dynamics import AbstractDynamics, SingleIntegrator
from marlyap.games.planar import AbstractPlanar, Goals
from marlyap.learning.algorithms import MADDPG, MASAC, CentralisedSAC, DecentralisedSAC
from marlyap.learning.constraints.lyapunov import Lyapunov
from marlyap.learning.trainer import Schedule, Trainer
from marlyap.simulation.evaluation import outcomes
from marlyap.simulation.rollout import Decentralised
from marlyap.types import State


GAMMA, SCALE = 0.8, 2.0
QUICK = dict(
    gamma=GAMMA, reward_scale=SCALE, tau=0.05, ema_rate=0.05, rate_pi=2e-3, rate_Q=5e-3,
    batch=64, actor_width=32, critic_width=32,
)  # fmt: skip
COLD = dict(alpha=1e-3, rate_alpha=0.0)
NEAR = dict(horizon=2, weight=1.0, rate_L=1e-2)
ALGORITHMS = {
    "masac": MASAC(**QUICK, **COLD, heads="team"),
    "masac-lyapunov": MASAC(
        **QUICK, **COLD, heads="agent", n_step=2, constraint=Lyapunov(horizon=4, weight=0.3)
    ),
    "lac": MASAC(**QUICK, **COLD, use_Q=False, constraint=Lyapunov(**NEAR)),
    "critic-only": MASAC(
        **QUICK, **COLD, use_Q=False, constraint=Lyapunov(reading="critic", **NEAR)
    ),
    "decentralised-sac": DecentralisedSAC(MASAC(**QUICK, **COLD)),
    "centralised-sac": CentralisedSAC(MASAC(**QUICK, **COLD)),
    "maddpg": MADDPG(**QUICK),
    "matd3": MADDPG(**QUICK, critics=2, smoothing=0.2, delay=2),
}
BANDIT, CONSTANT, REACH = range(3)


class Toy(AbstractPlanar):
    """Two agents, each with a goal of its own, that move as they wish.

    BANDIT: one step, reward 1 - |a - 0.4 o|^2. CONSTANT: reward 1 for ever. REACH: minus distance.
    The cost is what the reward lacks of its best.
    """

    kind: Int[Array, ""]
    agents: int = 2
    leaders: tuple[int, ...] = (0, 1)
    graph: str = "complete"
    radius: float = 0.2
    dt: float = 0.25
    horizon: int = 10
    dynamics: AbstractDynamics = SingleIntegrator()

    def reset(self, key):
        k_x, k_goal = jax.random.split(key)
        draw = lambda k: jax.random.uniform(k, (2, 2), minval=-1.0, maxval=1.0)
        return State(x=draw(k_x), scenario=Goals(draw(k_goal)), t=jnp.asarray(0))

    def observe(self, state, links):
        return state.scenario.goal - state.x

    def terminated(self, state):
        return (self.kind == BANDIT) & (state.t >= 1)

    def costs(self, state, action):
        miss = jnp.sum((action - 0.4 * self.observations(state)) ** 2, axis=1)
        bandit = jnp.where(self.kind == BANDIT, miss, 0.0)
        return jnp.where(self.kind == REACH, self.distance(state), bandit)

    def rewards(self, state, action):
        return jnp.where(self.kind == REACH, 0.0, 1.0) - self.costs(state, action)


SCHEDULE = Schedule(
    steps=1600, environments=16, steps_per_update=1, warmup=480, capacity=100_000, decay=0.3
)
KINDS = jnp.arange(3)  # all three side by side: one program, compiled once
KEYS = jax.random.split(jax.random.key(9), 200)


def each_game(f):
    """f(trainer, what) for the three games at once; every result has a leading axis `kind`."""
    trainer = lambda kind, algorithm: Trainer(Toy(kind), algorithm, SCHEDULE)
    one = lambda kind, algorithm, what: f(trainer(kind, algorithm), what)
    return eqx.filter_jit(eqx.filter_vmap(one, in_axes=(0, None, eqx.if_array(0))))


begin = each_game(lambda trainer, key: trainer.begin(key)[0])
iterate = each_game(lambda trainer, carry: trainer.iterate(carry))


@each_game
def look(trainer, networks):
    """Observations, the policy's actions there, Q of them, and the distance at the end."""
    game, algorithm = trainer.game, trainer.algorithm
    policy = algorithm.policy(networks)

    def one(key):
        state = game.reset(key)
        obs = game.observations(state)
        action = policy(obs, key)
        if isinstance(algorithm, DecentralisedSAC):  # a critic for each agent, of what it observes
            each = eqx.filter_vmap(lambda Q, o, a: Q(o[None], a[None]))
            return obs, action, jnp.mean(each(networks.Q.value, obs, action))
        return obs, action, jnp.mean(networks.Q.value(game.features(state), action))

    return *jax.vmap(one)(KEYS), outcomes(game, Decentralised(policy, game), KEYS).final


QUICKEST = ("masac", "masac-lyapunov", "matd3")
OTHERS = [pytest.param(n, marks=pytest.mark.slow) for n in ALGORITHMS if n not in QUICKEST]


@pytest.mark.parametrize("name", [*QUICKEST, *OTHERS])
def test_every_algorithm_finds_the_answers(name):
    algorithm = ALGORITHMS[name]
    carry = begin(KINDS, algorithm, jax.random.split(jax.random.key(0), 3))
    for _ in range(Trainer(Toy(KINDS[0]), algorithm, SCHEDULE).iterations):
        carry, info = iterate(KINDS, algorithm, carry)
        assert all(np.isfinite(v).all() for v in info.log.values())
    obs, action, Q, final = look(KINDS, algorithm, carry.learner.networks)

    # The best action is 0.4 o, and is worth its reward: nothing comes after termination.
    # What learns from sums of costs alone also hears of later steps; no action misses by 0.27.
    near = 0.08 if getattr(algorithm, "use_Q", True) else 0.13
    assert np.mean(np.abs(action - 0.4 * obs)[BANDIT]) < near
    assert np.mean(Q[BANDIT]) == pytest.approx(SCALE, rel=0.1)
    # Q = r / (1 - gamma): the time limit does not end the game.
    np.testing.assert_allclose(Q[CONSTANT], SCALE / (1 - GAMMA), rtol=0.06)
    # Everyone reaches its goal; deterministic policies may stop a step short, 0.25 m.
    near = 0.25 if isinstance(algorithm, MADDPG) else Toy(KINDS[0]).radius
    assert np.mean(final[REACH] <= near) > 0.9
