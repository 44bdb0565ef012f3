"""What lets the number of agents grow, and change after training."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import close, filled
from test_paper import mlp, rows, xs

from marlyap import train
from marlyap.errors import UserError
from marlyap.learning import optimiser
from marlyap.learning.algorithms.masac import MASAC
from marlyap.learning.constraints.lyapunov import Lyapunov
from marlyap.learning.trainer import Schedule, Trainer
from marlyap.nets.nets import Actors, MeanFieldCritic
from marlyap.runs.run import Run
from marlyap.tasks.rendezvous import Rendezvous


KEY = jax.random.key(3)
TINY = dict(batch=8, actor_width=8, critic_width=8)


def plainly(Q, features, action, xp=np):
    """Each twin's value of each agent: its own row beside the mean of the others' rows."""
    x = xp.concatenate([features, action], axis=1)
    n = x.shape[0]
    others = [xp.stack([x[j] for j in range(n) if j != i]).mean(0) for i in range(n)]
    value = lambda k, i: mlp(Q.nets, xp.concatenate([x[i], others[i]]), (k,), xp)[0]
    each = xp.stack([xp.stack([value(k, i) for i in range(n)]) for k in (0, 1)])
    return each.mean(1, keepdims=True) if Q.team else each


def test_agents_of_one_kind_share_weights(shape, batch):
    kinds = shape._replace(kinds=(1, 0, 1))
    shared, own = (filled(lambda k, s=s: Actors(kinds, 8, s, key=k), KEY) for s in (True, False))
    assert shared.net.layers[0].weight.shape[0] == 2 and own.net.layers[0].weight.shape[0] == 3
    alike = jnp.tile(batch.obs[0, :1], (3, 1))
    action = jax.jit(lambda obs: shared.mode(obs))(alike)
    np.testing.assert_allclose(action[0], action[2], rtol=1e-6)
    assert np.all(np.abs(action[0] - action[1]) > 1e-3)
    noise = 0.3 * jnp.ones((3, 2))
    for i, kind in enumerate(kinds.kinds):
        net = jax.tree.map(lambda leaf, k=kind: leaf[k][None], shared.net)
        alone = eqx.tree_at(lambda a: (a.net, a.shared), shared, (net, False))
        ours = eqx.filter_jit(shared.sample)(alike, noise, noise)
        theirs = eqx.filter_jit(alone.sample)(alike[:1], noise[:1], noise[:1])
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(a[i], b[0], rtol=1e-5, atol=1e-6)


class Mixed(Rendezvous):
    """A leader of another kind than its followers."""

    @property
    def kinds(self):
        return np.where(self.leads, 1, 0)


def test_a_policy_of_several_kinds_trains():
    algorithm = MASAC(**TINY, shared=True)
    plan = Schedule(steps=24, environments=2, steps_per_update=3, warmup=6, select_episodes=2)
    trained = train(Mixed(horizon=3), algorithm, plan, progress=False)
    assert trained.policy.pi.shared == (1, 0, 0)
    assert trained.policy.pi.net.layers[0].weight.shape[0] == 2


@pytest.mark.parametrize("team", [False, True])
def test_mean_field_critic_value_and_gradient(team, shape, batch):
    Q = filled(lambda k: MeanFieldCritic(shape, 8, team, True, key=k), KEY)
    values = eqx.filter_jit(jax.vmap(Q))(batch.features, batch.action)
    for k, b in enumerate(rows(batch)):
        np.testing.assert_allclose(
            values[k], plainly(Q, b.features, b.action), rtol=1e-3, atol=1e-4
        )

    few = jax.tree.map(lambda a: a[:3], (batch.features, batch.action))
    total = lambda f: lambda Q, x: jnp.sum(jnp.sin(jax.vmap(lambda f_, a: f(Q, f_, a))(*x)))
    ours = eqx.filter_jit(eqx.filter_grad(total(lambda Q, f, a: Q(f, a))))(Q, few)
    plain = eqx.filter_jit(eqx.filter_grad(total(lambda Q, f, a: plainly(Q, f, a, jnp))))(Q, few)
    close(ours, plain, rtol=1e-3, atol=1e-4)


def test_to_exchange_agents_exchanges_their_values(shape, batch):
    Q = filled(lambda k: MeanFieldCritic(shape, 8, False, True, key=k), KEY)
    order = np.array([2, 0, 1])
    f, a = batch.features[0], batch.action[0]
    value = jax.jit(lambda f, a: Q(f, a))
    np.testing.assert_allclose(value(f[order], a[order]), value(f, a)[:, order], rtol=1e-5)
    assert np.ptp(value(f, a)) > 1e-2  # or the test would say nothing


def test_the_same_weights_serve_any_number_of_agents(shape):
    Q = filled(lambda k: MeanFieldCritic(shape, 8, False, True, key=k), KEY)
    pi = filled(lambda k: Actors(shape, 8, True, key=k), KEY)
    mode = eqx.filter_jit(lambda pi, o: pi.mode(o))
    for n in (1, 4):
        f, a, o = xs(n, shape.features), xs(n, shape.du), xs(n, shape.obs)
        assert eqx.filter_eval_shape(Q, f, a).shape == (2, n)
        want = [np.tanh(mlp(pi.net, o[i])[:2]) for i in range(n)]
        np.testing.assert_allclose(mode(pi, o), want, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_batch_in_parts_descends_as_the_whole(monkeypatch):
    """Large teams take a batch in parts, so that what it passes through stays in the cache."""
    assert [optimiser.parts(256, n) for n in (3, 8, 16, 32, 128, 1000)] == [1, 1, 8, 16, 64, 256]
    assert optimiser.parts(7, 1000) == 7 and optimiser.parts(250, 10) == 5
    game = Rendezvous(agents=3, horizon=4)
    algorithm = MASAC(**TINY, shared=True, critic="mean-field", constraint=Lyapunov(horizon=2))
    trainer = Trainer(game, algorithm, Schedule(steps=16, environments=2, warmup=8))
    monkeypatch.setattr(optimiser, "PART", 6)  # two transitions of three agents

    def updated(whole):
        monkeypatch.setattr(optimiser, "WHOLE", whole)
        assert optimiser.parts(algorithm.batch, game.agents) == (1 if whole > 1 else 4)

        @eqx.filter_jit
        def update(key):
            learner = trainer.begin(key)[0].learner
            batch = learner.memory.sample(key, algorithm.batch, algorithm.gamma)
            return algorithm.update(learner.networks, batch, jnp.ones(()))

        return update(KEY)

    close(updated(1), updated(10**6), rtol=1e-3, atol=1e-5)


def work(agents):
    """Floating-point operations of one update, as XLA counts them before it compiles."""
    game = Rendezvous(agents=agents, graph="path")
    algorithm = MASAC(shared=True, critic="mean-field", constraint=Lyapunov())
    trainer = Trainer(game, algorithm, Schedule(steps=40, environments=1, warmup=40))

    def update(key):
        learner = trainer.begin(key)[0].learner
        batch = learner.memory.sample(key, algorithm.batch, algorithm.gamma)
        return batch, learner.networks

    batch, learner = eqx.filter_eval_shape(update, KEY)
    dynamic, static = eqx.partition(learner, lambda x: isinstance(x, jax.ShapeDtypeStruct))

    def one(dynamic, batch):
        done, _ = algorithm.update(eqx.combine(dynamic, static), batch, jnp.ones(()))
        return eqx.filter(done, eqx.is_array)

    return jax.jit(one).lower(dynamic, batch).cost_analysis()["flops"]


def test_work_grows_no_faster_than_the_number_of_agents(monkeypatch):
    monkeypatch.setattr(optimiser, "WHOLE", 10**6)  # a loop's body counts once
    few, many = work(8), work(32)
    assert 2 < many / few < 1.05 * 32 / 8


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of three agents that share weights and have room for two neighbours."""
    trainer = Trainer(
        Rendezvous(graph="path/2", horizon=4),
        MASAC(**TINY, shared=True, critic="mean-field", heads="agent"),
        Schedule(steps=8, environments=2, steps_per_update=4, warmup=4, select_episodes=2),
    )
    run = Run.create(tmp_path_factory.mktemp("many") / "run", trainer, 0, {})
    carry, _, _ = run.load()
    run.save(eqx.filter_jit(trainer.iterate)(carry)[0], 0.0)
    return run


@pytest.mark.parametrize("agents", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_a_policy_runs_with_another_number_of_agents(run, agents):
    """What an agent does depends on what it sees alone, not on how many others there are."""
    game = replace(run.game, agents=agents)
    controller, (policy, _) = run.controller(game), run.deployed()

    @jax.jit
    def act(key):
        """What all do, and what the first does when it is asked alone."""
        state = game.reset(key)
        return controller(state, key), policy(game.observations(state)[:1], key)

    together, alone = act(KEY)
    assert together.shape == (agents, 2)
    np.testing.assert_allclose(together[0], alone[0], rtol=1e-5)


@pytest.mark.parametrize("change", [{"graph": "path/3"}, {"graph": "complete"}])
def test_another_observation_is_refused(run, change):
    with pytest.raises(UserError, match=r"^task: .*does not fit 5 agents that observe"):
        run.controller(replace(run.game, agents=5, **change))
