"""Every objective and every step of the algorithms against the equations, written out plainly.

The reference networks below are per sample and per agent; with xp=np they run in float64.
"""

import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from conftest import close, filled, level, same
from scipy import stats

from marlyap.errors import UserError
from marlyap.learning.algorithms import MASAC
from marlyap.learning.constraint import Unconstrained
from marlyap.learning.constraints.lyapunov import LearnedLyapunov, Lyapunov
from marlyap.learning.constraints.readings import distance
from marlyap.learning.optimiser import TrainState, polyak
from marlyap.learning.trainer import Schedule, Trainer
from marlyap.nets.nets import MLP, Actors, Critic, Greedy, LyapunovNet, NormNet, Sampled, Shape
from marlyap.simulation.rollout import Decentralised, cost_to_go, rollout
from marlyap.tasks import TASKS


KEY = jax.random.key(5)


# The networks, plainly.


def mlp(net, x, index=(), xp=np):
    """One net of a stack: W x + b, LayerNorm where there is one, ReLU but at the end."""
    number = (lambda a: np.asarray(a, np.float64)[index]) if xp is np else (lambda a: a[index])
    for k, layer in enumerate(net.layers):
        x = number(layer.weight) @ x + number(layer.bias)
        if layer.norm is not None:
            gain, offset = number(layer.norm[0]), number(layer.norm[1])
            x = (x - xp.mean(x)) / xp.sqrt(xp.mean((x - xp.mean(x)) ** 2) + 1e-5) * gain + offset
        if k < len(net.layers) - 1:
            x = xp.maximum(x, 0)
    return x


def gaussian(pi, i, obs, xp=np):
    """Mean and standard deviation of agent i before tanh."""
    out = mlp(pi.net, obs[i], () if pi.shared else (i,), xp)
    return out[: pi.du], xp.exp(xp.clip(out[pi.du :], -5, 2))


def act(pi, obs, noise, xp=np):
    """All agents' actions, and log pi_i of them: the change of variables for tanh."""
    actions, log_probs = [], []
    for i in range(obs.shape[0]):
        mean, std = gaussian(pi, i, obs, xp)
        a = xp.tanh(mean + std * noise[i])
        normal = -0.5 * noise[i] ** 2 - xp.log(std) - 0.5 * np.log(2 * np.pi)
        log_probs.append(xp.sum(normal - xp.log(1 - a**2)))
        actions.append(a)
    return xp.stack(actions), xp.stack(log_probs)


def log_prob_of(pi, obs, action):
    """log pi_i of given actions."""
    result = []
    for i in range(obs.shape[0]):
        mean, std = gaussian(pi, i, obs)
        a = np.asarray(action[i], np.float64)
        result.append(np.sum(stats.norm.logpdf(np.arctanh(a), mean, std) - np.log(1 - a**2)))
    return np.array(result)


def twins(Q, features, action, xp=np):
    x = xp.concatenate([features.ravel(), action.ravel()])
    return xp.stack([mlp(Q.nets, x, (j,), xp) for j in (0, 1)])


def lyapunov(L, features, action, xp=np):
    out = mlp(L.net, xp.concatenate([features.ravel(), action.ravel()]), (), xp)
    return xp.sum(xp.maximum(out, 0) ** 2)


def norm_like(V, features):
    e = np.asarray(features, np.float64)[:, : V.errors].ravel()
    return np.linalg.norm(mlp(V.net, e) - mlp(V.net, 0 * e)) + V.slope * np.linalg.norm(e)


def rows(tree):
    """The samples of a batch, one after another, in float64."""
    n = jax.tree.leaves(tree)[0].shape[0]
    double = jax.tree.map(lambda a: np.asarray(a, np.float64), tree)
    return [jax.tree.map(lambda a, k=k: a[k], double) for k in range(n)]


# What was drawn.


@eqx.filter_jit
def draw(pi, batch, noise):
    return (
        jax.vmap(pi.sample)(batch.obs, noise[0], batch.action),
        jax.vmap(pi.sample)(batch.next_obs, noise[1], batch.action),
    )


@pytest.fixture(scope="module")
def noise(batch):
    """What `update` draws with, now and next."""
    return jnp.moveaxis(batch.noise, 2, 0)


@pytest.fixture(scope="module")
def drawn(learner, batch, noise):
    return draw(learner.pi.value, batch, noise)


@pytest.fixture(scope="module")
def updated(masac, learner, batch):
    return update(masac, learner, batch, jnp.ones(()))[0]


@eqx.filter_jit
def update(algorithm, learner, batch, decay):
    return algorithm.update(learner, batch, decay)


def first_gradient(learnt):
    """What the gradient was, told by the memory of a fresh Adam after one step."""
    return jax.tree.map(lambda m: m / 0.1, learnt.memory.mu)


def test_actions_and_their_log_probabilities(learner, batch, noise, drawn):
    pi = learner.pi.value
    for k, b in enumerate(rows(batch)):
        for obs, z, got in ((b.obs, noise[0], drawn[0]), (b.next_obs, noise[1], drawn[1])):
            action, log_prob = act(pi, obs, np.asarray(z[k], np.float64))
            np.testing.assert_allclose(got.action[k], action, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(got.log_prob[k], log_prob, rtol=1e-4, atol=1e-4)
            memory = log_prob_of(pi, obs, b.action)
            np.testing.assert_allclose(got.log_prob_memory[k], memory, rtol=2e-4, atol=2e-3)


@pytest.fixture(scope="module")
def one():
    """An actor of one agent with one input: obs 0 gives mean 0.3 and standard deviation 0.5."""
    pi = filled(lambda k: Actors(Shape(1, 1, 1, 1, 1), 2, key=k), KEY)
    last = lambda pi: (pi.net.layers[-1].weight, pi.net.layers[-1].bias)
    return eqx.tree_at(last, pi, (jnp.zeros((1, 2, 2)), jnp.array([[0.3, np.log(0.5)]])))


@eqx.filter_jit
def log_probs(pi, noise, memory):
    column = lambda x: x[:, None, None]
    drawn = jax.vmap(pi.sample)(0 * column(noise), column(noise), column(memory))
    return drawn.action[:, 0, 0], drawn.log_prob[:, 0], drawn.log_prob_memory[:, 0]


def test_the_density_integrates_to_one_and_is_the_derivative_of_the_distribution(one):
    u = np.linspace(-2.5, 3, 1101)
    a, drawn, memory = (
        np.asarray(x, float)
        for x in log_probs(
            one, jnp.asarray((u - 0.3) / 0.5, jnp.float32), jnp.asarray(np.tanh(u), jnp.float32)
        )
    )
    np.testing.assert_allclose(a, np.tanh(u), atol=1e-6)
    np.testing.assert_allclose(drawn, memory, atol=5e-3)
    assert np.trapezoid(np.exp(drawn), np.tanh(u)) == pytest.approx(1, abs=1e-4)
    cdf = lambda a: stats.norm.cdf(np.arctanh(a), 0.3, 0.5)
    inner, h = np.tanh(u[100:-200]), 1e-6
    density = (cdf(inner + h) - cdf(inner - h)) / (2 * h)
    np.testing.assert_allclose(np.exp(drawn[100:-200]), density, rtol=1e-3)


def test_saturated_actions_stay_finite(one):
    """tanh rounds to 1 in float32 from 9 on; neither value nor gradient may become infinite."""
    z, a = jnp.asarray([60.0, -60.0, 20.0]), jnp.asarray([1.0, -1.0, 0.9999999])

    def total(pi):
        _, drawn, memory = log_probs(pi, z, a)
        return jnp.sum(drawn) + jnp.sum(memory), (drawn, memory)

    (_, values), gradient = eqx.filter_value_and_grad(total, has_aux=True)(one)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((values, gradient)))
    u = 0.3 + 0.5 * 60
    exact = -0.5 * 60.0**2 - np.log(0.5) - 0.5 * np.log(2 * np.pi) - 2 * (np.log(2) - u)
    assert values[0][0] == pytest.approx(exact, rel=1e-5)


