"""The outer loop, its random streams, and the evaluation at the end of it."""

from collections import Counter
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import same
from jaxtyping import Array

from marlyap.controllers import CONTROLLERS
from marlyap.errors import UserError
from marlyap.games.dynamics import SingleIntegrator
from marlyap.learning.schedule import Schedule
from marlyap.learning.source import CostWindow, shape
from marlyap.learning.trainer import Trainer
from marlyap.nets.nets import Greedy, Sampled
from marlyap.seeds import stream
from marlyap.simulation import evaluation
from marlyap.simulation.evaluation import compare, episode, evaluate, pooled
from marlyap.simulation.rollout import Decentralised
from marlyap.tasks import Rendezvous


PURPOSES = ("train", "select", "evaluate", "calibrate", "certify", "perturb")
traces = Counter()


@pytest.fixture(scope="module")
def trainer(game, masac):
    """4 episodes of warm-up, room for 9, and 2 more in each iteration."""
    schedule = Schedule(
        steps=60,
        environments=2,
        steps_per_update=4,
        warmup=20,
        capacity=54,
        decay=0.1,
        select_episodes=64,
    )
    return Trainer(game, masac, schedule)


@pytest.fixture(scope="module")
def begun(trainer):
    return eqx.filter_jit(lambda trainer, key: trainer.begin(key)[0])(trainer, stream(0, "train"))


@eqx.filter_jit
def iterate(trainer, carry):
    traces["iterate"] += 1
    return trainer.iterate(carry)


@pytest.fixture(scope="module")
def later(trainer, begun):
    """The carries after 0, 1, 2, ... iterations."""
    carries = [begun]
    for _ in range(4):
        carries.append(iterate(trainer, carries[-1])[0])
    assert traces["iterate"] == 1
    return carries


def through_disk(carry):
    """Every array as bytes and back: what is not in the arrays is lost."""

    def pass_on(x):
        if not eqx.is_array(x):
            return x
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(jnp.asarray(np.array(jax.random.key_data(x))))
        return jnp.asarray(np.array(x))

    return jax.tree.map(pass_on, carry)


def test_two_halves_are_the_whole_to_the_last_bit(trainer, later):
    half = through_disk(later[2])
    twin = Trainer(trainer.game, trainer.algorithm, replace(trainer.schedule))
    for _ in range(2):
        half, _ = iterate(twin, half)
    assert same(half, later[4])
    assert not same(later[3], later[4])


def test_nothing_is_compiled_twice(trainer, later):
    kind = lambda tree: [
        (x.shape, x.dtype, x.aval.weak_type) for x in jax.tree.leaves(tree) if eqx.is_array(x)
    ]
    assert kind(later[0]) == kind(later[1]) == kind(later[4])
    assert jax.tree.structure(later[0]) == jax.tree.structure(later[4])


def test_the_warm_up_fills_the_memory(trainer, begun):
    memory, game = begun.learner.memory, trainer.game
    assert (memory.rows, memory.time) == (9, 6)
    assert (int(memory.size), int(memory.head)) == (4, 4)  # 20 steps are begun, not cut
    e = jax.tree.map(lambda x: np.asarray(x)[:4], memory.episodes)
    assert np.all(np.abs(e.action) <= 1) and np.std(e.action) == pytest.approx(3**-0.5, rel=0.15)
    np.testing.assert_allclose(e.log_prob, -game.dynamics.du * np.log(2), rtol=1e-6)
    assert not e.terminated.any()
    assert len(np.unique(e.features[:, 0, 0, 0])) == 4
    assert not np.any(np.asarray(memory.episodes.obs)[4:])
    assert int(begun.iteration) == 0


def test_each_iteration_plays_and_remembers(later):
    assert [int(c.learner.memory.size) for c in later] == [4, 6, 8, 9, 9]
    assert [int(c.learner.memory.head) for c in later] == [4, 6, 8, 1, 3]
    assert [int(c.iteration) for c in later] == [0, 1, 2, 3, 4]
    old, new = (np.asarray(c.learner.memory.episodes.features) for c in (later[1], later[2]))
    changed = np.any((old != new).reshape(9, -1), axis=1)
    np.testing.assert_array_equal(changed, np.isin(np.arange(9), [6, 7]))
    moved = lambda c: np.asarray(jax.tree.leaves(c.learner.networks.pi.value)[0])
    assert all(np.any(moved(a) != moved(b)) for a, b in zip(later, later[1:], strict=False))


