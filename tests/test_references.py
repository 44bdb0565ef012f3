"""The reference algorithms: what each agent learns from, and the rules of their papers by hand."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import filled, same, shrunk
from scipy import stats

from marlyap.errors import UserError
from marlyap.learning.algorithms import (
    ALGORITHMS,
    MADDPG,
    MASAC,
    PRESETS,
    CentralisedSAC,
    DecentralisedSAC,
)
from marlyap.learning.algorithms.sac import alone, joint
from marlyap.learning.constraints import Lyapunov
from marlyap.learning.optimiser import TrainState
from marlyap.learning.schedule import Schedule
from marlyap.learning.source import shape as nets_shape
from marlyap.learning.trainer import Trainer
from marlyap.nets.nets import Actors, Noisy, Sample
from marlyap.runs.run import Run, flatten
from marlyap.storage import store
from marlyap.tasks.rendezvous import Rendezvous


KEY = jax.random.key(4)
SMALL = dict(actor_width=4, critic_width=4, batch=16)
ONE = jnp.ones(())
step = eqx.filter_jit(lambda rule, l, b: rule.update(l, b, ONE)[0])


def at(tree, i):
    return jax.tree.map(lambda x: x[i] if eqx.is_array(x) else x, tree)


HANDED = {"masac-lyapunov", "decentralised-sac", "centralised-sac", "apg"}  # each kind of policy
LIKE_THEM = (pytest.param(name, marks=pytest.mark.slow) for name in sorted({*ALGORITHMS} - HANDED))


@pytest.mark.parametrize("name", [*sorted(HANDED), *LIKE_THEM])
def test_what_is_handed_out_is_read_back(name, tmp_path):
    """The policy of a run is rebuilt from shapes alone before its arrays are read."""
    algorithm = ALGORITHMS[name]
    algorithm, game = shrunk(algorithm, actor_width=4, critic_width=4), Rendezvous(horizon=40)
    run = Run.create(tmp_path / "run", Trainer(game, algorithm, Schedule()), 0, {})
    learner = eqx.filter_jit(algorithm.init)(nets_shape(game), KEY)
    handed = (algorithm.policy(learner), algorithm.lyapunov(learner))
    store.write(run.directory / "policy", "policy", flatten(handed), {})
    assert eqx.tree_equal(run.deployed(), handed)
    action = run.controller().policy(jnp.zeros((3, nets_shape(game).obs)), KEY)
    assert action.shape == (3, 2)


def test_alone_an_agent_has_its_own_row_and_observes_the_state(batch):
    b = at(batch, 3)
    own = alone(b, jnp.asarray(1))
    for name in ("obs", "action", "reward", "cost", "next_obs", "log_prob", "cost_to_go"):
        np.testing.assert_array_equal(getattr(own, name), getattr(b, name)[1:2])
    np.testing.assert_array_equal(own.features, b.obs[1:2])
    np.testing.assert_array_equal(own.next_features, b.next_obs[1:2])
    assert own.discount == b.discount


def test_decentralised_agents_learn_nothing_from_each_other(shape, batch):
    rule = DecentralisedSAC(MASAC(**SMALL))
    learner = eqx.filter_jit(rule.init)(shape, KEY)
    fields = ("obs", "features", "action", "reward", "next_obs", "next_features")
    change = lambda x: x.at[:, 2].multiply(0.5)
    other = eqx.tree_at(
        lambda b: [getattr(b, f) for f in fields],
        batch,
        [change(getattr(batch, f)) for f in fields],
    )
    a, b = step(rule, learner, batch), step(rule, learner, other)
    assert same(at(a, 0), at(b, 0)) and same(at(a, 1), at(b, 1))
    assert not same(at(a, 2).Q.value, at(b, 2).Q.value)
    assert not same(at(a, 0).Q.value, at(learner, 0).Q.value)
    # Together they are one decentralised policy: to each agent its own actor.
    policy = rule.policy(a)
    got = policy(batch.obs[0], KEY)
    for i in range(3):
        np.testing.assert_allclose(got[i : i + 1], at(a, i).pi_mean.mode(batch.obs[0, i : i + 1]))
    assert rule.lyapunov(a) is None


def test_centralised_agents_see_everything(shape, batch):
    obs = batch.obs[0]
    np.testing.assert_array_equal(joint(obs), np.tile(np.ravel(obs), (3, 1)))
    rule = CentralisedSAC(MASAC(**SMALL))
    learner = filled(rule.init, shape, KEY)
    for policy in (rule.policy(learner), rule.explore(learner)):
        moved = policy(obs.at[2].add(1.0), KEY) != policy(obs, KEY)
        assert np.all(np.any(moved, axis=1))
    explorer = rule.explore(learner)
    assert explorer.log_prob(obs, explorer(obs, KEY)).shape == (3,)
    after = step(rule, learner, batch)
    assert not same(after.pi.value, learner.pi.value)


@pytest.mark.parametrize("critics", [1, 2])
def test_the_target_of_deterministic_critics(shape, batch, critics):
    rule = MADDPG(**SMALL, critics=critics, reward_scale=3.0)
    l, b = filled(rule.init, shape, KEY), at(batch, 5)
    values = np.asarray(l.Q_bar(b.next_features, b.action))
    y = 3.0 * np.asarray(b.reward) + float(b.discount) * values.min(axis=0)
    error = np.asarray(l.Q.value(b.features, b.action)) - y
    assert error.shape == (critics, 3)
    want = 0.5 * np.sum(np.mean(error**2, axis=1))
    np.testing.assert_allclose(rule.J_Q(l.Q.value, l, b, b.action), want, rtol=1e-5)


def test_matd3_moves_its_actors_every_second_time(shape, batch):
    rule = dataclasses.replace(ALGORITHMS["matd3"], **SMALL)
    l = filled(rule.init, shape, KEY)
    fresh = lambda learnt: TrainState.of(learnt.value)
    l = eqx.tree_at(lambda l: (l.pi, l.Q), l, (fresh(l.pi), fresh(l.Q)))
    once = step(rule, l, batch)
    slow = lambda l: (l.pi, l.pi_bar, l.pi_mean, l.Q_bar)
    assert same(slow(once), slow(l)) and not same(once.Q.value, l.Q.value)
    twice = step(rule, once, batch)
    assert all(not same(a, b) for a, b in zip(slow(twice), slow(once), strict=True))
    assert int(twice.updates) == 2


def test_noise_in_play(shape, batch):
    policy = Noisy(filled(lambda k: Actors(shape, 4, key=k), KEY), 0.3)
    obs, mode = batch.obs[0], policy.pi.mode(batch.obs[0])
    many = jax.vmap(lambda k: policy(obs, k))(jax.random.split(KEY, 2000))
    assert np.max(np.abs(many)) <= 1
    inside = np.abs(mode) < 0.3
    np.testing.assert_allclose(np.std(many, axis=0)[inside], 0.3, rtol=0.1)
    want = stats.norm.logpdf(batch.action[0], mode, 0.3).sum(axis=1)
    np.testing.assert_allclose(policy.log_prob(obs, batch.action[0]), want, rtol=1e-4)


def test_the_control_minimises_the_sum_of_costs_itself(shape, batch):
    constraint = Lyapunov(reading="critic", weight=0.7)
    L, b = filled(constraint.init, shape, KEY), at(batch, 2)
    other = at(batch, 3).action
    sample = lambda a: Sample(a, jnp.zeros(3), jnp.zeros(3))
    got = constraint.penalty(L, b, sample(other), sample(b.action))
    np.testing.assert_allclose(got, 0.7 * L.net.value(b.features, other), rtol=1e-6)


def test_presets_of_the_references():
    for name, rule in ALGORITHMS.items():
        assert PRESETS["tuned"](rule) is rule
        if not isinstance(rule, MASAC | MADDPG):
            continue
        plain = PRESETS["paper"](rule)
        assert (plain.normalise, plain.heads, plain.ema_rate) == (False, "team", 1.0), name
    for name in ("decentralised-sac", "centralised-sac"):
        assert PRESETS["paper"](ALGORITHMS[name]).sac == PRESETS["paper"](MASAC())
    assert PRESETS["paper"](ALGORITHMS["critic-only"]).constraint.weight == 1.0
    assert PRESETS["paper"](ALGORITHMS["matd3"]).critics == 2


@pytest.mark.parametrize(
    "make, start",
    [
        (lambda: MADDPG(noise=0.0), "noise:"),
        (lambda: MADDPG(critics=3), "critics:"),
        (lambda: MADDPG(delay=0), "delay:"),
        (lambda: DecentralisedSAC(MASAC(shared=True)), "sac.shared:"),
        (lambda: DecentralisedSAC(MASAC(constraint=Lyapunov())), "sac.constraint:"),
        (lambda: CentralisedSAC(MASAC(shared=True)), "sac.shared:"),
        (lambda: Lyapunov(reading="critic", function="norm"), "function:"),
    ],
)
def test_what_makes_no_sense_is_refused(make, start):
    with pytest.raises(UserError) as error:
        make()
    assert str(error.value).startswith(start)