# The objectives.


@eqx.filter_jit
def objectives(algorithm, l, batch, now, nxt):
    """J_Q, J_pi and J_alpha of every sample."""

    def each(b, now, nxt):
        J_Q = algorithm.J_Q(l.Q.value, l, b, nxt)
        return J_Q, algorithm.J_pi(now, nxt, l, b), algorithm.J_alpha(l.log_alpha.value, now)

    return jax.vmap(each)(batch, now, nxt)


def soft_target(algorithm, l, b, nxt):
    """y = r + gamma^n (min_j Q-bar_j(s', a') - alpha sum_i log pi_i(a'_i)), the entropy once."""
    alpha = np.exp(float(l.log_alpha.value))
    smaller = np.min(twins(l.Q_bar, b.next_features, nxt.action), axis=0)
    reward = b.reward if algorithm.heads == "agent" else np.mean(b.reward, keepdims=True)
    later = b.discount * (smaller - alpha * np.sum(nxt.log_prob))
    return algorithm.reward_scale * reward + later


@pytest.fixture(scope="module", params=["team", "agent"])
def with_heads(request, masac, learner, batch, shape):
    """The algorithm with one value for the team, and with one for each agent."""
    if request.param == "team":
        return masac, learner
    n = shape.agents
    critic = lambda seed: filled(lambda k: Critic(shape, 8, n, True, key=k), KEY, seed=seed)
    now = level(critic(7), batch.features, batch.action)
    slow = level(critic(8), batch.next_features, batch.action)
    several = eqx.tree_at(lambda l: (l.Q.value, l.Q_bar), learner, (now, slow))
    return replace(masac, heads="agent", use_Q=True), several


def test_J_Q_and_J_pi_and_J_alpha(with_heads, batch, drawn):
    algorithm, l = with_heads
    J_Q, J_pi, J_alpha = objectives(algorithm, l, batch, *drawn)
    alpha, weight, decrease = np.exp(float(l.log_alpha.value)), 0.3, algorithm.constraint.decrease
    first_twin = []
    for k, (b, now, nxt) in enumerate(zip(rows(batch), *map(rows, drawn), strict=True)):
        y = soft_target(algorithm, l, b, nxt)
        Q = twins(l.Q.value, b.features, b.action)
        assert J_Q[k] == pytest.approx(0.5 * np.sum(np.mean((Q - y) ** 2, axis=1)), rel=1e-3)
        if b.discount == 0:
            r = b.reward if algorithm.heads == "agent" else np.mean(b.reward)
            np.testing.assert_allclose(y, algorithm.reward_scale * r)

        Q_now = twins(l.Q.value, b.features, now.action)
        L, L_next = (
            lyapunov(l.L.net.value, b.features, b.action),
            lyapunov(l.L.net.value, b.next_features, nxt.action),
        )
        Delta_L = L_next - L + decrease * np.mean(b.cost)
        want = alpha * np.sum(now.log_prob) - np.mean(np.min(Q_now, axis=0)) + weight * Delta_L
        assert J_pi[k] == pytest.approx(want, rel=1e-3, abs=1e-3)
        want = -alpha * np.sum(now.log_prob + algorithm.entropy)
        assert J_alpha[k] == pytest.approx(want, rel=1e-4, abs=1e-4)
        slow = twins(l.Q_bar, b.next_features, nxt.action)
        first_twin.append([Q_now[0, 0] < Q_now[1, 0], slow[0, 0] < slow[1, 0]])
    share = np.mean(first_twin, axis=0)
    assert np.all(share > 0) and np.all(share < 1)  # or min could be either twin unnoticed


def test_dropping_Q_leaves_entropy_and_constraint(masac, learner, batch, drawn):
    without = objectives(replace(masac, use_Q=False), learner, batch, *drawn)[1]
    now, nxt = drawn
    penalty = penalties(masac.constraint, learner.L, batch, now, nxt)
    alpha = jnp.exp(learner.log_alpha.value)
    np.testing.assert_allclose(without, alpha * jnp.sum(now.log_prob, axis=1) + penalty, rtol=1e-4)


# The update.


def test_the_critic_descends_J_Q(masac, learner, batch, drawn, updated):
    """The gradient is that of eq. (7): y is held fixed."""
    nxt = rows(drawn[1])
    y = [soft_target(masac, learner, b, n) for b, n in zip(rows(batch), nxt, strict=True)]
    y = jnp.asarray(np.array(y), jnp.float32)

    @jax.jit
    def J(Q):
        residual = lambda f, a, y: twins(Q, f, a, jnp) - y[None]
        squares = jax.vmap(residual)(batch.features, batch.action, y) ** 2
        return 0.5 * jnp.mean(jnp.sum(jnp.mean(squares, axis=2), axis=1))

    close(first_gradient(updated.Q), jax.grad(J)(learner.Q.value), rtol=2e-3, atol=2e-4)


def test_the_actors_follow_equation_11(masac, learner, batch, noise, updated):
    """The chain rule through the actions is the gradient of E[J_pi] through the actors.

    Q is already the new one, as in the algorithm boxes; L is still the old one.
    """
    floats, rest = eqx.partition(learner.pi.value, eqx.is_inexact_array)
    alpha, weight = jnp.exp(learner.log_alpha.value), 0.3

    @jax.jit
    def J(floats):
        pi = eqx.combine(floats, rest)

        def each(b, z, z_next):
            a, log_prob = act(pi, b.obs, z, jnp)
            a_next, _ = act(pi, b.next_obs, z_next, jnp)
            Q = jnp.mean(jnp.min(twins(updated.Q.value, b.features, a, jnp), axis=0))
            L = learner.L.net.value
            fall = lyapunov(L, b.features, b.action, jnp) - lyapunov(
                L, b.next_features, a_next, jnp
            )
            Delta_L = masac.constraint.decrease * jnp.mean(b.cost) - fall
            return alpha * jnp.sum(log_prob) - Q + weight * Delta_L

        return jnp.mean(jax.vmap(each)(batch, noise[0], noise[1]))

    direct = jax.grad(J)(floats)
    close(first_gradient(updated.pi), direct, rtol=2e-3, atol=2e-4)
    assert max(float(jnp.max(jnp.abs(g))) for g in jax.tree.leaves(direct)) > 0.05


def test_the_temperature_descends_J_alpha(masac, learner, drawn, updated):
    surplus = np.sum(np.asarray(drawn[0].log_prob, float) + masac.entropy, axis=1)
    want = -np.exp(float(learner.log_alpha.value)) * np.mean(surplus)
    assert first_gradient(updated.log_alpha) == pytest.approx(want, rel=1e-4)