def test_episodes_are_the_game_played_by_the_policy(trainer, later):
    """Each successor is one step of the game away, and the costs to go are of what followed."""
    game, T = trainer.game, 3
    learner, key = later[1].learner.networks, jax.random.key(3)

    @eqx.filter_jit
    def played(trainer, learner, key):
        e = trainer.play(trainer.algorithm.explore(learner), key, 1, CostWindow(T, beyond=True))
        k_start, _ = jax.random.split(jax.random.split(key, 1)[0])
        state = game.reset(k_start)
        see = lambda s, a: (game.observations(s), game.features(s), game.costs(s, a))
        step = lambda s, a: (game.step(s, a), see(s, a))
        last, seen = jax.lax.scan(step, state, e.action[0])
        log_prob = jax.vmap(Sampled(learner.pi.value).log_prob)(e.obs[0, :-1], e.action[0])
        return e, seen, (game.observations(last), game.features(last)), log_prob

    e, (obs, features, costs), last, log_prob = played(trainer, learner, key)
    for got, want, end in ((e.obs[0], obs, last[0]), (e.features[0], features, last[1])):
        np.testing.assert_allclose(got[:-1], want, atol=1e-5)
        np.testing.assert_allclose(got[-1], end, atol=1e-5)
    np.testing.assert_allclose(e.cost[0], costs, atol=1e-5)
    np.testing.assert_allclose(e.reward[0], -costs, atol=1e-5)
    np.testing.assert_allclose(e.log_prob[0], log_prob, atol=1e-4)
    # Rolled T steps further: no cost is made up at the end.
    to_go, ahead, c = (np.asarray(x[0]) for x in (e.cost_to_go, e.cost_ahead, e.cost))
    np.testing.assert_allclose(to_go[0], c[:T].sum(0), rtol=1e-5)
    np.testing.assert_allclose(ahead[:-T], c[T:], atol=1e-6)
    np.testing.assert_allclose(np.diff(to_go, axis=0), (ahead - c)[:-1], atol=1e-5)
    assert np.all(np.any(np.abs(ahead[-T:] - c[-1]) > 1e-4, axis=1))
    assert not np.any(e.terminated)


def test_learning_rates_decay_by_episodes(trainer):
    """0.075 ** (episode / 2000), the reading of section 2.8, or over the whole run."""
    at = lambda schedule, i: float(replace(trainer, schedule=schedule).decay(jnp.asarray(i)))
    paper = Schedule(environments=10, decay=0.075, decay_episodes=2000)
    assert at(paper, 0) == 1
    assert at(paper, 200) == pytest.approx(0.075, rel=1e-5)
    assert at(paper, 1) == pytest.approx(0.998706**10, rel=1e-4)
    assert at(paper, 400) == pytest.approx(0.075**2, rel=1e-5)
    whole = replace(trainer.schedule, decay=0.2)
    assert at(whole, trainer.iterations) == pytest.approx(0.2, rel=1e-5)
    assert at(whole, 1) == pytest.approx(0.2 ** (1 / trainer.iterations), rel=1e-5)


def test_the_decay_reaches_every_update(trainer, later):
    """So late that all rates are 0, parameters stay while the memory goes on."""
    end = eqx.tree_at(lambda c: c.iteration, later[1], later[1].iteration + 10**6)
    after, info = iterate(trainer, end)
    for part in ("pi", "Q", "log_alpha"):
        value = lambda c, part=part: getattr(c.learner.networks, part).value
        assert same(value(after), value(end))
        assert not same(value(later[2]), value(end))
    assert int(after.learner.memory.size) == 6 + 2
    assert all(np.isfinite(v).all() for v in info.log.values())


def test_budgets_are_counted_in_environment_steps(trainer):
    assert trainer.steps_per_iteration == 2 * 6
    assert trainer.iterations == 5
    assert trainer.updates_per_iteration == 3
    odd = replace(trainer, schedule=replace(trainer.schedule, steps=61, steps_per_update=100))
    assert odd.iterations == 6 and odd.updates_per_iteration == 1
    s = shape(trainer.game)
    assert (s.agents, s.du, s.errors) == (3, 2, 4)


