"""The replay memory: what comes out is what went in, and n steps are summed as by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.learning.replay import Episode, Replay
from marlyap.simulation.rollout import cost_to_go


TIME, AGENTS, GAMMA = 5, 2, 0.9


def episode(number, end=None):
    """An episode whose every value says where it comes from; it terminates in step `end`."""
    t = np.arange(TIME + 1)[:, None, None]
    agent = np.arange(AGENTS)[None, :, None]
    value = lambda kind, time: 10_000 * number + 1000 * kind + 10.0 * t[:time] + agent
    flat = lambda kind: jnp.asarray(value(kind, TIME)[..., 0], jnp.float32)
    wide = lambda kind, time, size: jnp.asarray(
        np.repeat(value(kind, time), size, axis=2), jnp.float32
    )
    return Episode(
        obs=wide(1, TIME + 1, 3),
        features=wide(2, TIME + 1, 4),
        action=wide(3, TIME, 2),
        log_prob=flat(4),
        reward=flat(5),
        cost=flat(6),
        cost_to_go=flat(7),
        cost_ahead=flat(8),
        terminated=jnp.arange(TIME) >= (TIME if end is None else end),
    )


stack = lambda *episodes: jax.tree.map(lambda *x: jnp.stack(x), *episodes)
add = eqx.filter_jit(Replay.add)
sample = eqx.filter_jit(Replay.sample)
QUIET = jnp.zeros((AGENTS, 2, 2))
transition = eqx.filter_jit(lambda memory, row, t, *rest: memory.transition(row, t, QUIET, *rest))


def numbers(memory):
    return [int(v) // 10_000 for v in np.asarray(memory.episodes.obs[:, 0, 0, 0])]


@pytest.fixture(scope="module")
def memory():
    """Row 0 runs to the time limit, row 1 terminates in step 2; row 2 is empty."""
    return add(Replay.empty(episode(0), 3), stack(episode(1), episode(2, end=2)))


def test_ring():
    memory = Replay.empty(episode(0), 5)
    assert (memory.rows, memory.time, int(memory.size)) == (5, TIME, 0)
    seen = []
    for first in (1, 3, 5, 7):
        memory = add(memory, stack(episode(first), episode(first + 1)))
        seen.append((numbers(memory), int(memory.head), int(memory.size)))
    assert seen == [
        ([1, 2, 0, 0, 0], 2, 2),
        ([1, 2, 3, 4, 0], 4, 4),
        ([6, 2, 3, 4, 5], 1, 5),
        ([6, 7, 8, 4, 5], 3, 5),
    ]


def test_the_ring_fills_to_the_brim_and_overwrites_all():
    memory = add(Replay.empty(episode(0), 2), stack(episode(1), episode(2)))
    assert (numbers(memory), int(memory.head), int(memory.size)) == ([1, 2], 0, 2)
    memory = add(memory, stack(episode(3), episode(4)))
    assert (numbers(memory), int(memory.size)) == ([3, 4], 2)


def test_sampling_is_uniform_over_filled_rows_and_all_steps(memory):
    b = sample(memory, jax.random.key(0), 4000, GAMMA)
    where = np.asarray(b.obs[:, 0, 0])
    row, t = where // 10_000 - 1, (where % 1000) // 10
    count = np.zeros((2, TIME))
    np.add.at(count, (row.astype(int), t.astype(int)), 1)  # the empty row would be index -1
    assert count.sum() == 4000
    assert np.sum((count - 400) ** 2 / 400) < 27.9  # chi-squared, 9 degrees, 0.1 %
    other = sample(memory, jax.random.key(1), 4000, GAMMA)
    assert np.any(where != np.asarray(other.obs[:, 0, 0]))


def test_every_field_is_of_the_same_step_and_next_is_the_true_successor(memory):
    b = sample(memory, jax.random.key(2), 200, GAMMA)
    base = np.asarray(b.obs[:, 0, 0]) - 1000
    columns = {
        "features": 2000, "action": 3000, "log_prob": 4000, "reward": 5000, "cost": 6000,
        "cost_to_go": 7000, "cost_ahead": 8000, "next_obs": 1010, "next_features": 2010,
    }  # fmt: skip
    for name, offset in columns.items():
        value = np.asarray(getattr(b, name)).reshape(200, AGENTS, -1)
        want = (base + offset)[:, None, None] + np.arange(AGENTS)[None, :, None]
        np.testing.assert_array_equal(value, np.broadcast_to(want, value.shape), err_msg=name)


def by_hand(end, t, n, number):
    """Reward, discount and successor, step by step."""
    e, reward, discount, at = episode(number, end), np.zeros(AGENTS), 1.0, t
    for _ in range(n):
        if at == TIME:  # the time limit: what follows is not known, but is worth something
            break
        reward += discount * np.asarray(e.reward[at])
        discount *= GAMMA
        at += 1
        if e.terminated[at - 1]:
            return reward, 0.0, at
    return reward, discount, at


@pytest.mark.parametrize("n", [1, 3, 8])
@pytest.mark.parametrize(("row", "end"), [(0, None), (1, 2)])
def test_n_steps_by_hand(memory, row, end, n):
    """t9: the time limit never takes the bootstrap away, termination always does."""
    for t in range(TIME if end is None else end + 1):
        b = transition(memory, jnp.asarray(row), jnp.asarray(t), GAMMA, n)
        reward, discount, at = by_hand(end, t, n, row + 1)
        np.testing.assert_allclose(b.reward, reward, rtol=1e-6)
        assert float(b.discount) == pytest.approx(discount, rel=1e-6)
        if discount:  # after termination the successor does not count
            np.testing.assert_array_equal(b.next_obs, memory.episodes.obs[row, at])
            np.testing.assert_array_equal(b.next_features, memory.episodes.features[row, at])
            assert discount == pytest.approx(GAMMA ** (at - t))


def test_the_last_step_before_the_time_limit_bootstraps(memory):
    last = transition(memory, jnp.asarray(0), jnp.asarray(TIME - 1), GAMMA, 1)
    assert float(last.discount) == pytest.approx(GAMMA)
    ended = transition(memory, jnp.asarray(1), jnp.asarray(2), GAMMA, 1)
    assert float(ended.discount) == 0


def test_what_follows_termination_does_not_count(memory):
    b = transition(memory, jnp.asarray(1), jnp.asarray(1), GAMMA, 4)
    r = memory.episodes.reward[1]
    np.testing.assert_allclose(b.reward, r[1] + GAMMA * r[2], rtol=1e-6)


def test_cost_to_go_by_hand():
    c = jnp.asarray([[1.0, 10], [2, 20], [4, 40], [8, 80], [16, 160]])
    to_go, ahead = cost_to_go(c, 2, 3)
    np.testing.assert_array_equal(to_go, [[3, 30], [6, 60], [12, 120]])
    np.testing.assert_array_equal(ahead, c[2:5])


def test_costs_past_the_end_stay_what_they_were():
    """Dropping them would teach L to fall with the clock."""
    c = jnp.asarray([[1.0], [2], [4]])
    to_go, ahead = cost_to_go(c, 3, 3)
    np.testing.assert_array_equal(to_go[:, 0], [7, 10, 12])
    np.testing.assert_array_equal(ahead[:, 0], [4, 4, 4])