def test_L_descends_J_L_and_the_weight_ascends(masac, learner, batch, drawn, updated):
    @jax.jit
    def J(L):
        value = lambda f, a: lyapunov(L, f, a, jnp)
        gap = jax.vmap(value)(batch.features, batch.action) - jnp.mean(batch.cost_to_go, axis=1)
        return 0.5 * jnp.mean(gap**2)

    close(first_gradient(updated.L.net), jax.grad(J)(learner.L.net.value), rtol=2e-3, atol=2e-4)

    L, rises = learner.L.net.value, []  # the rise as it was before L moved
    for b, nxt in zip(rows(batch), rows(drawn[1]), strict=True):
        fall = lyapunov(L, b.features, b.action) - lyapunov(L, b.next_features, nxt.action)
        rises.append(masac.constraint.decrease * np.mean(b.cost) - fall)
    assert first_gradient(updated.L.log_weight) == pytest.approx(-np.mean(rises), rel=1e-3)
    moved = float(updated.L.log_weight.value - learner.L.log_weight.value)
    assert np.sign(moved) == np.sign(np.mean(rises))
    assert updated.L.scale == pytest.approx(0.99 * 1.7 + 0.01 * np.var(rises), rel=1e-3)


def test_slow_copies_follow(masac, learner, updated):
    mix = lambda tau, new, old: jax.tree.map(lambda n, o: tau * n + (1 - tau) * o, new, old)
    floats = lambda tree: eqx.filter(tree, eqx.is_inexact_array)
    for tau, new, old, got in (
        (masac.tau, updated.Q.value, learner.Q_bar, updated.Q_bar),
        (masac.ema_rate, updated.pi.value, learner.pi_mean, updated.pi_mean),
        (masac.constraint.tau, updated.L.net.value, learner.L.net_bar, updated.L.net_bar),
    ):
        close(floats(got), mix(tau, floats(new), floats(old)), rtol=1e-6, atol=1e-7)
    assert polyak(jnp.asarray(1.0), jnp.asarray(3.0), 0.25) == pytest.approx(2.5)


def test_rates_decay_together_and_are_those_asked_for(masac, learner, batch, updated):
    """`decay` multiplies every step; 0 leaves every parameter where it is (science.md 2.8)."""
    moves = {}
    parts = lambda l: {
        "rate_pi": l.pi.value, "rate_Q": l.Q.value, "rate_alpha": l.log_alpha.value,
        "L.rate_L": l.L.net.value, "L.rate_weight": l.L.log_weight.value,
    }  # fmt: skip
    for decay in (0.0, 0.5, 1.0):
        new = updated if decay == 1 else update(masac, learner, batch, jnp.asarray(decay))[0]
        for name, value in parts(new).items():
            gap = jax.tree.map(
                lambda a, b: a - b,
                *map(lambda t: eqx.filter(t, eqx.is_array), (value, parts(learner)[name])),
            )
            moves[name, decay] = max(float(jnp.max(jnp.abs(g))) for g in jax.tree.leaves(gap))
    for name in parts(learner):
        owner = masac.constraint if name.startswith("L.") else masac
        rate = getattr(owner, name.removeprefix("L."))
        assert moves[name, 0.0] == 0, name
        assert moves[name, 1.0] == pytest.approx(rate, rel=2e-2), name  # Adam's first step
        assert moves[name, 0.5] == pytest.approx(0.5 * rate, rel=2e-2), name


def test_what_an_update_tells_the_log(masac, learner, batch, drawn):
    log_prob = np.asarray(drawn[0].log_prob)
    after, info = update(masac, learner, batch, jnp.ones(()))
    rises = jax.vmap(lambda b, a: masac.constraint.rise(learner.L, b, a))(batch, drawn[1].action)
    rises, info = np.asarray(rises), {name: float(x) for name, x in info.items()}
    assert info["entropy"] == pytest.approx(-np.mean(np.sum(log_prob, axis=1)), rel=1e-4)
    assert info["alpha"] == pytest.approx(math.exp(after.log_alpha.value), rel=1e-5)
    assert info["weight"] == pytest.approx(math.exp(learner.L.log_weight.value), rel=1e-5)
    assert info["rise"] == pytest.approx(np.mean(rises), rel=1e-4)
    scale = 0.99 * float(learner.L.scale) + 0.01 * np.var(rises)
    assert float(after.L.scale) == pytest.approx(scale, rel=1e-4)
    assert {"J_Q", "J_pi", "J_L"} <= info.keys() and np.isfinite([*info.values()]).all()


def test_the_weight_rises_by_what_is_outside_the_ball(masac, learner, batch, drawn):
    """With no transition outside, it rests: nothing is divided by zero."""
    costs = np.mean(batch.cost, axis=1)
    nxt = drawn[1]
    for ball in (float(np.median(costs)), float(np.max(costs))):
        constraint = replace(masac.constraint, ball=ball)
        L, info = eqx.filter_jit(constraint.update)(learner.L, batch, *drawn, jnp.ones(()))
        rises = jax.vmap(lambda b, a: masac.constraint.rise(learner.L, b, a))(batch, nxt.action)
        outside = np.asarray(rises)[costs > ball]
        assert info["rise"] == pytest.approx(outside.mean() if len(outside) else 0.0, rel=1e-4)
        moved = float(L.log_weight.value - learner.L.log_weight.value)
        assert len(outside) or moved == 0


def test_a_constraint_begins_as_asked(shape):
    L = Lyapunov(weight_start=0.25, floor=0.1).init(shape, jax.random.key(0))
    assert np.exp(L.log_weight.value) == pytest.approx(0.25) and L.gradient == L.scale == 1
    net, net_bar = (jax.tree.leaves(eqx.filter(n, eqx.is_array)) for n in (L.net.value, L.net_bar))
    assert all(np.array_equal(a, b) for a, b in zip(net, net_bar, strict=True))


@pytest.mark.parametrize("critic", ["joint", "mean-field"])
@pytest.mark.parametrize("heads", ["team", "agent"])
def test_the_critics_have_the_heads_asked_for(heads, critic, shape, batch):
    algorithm = MASAC(heads=heads, critic=critic, actor_width=4, critic_width=4)
    l = jax.jit(lambda key: algorithm.init(shape, key))(jax.random.key(0))
    b = jax.tree.map(lambda a: a[0], batch)
    said = jax.eval_shape(l.Q.value, b.features, b.action)
    assert said.shape == (2, 1 if heads == "team" else shape.agents)
    team = algorithm.team(b.reward)
    wanted = b.reward if heads == "agent" else [np.mean(b.reward)]
    assert np.allclose(team, wanted, rtol=1e-6) and team.shape == said.shape[1:]