def test_bad_schedules_are_named():
    for name in ("steps", "environments", "steps_per_update", "capacity"):
        with pytest.raises(UserError, match=f"^{name}: "):
            Schedule(**{name: 0})
    for bad in (0.0, 1.5, float("nan")):
        with pytest.raises(UserError, match="^decay: "):
            Schedule(decay=bad)


def test_the_best_policy_is_kept(trainer, later):
    select_best = eqx.filter_jit(lambda trainer, carry: trainer.select_best(carry))
    carry, info = select_best(trainer, later[1])
    policy = Decentralised(Greedy(later[1].learner.networks.pi_mean), trainer.game)
    final = evaluate(trainer.game, policy, 64, 0, "select").final
    assert float(info["success"]) == pytest.approx(np.mean(final <= trainer.game.radius))
    assert float(info["distance"]) == pytest.approx(np.mean(final), rel=1e-4)
    assert same(carry.best, trainer.algorithm.policy(later[1].learner.networks))
    unbeaten = eqx.tree_at(lambda c: c.score, later[1], jnp.asarray(2.0))
    kept, _ = select_best(trainer, unbeaten)
    assert same(kept.best, later[1].best) and float(kept.score) == 2
    assert same(kept.learner, later[1].learner)


# Random streams.


def test_streams_never_meet():
    """Neither between purposes nor between seeds, nor in the keys that are split off them."""
    keys = [stream(seed, purpose) for seed in range(40) for purpose in PURPOSES]
    keys.append(jax.random.key(0))
    split = jax.jit(jax.vmap(lambda k: jax.random.split(k, 8)))(jnp.stack(keys))
    data = np.asarray(jax.random.key_data(split)).reshape(-1, 2)
    assert len(np.unique(data, axis=0)) == len(data)
    assert same(stream(3, "train"), stream(3, "train"))


class Push(eqx.Module):
    """Everyone accelerates alike, by the same share of the limits."""

    share: Array

    def __call__(self, state, key):
        return jnp.broadcast_to(self.share, (state.x.shape[0], 2))


push = lambda share: Push(jnp.asarray(share, jnp.float32))


@eqx.filter_jit
def trajectories(game, controller, keys):
    return jax.vmap(lambda k: episode(game, controller, k))(keys)


@pytest.fixture(scope="module")
def wide(game):
    """The same game, easier to win."""
    return replace(game, radius=0.8)


def seen(game, share, seed, purpose="evaluate"):
    """64 episodes in float64."""
    keys = jax.random.split(stream(seed, purpose), 64)
    return jax.tree.map(lambda a: np.asarray(a, float), trajectories(game, push(share), keys))


def test_the_same_seed_gives_the_same_starts(wide):
    start = lambda *args: seen(wide, *args).state.x[:, 0]
    first = start(0.0, 3)
    np.testing.assert_array_equal(first, start(0.0, 3))
    np.testing.assert_array_equal(first, start(1.0, 3))  # whoever drives
    for seed, purpose in ((4, "evaluate"), (3, "train"), (3, "select"), (3, "certify")):
        assert not np.any(start(0.0, seed, purpose)[..., 0] == first[..., 0])
    more = jax.random.split(stream(3, "evaluate"), 64)
    assert same(jax.random.split(stream(3, "evaluate"), 4), more[:4])


def test_no_evaluation_starts_where_training_did(wide, begun):
    """Neither are the first observations of the memory among those of the evaluation."""
    e = begun.learner.memory.episodes
    state = seen(wide, 0.0, 0).state
    gap = state.scenario.goal[:, 0] - state.x[:, 0, :, :2]  # [episode, agent, 2]
    trained = np.linalg.norm(np.asarray(e.features)[:4, 0, :, :2], axis=-1)
    judged = np.linalg.norm(gap, axis=-1)
    assert np.min(np.abs(trained[:, None] - judged[None]).max(-1)) > 1e-3
    np.testing.assert_allclose(np.asarray(e.cost)[:4, 0], trained, rtol=1e-4)


# Evaluation.


