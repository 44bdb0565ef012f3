"""Advantages are what the sums say, every step is used, and the algorithm of the docs learns."""

from collections import Counter
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import close
from jaxtyping import Array
from test_docs import blocks
from test_toy_games import CONSTANT, REACH, Toy

from marlyap.learning.algorithm import KeyPair
from marlyap.learning.algorithms import MASAC
from marlyap.learning.on_policy import AbstractOnPolicy, advantages
from marlyap.learning.schedule import Schedule
from marlyap.learning.source import CostWindow
from marlyap.learning.trainer import Trainer
from marlyap.simulation.evaluation import outcomes
from marlyap.simulation.rollout import Decentralised, Uniform


PAGE = Path(__file__).parents[1] / "docs" / "add-an-algorithm.md"
KEY = jax.random.key(4)


@pytest.fixture(scope="module")
def ActorCritic():
    """The class that the page defines."""
    names: dict = {"__name__": "page"}
    exec(compile(blocks(PAGE)[0], PAGE.name, "exec"), names)
    return names["ActorCritic"]


@pytest.mark.parametrize("trace", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("end", [None, 2])
def test_advantages_are_sums_of_surprises(trace, end):
    rng, gamma, time = np.random.default_rng(0), 0.9, 5
    reward, value = rng.standard_normal((time, 2)), rng.standard_normal((time + 1, 2))
    terminated = np.arange(time) >= (time if end is None else end)
    want = np.zeros((time, 2))
    for t in range(time):
        for k in range(t, time):
            last = 0.0 if terminated[k] else gamma * value[k + 1]
            want[t] += (gamma * trace) ** (k - t) * (reward[k] + last - value[k])
            if terminated[k]:
                break
    got = advantages(jnp.asarray(reward), jnp.asarray(value), jnp.asarray(terminated), gamma, trace)
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)
    if trace == 1:  # the rewards that follow, and at the time limit the value, less the value
        stop = time if end is None else end + 1
        total = sum(gamma**k * reward[k] for k in range(stop))
        total += gamma**time * value[-1] if end is None else 0.0
        np.testing.assert_allclose(got[0], total - value[0], rtol=1e-5)


class Counting(AbstractOnPolicy):
    """Its networks are a table of how often each step was used, found by its first action."""

    gamma: float = 0.9
    trace: float = 0.9
    batch: int = 7
    epochs: int = 3

    def init(self, shape, key):
        return jnp.zeros((64, 2))

    def values(self, networks, obs, features):
        return jnp.ones(2)

    def update(self, networks, b, decay):
        first = jnp.argmin(networks[:, 0] != 0)  # the first free row
        rows = first + jnp.arange(b.weight.shape[0])
        used = jnp.stack([b.action[:, 0, 0], b.weight], axis=1)
        return networks.at[rows].set(used), {"size": jnp.asarray(float(b.weight.shape[0]))}

    def explore(self, networks):
        return Uniform(2)

    def policy(self, networks):
        return Uniform(2)

    def lyapunov(self, networks):
        return None


def test_every_epoch_goes_through_the_steps_in_another_order():
    """Two episodes of ten steps: two minibatches of seven an epoch, and six steps left over."""
    trainer = Trainer(Toy(jnp.asarray(CONSTANT)), Counting(), Schedule(environments=2, steps=40))
    assert trainer.updates_per_iteration == 3 * 2
    carry, health = trainer.begin(KEY)
    assert health.by_task(2) is None and not np.any(carry.learner)
    after, info = eqx.filter_jit(trainer.iterate)(carry)
    assert float(info.log["size"]) == 7 and float(info.log["return"]) == pytest.approx(10)
    used = np.asarray(after.learner)[:42]
    epochs = used[:, 0].reshape(3, 14)
    assert all(len(set(epoch)) == 14 for epoch in epochs)
    assert Counter(used[:, 0]).most_common()[0][1] <= 3
    assert not np.array_equal(epochs[0], epochs[1])
    np.testing.assert_allclose(used[:, 1], 1.0)


def test_nothing_is_learnt_from_what_follows_termination():
    """The bandit ends after one step of ten; its weight is then ten."""
    trainer = Trainer(Toy(jnp.asarray(0)), Counting(), Schedule(environments=2, steps=40))
    episodes = eqx.filter_jit(lambda: trainer.play(Uniform(2), KEY, 3))()
    judged = trainer.algorithm.judge(jnp.zeros(()), episodes)
    weight = np.asarray(judged.weight).reshape(3, 10)
    np.testing.assert_allclose(weight[:, 0], 10)
    assert not weight[:, 1:].any()
    np.testing.assert_allclose(judged.target.reshape(3, 10, 2)[:, 0], episodes.reward[:, 0], 1e-5)


def test_the_algorithm_of_the_page_learns(ActorCritic):
    algorithm = ActorCritic(batch=160, epochs=8, gamma=0.8, width=32, rate_pi=3e-3)
    game = Toy(jnp.asarray(REACH))
    trainer = Trainer(game, algorithm, Schedule(environments=64, steps=64 * 10 * 30))
    carry, _ = eqx.filter_jit(trainer.begin)(KEY)
    iterate = eqx.filter_jit(trainer.iterate)
    starts = jax.random.split(jax.random.key(9), 200)

    @eqx.filter_jit
    def final(networks):
        return outcomes(game, Decentralised(algorithm.policy(networks), game), starts).final

    before, returns = final(carry.learner), []
    for _ in range(trainer.iterations):
        carry, info = iterate(carry)
        returns.append(float(info.log["return"]))
    after = final(carry.learner)
    assert np.mean(returns[-5:]) > np.mean(returns[:5]) + 1
    assert np.median(after) < 0.5 * np.median(before)
    assert int(info.health.networks) == 0


@pytest.mark.parametrize("name", ["off-policy", "on-policy"])
def test_episodes_may_be_handed_in(name, ActorCritic):
    """What a host needs: explore, play elsewhere, learn. It is the iteration, up to rounding."""
    small = dict(batch=8, gamma=0.9)
    algorithm = (
        MASAC(**small, actor_width=4, critic_width=4)
        if name == "off-policy"
        else ActorCritic(**small, width=4)
    )
    schedule = Schedule(environments=2, steps=40, steps_per_update=4, warmup=20)
    trainer = Trainer(Toy(jnp.asarray(REACH)), algorithm, schedule)
    carry, _ = eqx.filter_jit(trainer.begin)(KEY)
    keys = KeyPair(*jax.random.split(KEY))
    one: Array = jnp.ones(())

    @eqx.filter_jit
    def iterate(learner):
        return algorithm.iterate(learner, trainer.play, keys, one)

    @eqx.filter_jit
    def host(learner):
        explorer = algorithm.explore(algorithm.networks(learner))
        return trainer.play(explorer, keys.play, 2, CostWindow())

    @eqx.filter_jit
    def learn(learner, episodes):
        return algorithm.learn(learner, episodes, schedule, keys.learn, one)

    whole, info = iterate(carry.learner)
    apart, log, _ = learn(carry.learner, host(carry.learner))
    close(whole, apart, rtol=1e-5, atol=1e-6)
    assert set(log) == {*info.log} - {"return"}