OPEN = {  # field: what is just allowed, and what is just not
    MASAC: {
        "gamma": ([0.0, 1.0], [-1e-9, 1.000001]),
        "tau": ([1e-9, 1.0], [0.0, 1.000001]),
        "ema_rate": ([1e-9, 1.0], [0.0, 1.000001]),
        "rate_pi": ([0.0, 1.0], [-1e-9, 1.000001]),
        "rate_Q": ([0.0, 1.0], [-1e-9, 1.000001]),
        "rate_alpha": ([0.0, 1.0], [-1e-9, 1.000001]),
        "alpha": ([1e-9, 1e6], [0.0, 1e6 + 0.5]),
        "reward_scale": ([1e-9, 1e6], [0.0, 1e6 + 0.5]),
        "batch": ([1, 1_000_000], [0, 1_000_001]),
        "n_step": ([1, 1_000_000], [0, 1_000_001]),
        "actor_width": ([1, 1_000_000], [0, 1_000_001]),
        "critic_width": ([1, 1_000_000], [0, 1_000_001]),
    },
    Lyapunov: {
        "horizon": ([1, 10_000], [0, 10_001]),
        "discount": ([0.0, 1.0], [-1e-9, 1.000001]),
        "decrease": ([0.0, 1.0], [-1e-9, 1.000001]),
        "tau": ([1e-9, 1.0], [0.0, 1.000001]),
        "weight_start": ([1e-9, 1e6], [0.0, 1e6 + 0.5]),
        "floor": ([1e-9, 1e6], [0.0, 1e6 + 0.5]),
        "input_gain": ([1e-9, 1e6], [0.0, 1e6 + 0.5]),
        "ball": ([0.0, 1e6], [-1e-9, 1e6 + 0.5]),
        "clip": ([0.0, 1e6], [-1e-9, 1e6 + 0.5]),
        "rate_L": ([0.0, 1e6], [-1e-9, 1e6 + 0.5]),
        "rate_weight": ([0.0, 1e6], [-1e-9, 1e6 + 0.5]),
        "weight": ([None, 0.0, 1e6], [-1e-9, 1e6 + 0.5]),
        "slope": (["empirical", 0.0, 1e6], [-1e-9, 1e6 + 0.5]),
    },
}


@pytest.mark.parametrize("kind", [*OPEN], ids=lambda kind: kind.__name__)
def test_the_ranges_of_hyperparameters(kind):
    for field, (fine, bad) in OPEN[kind].items():
        for value in fine:
            assert getattr(kind(**{field: value}), field) == value
        for value in bad:
            with pytest.raises(UserError, match=f"^{field}: "):
                kind(**{field: value})


def test_the_weight_stays_between_its_floor_and_one(masac, learner, batch):
    log_weight = lambda l: l.L.log_weight.value
    at = lambda w: eqx.tree_at(log_weight, learner, jnp.log(jnp.asarray(w, jnp.float32)))
    costly = eqx.tree_at(lambda b: b.cost, batch, batch.cost + 1e4)
    cheap = eqx.tree_at(lambda b: b.cost, batch, batch.cost - 1e4)
    weight = lambda l, b: float(jnp.exp(log_weight(update(masac, l, b, jnp.ones(()))[0])))
    floor = masac.constraint.floor
    assert weight(at(1.0), costly) == 1
    assert weight(at(floor), cheap) == pytest.approx(floor, rel=1e-6)
    assert weight(at(0.5), costly) > 0.5 > weight(at(0.5), cheap)


def test_weight_zero_is_plain_masac(masac, learner, batch):
    """The same policy, critics and temperature, step by step.

    Not always to the last bit: XLA may fuse the added zeros into other sums.
    """
    nothing = replace(masac, constraint=Unconstrained())
    zero = replace(masac, constraint=Lyapunov(horizon=3, weight=0.0))
    plain = eqx.tree_at(lambda l: l.L, learner, None, is_leaf=lambda x: x is learner.L)
    parts = lambda l: eqx.filter((l.pi, l.pi_mean, l.Q, l.Q_bar, l.log_alpha), eqx.is_array)
    constrained = learner
    for _ in range(3):
        plain = update(nothing, plain, batch, jnp.ones(()))[0]
        constrained = update(zero, constrained, batch, jnp.ones(()))[0]
        close(parts(constrained), parts(plain), rtol=1e-5, atol=1e-7)
    assert not same(constrained.L.net.value, learner.L.net.value)  # L is learnt all the same


def test_adam_is_adam():
    rng = np.random.default_rng(0)
    theta = {"a": jnp.asarray(rng.standard_normal((2, 3)), jnp.float32), "b": jnp.ones(2)}
    ours, reference = TrainState.of(theta), optax.adam(3e-3)
    value, state = theta, reference.init(theta)
    m = v = 0.0
    a = np.asarray(theta["a"], float)
    for k in range(1, 6):
        g = jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape), jnp.float32), theta)
        ours = ours.step(g, 3e-3)
        move, state = reference.update(g, state)
        value = optax.apply_updates(value, move)
        m, v = 0.9 * m + 0.1 * np.asarray(g["a"]), 0.999 * v + 0.001 * np.asarray(g["a"]) ** 2
        a -= 3e-3 * (m / (1 - 0.9**k)) / (np.sqrt(v / (1 - 0.999**k)) + 1e-8)
    close(ours.value, value, rtol=1e-6)
    np.testing.assert_allclose(ours.value["a"], a, rtol=1e-4, atol=1e-6)


def test_policies_of_a_learner(masac, learner, batch):
    """What explores is pi; what is deployed is its running mean, without noise."""
    explorer, policy = masac.explore(learner), masac.policy(learner)
    assert isinstance(explorer, Sampled) and isinstance(policy, Greedy)
    run = eqx.filter_jit(lambda p, obs, key: p(obs, key))
    obs, keys = batch.obs[0], jax.random.split(KEY, 2)
    got = run(policy, obs, keys[0])
    want = [np.tanh(gaussian(learner.pi_mean, i, np.asarray(obs, float))[0]) for i in range(3)]
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(got, run(policy, obs, keys[1]))
    z = np.asarray(jax.random.normal(keys[0], batch.action[0].shape), float)
    drawn = run(explorer, obs, keys[0])
    np.testing.assert_allclose(
        drawn, act(learner.pi.value, np.asarray(obs, float), z)[0], atol=1e-5
    )
    log_prob = eqx.filter_jit(explorer.log_prob)(obs, drawn)
    want = log_prob_of(learner.pi.value, np.asarray(obs, float), np.asarray(drawn, float))
    np.testing.assert_allclose(log_prob, want, rtol=1e-3, atol=1e-3)
    # Decentralised: row i of the action comes from row i of the observations alone.
    other = run(policy, obs.at[1].add(1.0), keys[0])
    np.testing.assert_array_equal(np.any(np.asarray(other != got), axis=1), [False, True, False])


# The Lyapunov constraint.


@eqx.filter_jit
def penalties(constraint, L, batch, now, nxt):
    return jax.vmap(lambda *x: constraint.penalty(L, *x))(batch, now, nxt)


@eqx.filter_jit
def to_actions(constraint, L, batch, now, nxt, share):
    """The gradient of a weighted mean of the penalties with respect to what was drawn."""

    def total(drawn):
        return jnp.mean(share * jax.vmap(lambda *x: constraint.penalty(L, *x))(batch, *drawn))

    return jax.grad(total)((now, nxt))


@eqx.filter_jit
def through_actors(pi, batch, noise, cotangent):
    """That gradient carried on to phi."""
    return eqx.filter_vjp(lambda pi: draw(pi, batch, noise), pi)[1](cotangent)[0]