def test_outcomes_are_those_of_the_trajectories(wide):
    got = evaluate(wide, push(0.3), 64, seed=1)
    e = seen(wide, 0.3, 1)
    distance = np.linalg.norm(e.state.x[..., :2] - e.state.scenario.goal, axis=-1).max(
        -1
    )  # [episode, time]
    np.testing.assert_allclose(got.final, distance[:, -1], rtol=1e-5)
    np.testing.assert_array_equal(got.held, (distance[:, -5:] <= wide.radius).all(1))
    spin = np.abs(e.state.x[:, -1, :, 4]).max(1)
    np.testing.assert_allclose(got.spin, spin, atol=1e-6)
    np.testing.assert_array_equal(got.at_rest, got.successes & (got.speed <= 0.1) & (spin <= 0.1))
    np.testing.assert_allclose(got.speed, np.abs(e.state.x[:, -1, :, 3]).max(1), atol=1e-5)
    np.testing.assert_allclose(got.total, e.reward.mean(2).sum(1), rtol=1e-5)
    kinds = set()
    for inside, settled in zip(distance <= wide.radius, got.settled, strict=True):
        stays = [t for t in range(len(inside)) if inside[t:].all()]
        assert settled == pytest.approx(stays[0] * wide.dt if stays else np.inf)
        kinds.add(min(stays[0], 1) if stays else "never")
    assert kinds == {0, 1, "never"}

    assert got.success_rate == np.mean(distance[:, -1] <= 0.8)
    summary = got.summary()
    assert summary["successes"] == got.successes.sum() and summary["episodes"] == 64
    low, high = summary["interval"]
    assert low < summary["success_rate"] < high
    both = pooled([got, got])
    assert both.success_rate == got.success_rate and len(both.final) == 128


def test_motion_that_the_state_does_not_hold_is_seen():
    """A point driven by its velocity circles inside the ball: its state has no velocity in it."""
    dynamics = SingleIntegrator((1.0, 1.0))
    point = Rendezvous(agents=1, dynamics=dynamics, size=0.01, radius=0.5, horizon=10)
    angle = lambda state: state.t / 2.0
    circle = lambda state, key: (
        0.4 * jnp.stack([jnp.cos(angle(state)), jnp.sin(angle(state))])[None]
    )
    moving, still = (
        evaluate(point, law, 8, beyond=0) for law in (circle, lambda s, k: jnp.zeros((1, 2)))
    )
    assert moving.successes.all() and not moving.at_rest.any() and still.at_rest.all()
    np.testing.assert_allclose(moving.speed, 0.4, rtol=1e-4)
    assert "keeps moving" in moving.rests() and still.rests() == "comes to rest"


def test_an_episode_that_is_not_finite_has_failed(wide):
    bad, still = evaluate(wide, push(np.nan), 64), evaluate(wide, push(0.0), 64)
    assert bad.success_rate == 0 < still.success_rate
    summary = bad.summary()
    assert summary["final_distance"]["0.5"] is None
    assert summary["held"]["successes"] == 0
    pairs = compare(still, bad)
    assert (pairs["only_a"], pairs["only_b"]) == (still.successes.sum(), 0)


def test_no_episodes_are_refused(game):
    for episodes in (0, -1):
        with pytest.raises(UserError, match="^episodes: "):
            evaluate(game, push(0.0), episodes)
    with pytest.raises(UserError, match="^beyond: "):
        evaluate(game, push(0.0), 1, beyond=-1)


def test_a_controller_of_the_wrong_shape_is_refused(game):
    with pytest.raises(UserError, match=r"^controller: it returns an action of shape \[3\], "):
        evaluate(game, lambda state, key: jnp.zeros(3), 4)


def test_an_evaluation_in_parts_is_that_of_the_whole(monkeypatch):
    """Rollouts that do not fit into memory are played a few at a time, on the same starts."""
    game = Rendezvous(agents=2, horizon=5)
    controller = CONTROLLERS["tree-pursuit"](game)
    whole = evaluate(game, controller, 10, seed=3)
    counted, play = [], evaluation.outcomes
    seen = lambda g, c, keys, beyond: (counted.append(len(keys)), play(g, c, keys, beyond))[1]
    monkeypatch.setattr(evaluation, "outcomes", seen)
    numbers = game.agents + sum(x.size for x in jax.tree.leaves(game.reset(jax.random.key(0))))
    monkeypatch.setattr(evaluation, "ROOM", 4 * numbers * 50)
    in_parts = evaluate(game, controller, 10, seed=3)
    assert counted == [4, 4, 2]
    for field in ("final", "total", "cost", "settled", "successes"):
        np.testing.assert_allclose(getattr(in_parts, field), getattr(whole, field), rtol=1e-5)
