"""Every algorithm on tiny games whose answers are known.

The three games are one object that differs in a number, so that each algorithm is compiled once.
A new algorithm is one line in ALGORITHMS.
"""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Int

from marlyap.algorithms.masac import MASAC
from marlyap.constraints.lyapunov import Lyapunov
from marlyap.dynamics import AbstractDynamics, SingleIntegrator
from marlyap.evaluation import outcomes
from marlyap.game import AbstractGame
from marlyap.rollout import Decentralised
from marlyap.trainer import Schedule, Trainer
from marlyap.types import State


GAMMA, SCALE = 0.8, 2.0
QUICK = dict(
    gamma=GAMMA, reward_scale=SCALE, tau=0.05, average=0.05, rate_pi=2e-3, rate_Q=5e-3,
    alpha=1e-3, rate_alpha=0.0, batch=64, actor_width=32, critic_width=32,
)  # fmt: skip
ALGORITHMS = {
    "masac": MASAC(**QUICK, heads="team"),
    "masac-lyapunov": MASAC(
        **QUICK, heads="agent", n_step=2, constraint=Lyapunov(horizon=4, weight=0.3)
    ),
}
pytestmark = pytest.mark.usefixtures("quick_compilation")
BANDIT, CONSTANT, REACH = range(3)


class Toy(AbstractGame):
    """Two agents, each with a goal of its own, that move as they wish.

    BANDIT: one step, reward 1 - |a - 0.4 o|^2. CONSTANT: reward 1 for ever. REACH: minus distance.
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
        return State(x=draw(k_x), goal=draw(k_goal), t=jnp.asarray(0))

    def observe(self, state):
        return state.goal - state.x

    def terminated(self, state):
        return (self.kind == BANDIT) & (state.t >= 1)

    def costs(self, state, action):
        return jnp.where(self.kind == REACH, self.distance(state), 0.0)

    def rewards(self, state, action):
        miss = jnp.sum((action - 0.4 * self.observe(state)) ** 2, axis=1)
        bandit = jnp.where(self.kind == BANDIT, 1 - miss, 1.0)
        return jnp.where(self.kind == REACH, -self.distance(state), bandit)


SCHEDULE = Schedule(
    steps=1600, environments=16, steps_per_update=1, warmup=480, capacity=100_000, decay=0.3
)
begin = eqx.filter_jit(lambda trainer, key: trainer.begin(key))
iterate = eqx.filter_jit(lambda trainer, carry: trainer.iterate(carry))


def trained(algorithm, kind) -> Iterator:
    """The learner after every iteration."""
    trainer = Trainer(Toy(jnp.asarray(kind)), algorithm, SCHEDULE)
    carry = begin(trainer, jax.random.key(0))
    for _ in range(trainer.iterations):
        carry, info = iterate(trainer, carry)
        assert all(np.isfinite(v).all() for v in info.values())
        yield carry.learner


@eqx.filter_jit
def look(algorithm, learner, game, keys):
    """Observations, the policy's actions there, and Q of them, at random starts."""

    def one(key):
        state = game.reset(key)
        obs = game.observe(state)
        action = algorithm.exploit(learner)(obs, key)
        return obs, action, jnp.mean(learner.Q.value(game.features(state), action))

    return jax.vmap(one)(keys)


KEYS = jax.random.split(jax.random.key(9), 200)
every_algorithm = pytest.mark.parametrize("name", ALGORITHMS)


@every_algorithm
def test_one_step_game(name):
    """The best action is 0.4 o, and is worth its reward: nothing comes after termination."""
    algorithm = ALGORITHMS[name]
    *_, learner = trained(algorithm, BANDIT)
    obs, action, Q = look(algorithm, learner, Toy(jnp.asarray(BANDIT)), KEYS)
    assert np.mean(np.abs(action - 0.4 * obs)) < 0.08
    assert np.mean(Q) == pytest.approx(SCALE, rel=0.1)


@every_algorithm
def test_constant_reward(name):
    """Q = r / (1 - gamma): the time limit does not end the game."""
    algorithm = ALGORITHMS[name]
    *_, learner = trained(algorithm, CONSTANT)
    _, _, Q = look(algorithm, learner, Toy(jnp.asarray(CONSTANT)), KEYS)
    np.testing.assert_allclose(Q, SCALE / (1 - GAMMA), rtol=0.06)


@every_algorithm
def test_reach(name):
    algorithm, game = ALGORITHMS[name], Toy(jnp.asarray(REACH))
    *_, learner = trained(algorithm, REACH)
    seen = outcomes(game, Decentralised(algorithm.exploit(learner), game), KEYS)
    assert np.mean(np.asarray(seen.final) <= game.radius) > 0.9