@pytest.fixture(scope="module")
def certificate(learner, shape):
    """A learnt certificate for either function."""
    norm = filled(lambda k: NormNet(shape, key=k), KEY, seed=3)
    lag = filled(lambda k: NormNet(shape, key=k), KEY, seed=4)
    L = learner.L
    return {
        "squares": L,
        "norm": LearnedLyapunov(TrainState.of(norm), lag, L.log_weight, L.gradient, L.scale),
    }


def rise_of(L, b, a_next, decrease=0.1):
    if isinstance(L, NormNet):
        fall = norm_like(L, b.features) - norm_like(L, b.next_features)
    else:
        fall = lyapunov(L, b.features, b.action) - lyapunov(L, b.next_features, a_next)
    return decrease * np.mean(b.cost) - fall


ones = jnp.ones(16)


def test_literal_reading_without_its_margin_has_no_gradient(
    learner, certificate, batch, noise, drawn
):
    """t1: as printed, L(s', a') - L(s, a) is constant in phi."""
    constraint = Lyapunov(reading="literal", weight=0.7, slope=0.0)
    slopes = to_actions(constraint, certificate["squares"], batch, *drawn, ones)
    gradient = through_actors(learner.pi.value, batch, noise, slopes)
    leaves = jax.tree.leaves(eqx.filter(gradient, eqx.is_array))
    assert leaves and not any(np.any(np.asarray(g)) for g in leaves)


def test_literal_reading_clones_the_memory(certificate, batch, drawn):
    """With its margin, all its gradient is that of l_L l_f ||a_phi - a|| (science.md 2.3)."""
    constraint = Lyapunov(reading="literal", weight=0.7, slope=0.5)
    L = certificate["squares"]
    got = penalties(constraint, L, batch, *drawn)
    now, _ = to_actions(constraint, L, batch, *drawn, ones)
    for k, (b, n, x) in enumerate(zip(rows(batch), *map(rows, drawn), strict=True)):
        gap = n.action - b.action
        length = np.linalg.norm(gap)
        want = 0.7 * (rise_of(L.net.value, b, x.action) + 0.5 * length)
        assert got[k] == pytest.approx(want, rel=1e-3, abs=1e-3)
        np.testing.assert_allclose(
            now.action[k], 0.7 * 0.5 * gap / length / 16, rtol=1e-3, atol=1e-6
        )


def test_han_reading_descends_L_of_the_next_state(masac, learner, certificate, batch, noise, drawn):
    """R1: its gradient is the weight times that of E L(s', pi(s')), so that a step lowers it."""
    floats, rest = eqx.partition(learner.pi.value, eqx.is_inexact_array)
    L = certificate["squares"].net.value

    @jax.jit
    def expected(floats):
        pi = eqx.combine(floats, rest)
        value = lambda b, z: lyapunov(L, b.next_features, act(pi, b.next_obs, z, jnp)[0], jnp)
        return jnp.mean(jax.vmap(value)(batch, noise[1]))

    constraint = Lyapunov(reading="han", weight=0.7)
    slopes = to_actions(constraint, certificate["squares"], batch, *drawn, ones)
    gradient = eqx.filter(through_actors(learner.pi.value, batch, noise, slopes), eqx.is_array)
    before, descent = jax.value_and_grad(expected)(floats)
    flat = lambda tree: jnp.concatenate([x.ravel() for x in jax.tree.leaves(tree)])
    np.testing.assert_allclose(flat(gradient), 0.7 * flat(descent), rtol=2e-3, atol=1e-4)
    step = jax.tree.map(lambda p, g: p - 1e-2 * g, floats, descent)
    assert expected(step) < before - 1e-4
    # Nothing reaches the actions at s_t.
    assert not any(np.any(np.asarray(x)) for x in jax.tree.leaves(slopes[0]))


@pytest.mark.parametrize("function", ["squares", "norm"])
def test_hinge_imitates_only_what_made_L_fall(function, certificate, batch, drawn):
    constraint = Lyapunov(reading="hinge", function=function, weight=0.7, slope=0.5)
    L = certificate[function]
    got = penalties(constraint, L, batch, *drawn)
    now, nxt = to_actions(constraint, L, batch, *drawn, ones)
    kinds = set()
    for k, (b, n, x) in enumerate(zip(rows(batch), *map(rows, drawn), strict=True)):
        rise, gap = rise_of(L.net.value, b, x.action), n.action - b.action
        length = np.linalg.norm(gap)
        bound = rise + 0.5 * length
        want = 0.7 * max(bound, 0) if rise <= 0 else 0.0
        assert got[k] == pytest.approx(want, rel=1e-3, abs=1e-3)
        pull = 0.7 * 0.5 * gap / length / 16 if rise <= 0 < bound else 0 * gap
        np.testing.assert_allclose(now.action[k], pull, rtol=1e-3, atol=1e-7)
        kinds.add((rise <= 0, bound > 0))
    assert {(False, True), (True, True)} <= kinds
    assert not any(np.any(np.asarray(x)) for x in jax.tree.leaves(nxt))


@pytest.mark.parametrize("reading", ["literal", "hinge"])
def test_the_weight_follows_the_batch_mean_without_the_margin(reading, certificate, batch, drawn):
    """It falls where the mean rise is negative, though states rise and the penalty is positive."""
    L = certificate["squares"]
    pairs = zip(rows(batch), rows(drawn[1]), strict=True)
    rises = np.array([rise_of(L.net.value, b, x.action) for b, x in pairs])
    lower = rises.mean() + 0.05  # what the rises fall by when the costs do by ten times as much
    cheaper = eqx.tree_at(lambda b: b.cost, batch, batch.cost - lower / 0.1)
    assert np.any(rises - lower > 0)
    found = set()
    for slope in (0.0, 50.0):
        constraint = Lyapunov(reading=reading, slope=slope, weight=None)
        after, info = eqx.filter_jit(constraint.update)(L, cheaper, *drawn, jnp.ones(()))
        assert info["rise"] == pytest.approx(-0.05, abs=1e-3)
        assert after.log_weight.value < L.log_weight.value
        found.add(float(after.log_weight.value))
    assert len(found) == 1
    assert np.mean(penalties(constraint, L, cheaper, *drawn)) > 0.1


def test_score_raises_the_likelihood_of_good_actions(learner, certificate, batch, noise, drawn):
    constraint = Lyapunov(reading="score", function="norm", weight=1.0)
    L, pi = certificate["norm"], learner.pi.value
    on_policy = eqx.tree_at(lambda b: b.log_prob, batch, drawn[0].log_prob_memory)
    advantage = np.array([-rise_of(L.net.value, b, None) for b in rows(batch)]) / np.sqrt(1.7)
    assert np.any(advantage > 0.05) and np.any(advantage < -0.05)
    now, nxt = to_actions(constraint, L, on_policy, *drawn, ones)
    want = -advantage[:, None] / 3 / 16  # d(-ratio A)/d(log pi_i), the mean over 3 agents
    np.testing.assert_allclose(
        now.log_prob_memory, np.broadcast_to(want, (16, 3)), rtol=2e-3, atol=1e-6
    )
    assert not np.any(np.asarray(now.action)) and not np.any(np.asarray(now.log_prob))
    assert not any(np.any(np.asarray(x)) for x in jax.tree.leaves(nxt))

    for k in (int(np.argmax(advantage)), int(np.argmin(advantage))):
        slopes = to_actions(constraint, L, on_policy, *drawn, jnp.zeros(16).at[k].set(1.0))
        gradient = through_actors(pi, on_policy, noise, slopes)
        step = jax.tree.map(lambda p, g: p - 0.05 * g if eqx.is_array(p) else p, pi, gradient)
        b = rows(batch)[k]
        change = np.sum(log_prob_of(step, b.obs, b.action) - log_prob_of(pi, b.obs, b.action))
        assert np.sign(change) == np.sign(advantage[k]) and abs(change) > 1e-6


def test_score_respects_the_clip(certificate, batch, drawn):
    constraint = Lyapunov(reading="score", function="norm", weight=1.0, clip=0.2)
    L = certificate["norm"]
    advantage = np.array([-rise_of(L.net.value, b, None) for b in rows(batch)]) / np.sqrt(1.7)
    for ratio in (1.3, 1.1, 0.9, 0.7):
        moved = drawn[0].log_prob_memory - np.float32(np.log(ratio))
        off_policy = eqx.tree_at(lambda b: b.log_prob, batch, moved)
        got = penalties(constraint, L, off_policy, *drawn)
        near = np.clip(ratio, 0.8, 1.2)
        want = -np.minimum(ratio * advantage, near * advantage)
        np.testing.assert_allclose(got, want, rtol=2e-3, atol=1e-5)
        now, _ = to_actions(constraint, L, off_policy, *drawn, ones)
        moves = np.any(np.asarray(now.log_prob_memory) != 0, axis=1)
        stuck = ((ratio > 1.2) & (advantage > 0)) | ((ratio < 0.8) & (advantage < 0))
        np.testing.assert_array_equal(moves, ~stuck)


def test_the_constraint_holds_outside_the_ball_only(certificate, batch, drawn):
    L = certificate["squares"]
    ball = float(jnp.median(jnp.mean(batch.cost, axis=1)))
    got = penalties(Lyapunov(weight=1.0, ball=ball), L, batch, *drawn)
    everywhere = penalties(Lyapunov(weight=1.0), L, batch, *drawn)
    outside = np.mean(batch.cost, axis=1) > ball
    assert 0 < outside.sum() < 16
    np.testing.assert_allclose(got, np.where(outside, everywhere, 0), rtol=1e-6)


def test_a_constraint_about_some_agents_alone(certificate, batch, drawn):
    """Their costs enter, and their actions alone feel it; what the others did is as it was."""
    L, some = certificate["squares"], (1, 2)
    got, whole = (Lyapunov(weight=1.0, agents=agents) for agents in (some, ()))
    costs, rest = np.mean(batch.cost[:, 1:], axis=1), np.mean(batch.cost, axis=1)
    more = penalties(got, L, batch, *drawn) - penalties(whole, L, batch, *drawn)
    np.testing.assert_allclose(more, got.decrease * (costs - rest), atol=1e-4)
    one = jax.tree.map(lambda x: x[0], batch)
    L_target = got.L_target(L, one, jax.tree.map(lambda x: x[0], drawn[1]))
    np.testing.assert_allclose(L_target, np.mean(one.cost_to_go[1:]), rtol=1e-6)
    ones = np.ones(len(costs), np.float32)
    felt, free = (to_actions(c, L, batch, *drawn, ones)[1].action for c in (got, whole))
    assert np.all(felt[:, 0] == 0) and np.any(free[:, 0] != 0)
    np.testing.assert_array_equal(felt[:, 1:], free[:, 1:])
    score = Lyapunov(reading="score", function="norm", weight=1.0, agents=some)
    now, _ = to_actions(score, certificate["norm"], batch, *drawn, ones)
    feels = np.any(np.asarray(now.log_prob_memory) != 0, axis=0)
    assert not feels[0] and feels[1:].all()


def test_a_constraint_about_agents_that_are_not_there():
    with pytest.raises(UserError, match="agents: 3 is out of range; take 0 to 2"):
        Trainer(TASKS["rendezvous"], MASAC(constraint=Lyapunov(agents=(1, 3))), Schedule())
    with pytest.raises(UserError, match="^agents: .* names an agent twice"):
        Lyapunov(agents=(1, 1))


def test_slope_estimates(certificate, batch):
    L = certificate["norm"]
    of = lambda slope: Lyapunov(reading="hinge", function="norm", slope=slope, input_gain=0.4)
    product = np.prod([np.linalg.norm(layer.weight, 2) for layer in L.net.value.net.layers])
    assert of("spectral").lipschitz(L) == pytest.approx(
        0.4 * (product + L.net.value.slope), rel=1e-4
    )
    assert of("empirical").lipschitz(L) == pytest.approx(0.4 * 0.8, rel=1e-6)
    assert of(0.3).lipschitz(L) == pytest.approx(0.3)
    squares = certificate["squares"]
    plain = jax.jit(jax.vmap(jax.grad(lambda f, a: lyapunov(squares.net.value, f, a, jnp))))
    sizes = np.sqrt(np.sum(np.asarray(plain(batch.features, batch.action)) ** 2, axis=(1, 2)))
    got = eqx.filter_jit(Lyapunov(slope="empirical").steepness)(squares, batch)
    assert got == pytest.approx(0.99 * 0.8 + 0.01 * np.quantile(sizes, 0.95), rel=1e-4)


@eqx.filter_jit
def targets(constraint, L, batch, nxt):
    """L_target and J_L of every sample."""
    each = lambda b, n: (constraint.L_target(L, b, n), constraint.J_L(L.net.value, b, n, L))
    return jax.vmap(each)(batch, nxt)


@pytest.mark.parametrize("target", ["rollout", "hold_last", "bootstrap", "discounted"])
def test_L_target(target, certificate, batch, drawn):
    constraint, L = Lyapunov(target=target, discount=0.9), certificate["squares"]
    assert constraint.cost_window == (10, target == "rollout")
    got, J_L = targets(constraint, L, batch, drawn[1])
    for k, (b, n) in enumerate(zip(rows(batch), rows(drawn[1]), strict=True)):
        slow = lyapunov(L.net_bar, b.next_features, n.action)  # not the fast one
        want = {
            "bootstrap": np.mean(b.cost) - np.mean(b.cost_ahead) + slow,
            "discounted": np.mean(b.cost) + 0.9 * slow,
        }.get(target, np.mean(b.cost_to_go))
        assert got[k] == pytest.approx(want, rel=1e-3)
        gap = lyapunov(L.net.value, b.features, b.action) - want
        assert J_L[k] == pytest.approx(0.5 * gap**2, rel=2e-3, abs=1e-5)


class Table(NormNet):
    """A function of the state that is given: feature 0 of agent 0."""

    def __call__(self, features, action=None):
        return features[0, 0]


@pytest.fixture(scope="module")
def seen(game):
    """The costs of a long closed-loop rollout, and the certificate that reads L off a table."""
    shape = Shape(3, 14, 8, 4, 2)
    see = eqx.filter_eval_shape(lambda k: game.observations(game.reset(k)), KEY)
    pi = filled(lambda k: Actors(shape._replace(obs=see.shape[1]), 8, key=k), KEY)
    play = eqx.filter_jit(lambda pi, key: rollout(
        game, Decentralised(Greedy(pi), game), game.reset(key), key, 60))  # fmt: skip
    table = filled(lambda k: Table(shape, key=k), KEY)
    one = jnp.ones(())
    L = LearnedLyapunov(TrainState(table, None), table, TrainState.of(0 * one), one, one)
    return play(pi, KEY).cost, L


def along(cost, value, ahead, batch):
    """The transitions of a rollout with L(s_t) = value[t] in the table (16 at a time)."""
    spread = lambda v: jnp.zeros((16, 3, 6)).at[:, 0, 0].set(jnp.asarray(v, jnp.float32))
    parts = lambda b: (b.features, b.next_features, b.cost, b.cost_ahead)
    new = (spread(value[:16]), spread(value[1:17]), cost[:16], ahead[:16])
    return eqx.tree_at(parts, batch, new)


def test_sums_of_T_costs_fall_by_contraction(seen, batch, drawn):
    """t2: L_T(s_{t+1}) - L_T(s_t) = c_{t+T} - c_t, so Delta L <= 0 is c_{t+T} <= (1 - beta) c_t."""
    (cost, L), T, beta = seen, 7, 0.15
    to_go, ahead = cost_to_go(cost, T, 40)
    value, c = np.mean(np.asarray(to_go, float), axis=1), np.mean(np.asarray(cost, float), axis=1)
    assert np.ptp(c) > 0.1
    np.testing.assert_allclose(np.diff(value), c[T : T + 39] - c[:39], atol=1e-5)
    np.testing.assert_allclose(np.mean(ahead, axis=1), c[T : T + 40], atol=1e-6)
    b = along(cost, value, ahead, batch)
    constraint = Lyapunov(weight=1.0, decrease=beta, target="bootstrap", horizon=T)
    rise = penalties(constraint, L, b, *drawn)
    np.testing.assert_allclose(rise, c[T : T + 16] - (1 - beta) * c[:16], atol=2e-5)
    # The target that bootstraps has the T-step sum for its fixed point.
    np.testing.assert_allclose(targets(constraint, L, b, drawn[1])[0], value[:16], atol=2e-5)


def test_discounted_sums_fall_where_they_are_bounded_by_the_cost(seen, batch, drawn):
    """t3: L = c + g L' gives Delta L <= -beta c exactly if L <= c (1 - g beta) / (1 - g)."""
    (cost, L), g, beta = seen, 0.9, 0.1
    c = np.mean(np.asarray(cost, float), axis=1)
    value = np.zeros(41)
    value[40] = c[40] / (1 - g)
    for t in range(39, -1, -1):
        value[t] = c[t] + g * value[t + 1]
    both = []
    for lo in (0, 12, 23):
        b = along(cost[lo:], value[lo:], cost[lo:], batch)
        constraint = Lyapunov(weight=1.0, decrease=beta, target="discounted", discount=g)
        np.testing.assert_allclose(targets(constraint, L, b, drawn[1])[1], 0, atol=1e-9)
        rise = np.asarray(penalties(constraint, L, b, *drawn))
        margin = (1 - g * beta) / (1 - g) * c[lo : lo + 16] - value[lo : lo + 16]
        np.testing.assert_allclose(rise, -margin * (1 - g) / g, atol=5e-5)
        both += list(np.sign(margin))
    assert {-1, 1} == set(both)


def test_distance_is_zero_with_a_gradient_of_zero_where_actions_agree():
    a, b = jnp.full((3, 2), 0.4), jnp.full((3, 2), 0.4).at[0, 0].add(0.3)
    value, gradient = jax.value_and_grad(distance)(a, a)
    assert value == 0 and np.all(gradient == 0)
    value, gradient = jax.value_and_grad(distance)(b, a)
    assert float(value) == pytest.approx(0.3, rel=1e-5)
    assert np.allclose(gradient, np.zeros((3, 2)) + (np.arange(6).reshape(3, 2) == 0), atol=1e-5)


@pytest.mark.parametrize("slope", ["empirical", 0.0])
def test_the_slope_is_followed_only_where_it_is_asked_for(slope, masac, learner, batch, drawn):
    constraint = replace(masac.constraint, slope=slope)
    L, _ = eqx.filter_jit(constraint.update)(learner.L, batch, *drawn, jnp.ones(()))
    assert (float(L.gradient) != float(learner.L.gradient)) == (slope == "empirical")


def test_what_does_not_fit_together_is_refused():
    for bad, field in (
        (dict(function="norm"), "function"),
        (dict(reading="score"), "reading"),
        (dict(reading="hinge", slope="spectral"), "slope"),
        (dict(horizon=0), "horizon"),
        (dict(weight=-0.1), "weight"),
    ):
        with pytest.raises(UserError, match=f"^{field}: "):
            Lyapunov(**bad)


# The functions L.


@pytest.mark.parametrize("normalise", [False, True])
def test_L_is_a_sum_of_squares(shape, batch, normalise):
    L = filled(lambda k: LyapunovNet(shape, normalise, key=k), KEY, seed=6)
    got = jax.jit(jax.vmap(lambda f, a: L(f, a)))(batch.features, batch.action)
    want = [lyapunov(L, b.features, b.action) for b in rows(batch)]
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)
    assert np.all(np.asarray(got) >= 0) and np.max(got) > 0
    assert [layer.weight.shape[0] for layer in L.net.layers] == [64, 64, 16]


@pytest.mark.parametrize("normalise", [False, True])
def test_V_is_zero_exactly_on_the_target_set(shape, batch, normalise):
    """t10: whatever the weights, and whatever the features that are no errors."""
    V = filled(lambda k: NormNet(shape, normalise, key=k), KEY, seed=9)
    value = jax.jit(jax.vmap(lambda f, a=None: V(f, a)))
    there = batch.features.at[:, :, : shape.errors].set(0)
    np.testing.assert_array_equal(value(there, batch.action), np.zeros(16))
    want = [norm_like(V, b.features) for b in rows(batch)]
    np.testing.assert_allclose(value(batch.features, batch.action), want, rtol=2e-4)
    directions = there.at[:, :, : shape.errors].set(batch.features[:, :, : shape.errors])
    for size in (1e-4, 1e-2, 1.0, 100.0):
        e = size * directions
        errors = np.asarray(e)[:, :, : shape.errors].reshape(16, -1)
        least = 0.99 * V.slope * np.linalg.norm(errors, axis=1)
        assert np.all(np.asarray(value(e, batch.action)) >= least)
    for agent in range(shape.agents):  # one small error of one agent is enough
        for k in range(shape.errors):
            assert np.all(np.asarray(value(there.at[:, agent, k].set(1e-5), batch.action)) > 0)
    slope = jax.jit(jax.grad(lambda f: jnp.sum(jax.vmap(lambda f: V(f))(f))))(there)
    assert np.isfinite(slope).all()


def lipschitz_quotients(V, shape):
    rng = np.random.default_rng(2)
    a = rng.standard_normal((400, shape.agents, shape.features)) * 10 ** rng.uniform(
        -3, 1, (400, 1, 1)
    )
    b = a + rng.standard_normal(a.shape) * 10 ** rng.uniform(-3, 1, (400, 1, 1))
    value = jax.jit(jax.vmap(lambda f, a=None: V(f, a)))
    gap = np.abs(value(jnp.asarray(a, jnp.float32)) - value(jnp.asarray(b, jnp.float32)))
    return gap / np.linalg.norm((a - b)[:, :, : shape.errors].reshape(400, -1), axis=1)


def test_the_lipschitz_bound_of_V_holds(shape):
    V = filled(lambda k: NormNet(shape, key=k), KEY, seed=9)
    bound = float(V.lipschitz())
    quotients = lipschitz_quotients(V, shape)
    assert np.max(quotients) <= bound * 1.001
    assert np.max(quotients) > 0.02 * bound  # not vacuous
    linear = eqx.tree_at(lambda V: V.net.layers, V, (V.net.layers[0],))
    e = np.linalg.svd(np.asarray(linear.net.layers[0].weight))[2][0]  # the steepest direction
    steep = linear(jnp.zeros((3, 6)).at[:, :4].set(jnp.asarray(e.reshape(3, 4))))
    assert steep == pytest.approx(float(linear.lipschitz()), rel=1e-4)


def test_the_lipschitz_bound_of_V_holds_with_layer_norm_too(shape):
    """LayerNorm divides by the spread of its inputs, which may be tiny: they are not bounded by 1.

    Refusing to give a bound is as good.
    """
    V = filled(lambda k: NormNet(shape, True, key=k), KEY, seed=9)
    biases = lambda V: [layer.bias for layer in V.net.layers]
    V = eqx.tree_at(biases, V, [0 * b for b in biases(V)])
    try:
        bound = float(V.lipschitz())
    except UserError:
        return
    assert np.max(lipschitz_quotients(V, shape)) <= bound * 1.001


# The layout: the batch is the last axis inside, and nobody notices outside.


def compare(layout, plain, *args):
    """Value and gradient of a vmapped net against the plain one."""
    total = lambda f: (
        lambda *args: jnp.sum(
            jnp.sin(jnp.concatenate([y.ravel() for y in jax.tree.leaves(f(*args))]))
        )
    )
    for f in (lambda g: g, lambda g: eqx.filter_grad(lambda args: total(g)(*args))):
        if f(plain) is plain:
            a, b = eqx.filter_jit(layout)(*args), eqx.filter_jit(plain)(*args)
        else:
            a, b = (eqx.filter_jit(f(g))(args) for g in (layout, plain))
        close(a, b, rtol=1e-5, atol=2e-5)


def net_of(sizes, normalise=False, count=None, seed=0):
    make = lambda k: MLP(sizes, normalise, key=k)
    if count is None:
        return filled(make, KEY, seed=seed)
    return filled(lambda k: eqx.filter_vmap(make)(jax.random.split(k, count)), KEY, seed=seed)


def xs(*size, seed=0):
    return jnp.asarray(np.random.default_rng(seed).standard_normal(size), jnp.float32)


@pytest.mark.parametrize("normalise", [False, True])
def test_layout_of_a_batch(normalise):
    net = net_of((5, 7, 6, 3), normalise)
    plain = lambda net, x: jax.vmap(lambda x: mlp(net, x, (), jnp))(x)
    compare(lambda net, x: jax.vmap(net)(x), plain, net, xs(4, 5))
    np.testing.assert_allclose(net(xs(5)), mlp(net, np.asarray(xs(5), float)), rtol=1e-4, atol=1e-5)


def test_layout_of_twins_in_a_batch_of_batches():
    nets = net_of((5, 7, 6, 3), True, count=2)
    each = lambda net, x: eqx.filter_vmap(lambda n: n(x))(net)
    plain = lambda net, x: jnp.stack([mlp(net, x, (j,), jnp) for j in range(2)])
    twice = lambda f: lambda net, x: jax.vmap(jax.vmap(lambda x: f(net, x)))(x)
    compare(twice(each), twice(plain), nets, xs(3, 4, 5))


def test_layout_of_agents_and_of_seeds():
    """Seeds of twins of agents: the outermost axis is added to all others by vmap."""
    nets = net_of((5, 7, 3), True, count=6)
    nets = jax.tree.map(lambda a: a.reshape(2, 3, *a.shape[1:]), nets)  # [seed, agent]
    each = lambda net, x: eqx.filter_vmap(lambda n, x: n(x))(net, x)  # x: [agent, 5]
    plain = lambda net, x: jnp.stack([mlp(net, x[i], (i,), jnp) for i in range(3)])
    batched = lambda f: lambda net, x: jax.vmap(lambda x: f(net, x))(x)
    seeds = lambda f: lambda nets, x: eqx.filter_vmap(batched(f))(nets, x)
    compare(seeds(each), seeds(plain), nets, xs(2, 4, 3, 5))


def test_layout_of_whole_policies_over_seeds(shape, batch):
    """The actors of several seeds shown the same observations, and the same actors shared."""
    stack = lambda shared: filled(
        lambda k: eqx.filter_vmap(lambda k: Actors(shape, 8, shared, key=k))(
            jax.random.split(k, 2)
        ),
        KEY,
    )
    one = lambda pi: lambda b: pi.sample(b.obs, b.features[:, :2], b.action)
    for pis in (stack(False), stack(True)):
        got = eqx.filter_jit(eqx.filter_vmap(lambda pi: jax.vmap(one(pi))(batch)))(pis)
        for s in range(2):
            pi = jax.tree.map(lambda a, s=s: a[s] if eqx.is_array(a) else a, pis)
            for k, b in enumerate(rows(batch)[:4]):
                action, log_prob = act(pi, b.obs, b.features[:, :2])
                np.testing.assert_allclose(got.action[s, k], action, atol=1e-4)
                np.testing.assert_allclose(got.log_prob[s, k], log_prob, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("seeds", [2, 3])
def test_layout_of_seeds_that_see_the_same_without_a_batch(shape, batch, seeds):
    """With as many seeds as agents a mistake would not even show in the shapes."""
    make = lambda k: eqx.filter_vmap(lambda k: Actors(shape, 8, key=k))(jax.random.split(k, seeds))
    pis = filled(make, KEY)
    got = eqx.filter_jit(eqx.filter_vmap(lambda pi: pi.mode(batch.obs[0])))(pis)
    for s in range(seeds):
        pi = jax.tree.map(lambda a, s=s: a[s] if eqx.is_array(a) else a, pis)
        want = [np.tanh(gaussian(pi, i, np.asarray(batch.obs[0], float))[0]) for i in range(3)]
        np.testing.assert_allclose(got[s], want, rtol=1e-4, atol=1e-5)


def test_layout_of_a_batch_of_noise_for_one_observation(learner, batch):
    """Only some of the inputs are batched."""
    pi, noise = learner.pi.value, xs(4, 3, 2)
    sample = jax.vmap(lambda o, z, a: pi.sample(o, z, a), in_axes=(None, 0, None))
    got = jax.jit(sample)(batch.obs[0], noise, batch.action[0])
    for k in range(4):
        want = act(pi, np.asarray(batch.obs[0], float), np.asarray(noise[k], float))
        np.testing.assert_allclose(got.action[k], want[0], atol=1e-5)
        np.testing.assert_allclose(got.log_prob[k], want[1], rtol=1e-4, atol=1e-4)
