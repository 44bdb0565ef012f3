"""What goes wrong in training: followers that fall silent, commands that come late, noise."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.errors import UserError
from marlyap.games.perturbed import Perturbed
from marlyap.runs import config
from marlyap.simulation.rollout import rollout
from marlyap.tasks import TASKS
from marlyap.tasks.consensus import Consensus
from marlyap.tasks.rendezvous import Rendezvous


GAME = Rendezvous(horizon=8)


@eqx.filter_jit
def played(game, keys):
    push = lambda state, key: 0.4 * jnp.ones((game.agents, game.du))
    return jax.vmap(lambda k: rollout(game, push, game.reset(k), k))(keys)


def test_a_silent_follower_stands_and_is_judged_by_nobody():
    game = Perturbed(GAME, silent=1.0)
    paths = played(game, jax.random.split(jax.random.key(0), 32))
    gone = np.asarray(jax.vmap(jax.vmap(game.silenced))(paths.state))
    assert not gone[..., 0].any() and gone[:, -1].sum() == 32  # one follower each, no leader
    assert {*gone[:, -1].argmax(axis=1)} == {1, 2}
    first = gone.any(axis=2).argmax(axis=1)
    assert len({*first}) > 4
    assert (np.diff(gone.astype(int), axis=1) >= 0).all()  # it stays so
    x = np.asarray(paths.state.x)
    for episode, start in enumerate(first):
        who = gone[episode, -1].argmax()
        if start < 8:
            rest = x[episode, start + 1 :, who]
            np.testing.assert_array_equal(rest, np.broadcast_to(rest[:1], rest.shape))
            assert (rest[:, 3:] == 0).all()
    assert (np.asarray(paths.cost)[gone[:, :-1]] == 0).all()
    assert (np.asarray(paths.cost)[~gone[:, :-1]] > 0).all()


def test_commands_act_late():
    game = Perturbed(GAME, late=0.05)
    keys = jax.random.split(jax.random.key(1), 64)
    v = np.asarray(played(game, keys).state.x[:, 1, 0, 3])  # after 0.4 of 5 m/s^2 for 0.1 s - late
    late = 0.1 - v / 2.0
    assert 0 <= late.min() < 0.01 and 0.04 < late.max() <= 0.05 and len({*late}) > 30


@eqx.filter_jit
def stepped(game, plain, key):
    """Observations before and after a step of both games, and states."""
    start = game.reset(key)
    inside, zero = game.inside(start), jnp.zeros((game.agents, game.du))
    after, other = game.step(start, zero), plain.step(inside, zero)
    return (
        game.observations(start), plain.observations(inside), game.observations(after),
        after.x, other.x,
    )  # fmt: skip


def test_sensors_err_and_nothing_moves_for_it():
    game = Perturbed(GAME, measured=0.1)
    seen, plain, later, x, other = map(np.asarray, stepped(game, GAME, jax.random.key(2)))
    apart = seen - plain
    assert 0.01 < np.abs(apart[:, 0]).max() < 1 and (apart[:, 2] == 0).all()  # v; the leader's flag
    np.testing.assert_array_equal(x, other)
    assert (later[:, 0] != seen[:, 0]).all()


def test_nothing_changes_without_them():
    seen, plain, _, x, other = map(np.asarray, stepped(Perturbed(GAME), GAME, jax.random.key(3)))
    np.testing.assert_array_equal(x, other)
    np.testing.assert_array_equal(seen, plain)


def test_the_task_is_recorded_and_changed_by_name():
    game = TASKS["rendezvous-robust"]
    assert config.build(config.record(game), config.known(), "task") == game
    changed = {"task.silent": "0.3", "task.inner.agents": "4"}
    new = config.override_all({"task": game}, changed)["task"]
    assert new.silent == 0.3 and new.agents == 4 and new.nominal == Rendezvous(agents=4)


@pytest.mark.parametrize(
    ("inner", "change", "said"),
    [
        (GAME, {"silent": 2.0}, "silent must lie between 0 and 1"),
        (GAME, {"late": 0.1}, "late between 0 and dt"),
        (GAME, {"measured": -1.0}, "must not be negative"),
        (Consensus(), {"measured": 0.1}, "Consensus is no game of robots"),
        (dataclasses.replace(GAME, leaders=(0, 1, 2)), {"silent": 0.1}, "nobody but leaders"),
    ],
)
def test_what_cannot_be_is_refused(inner, change, said):
    with pytest.raises(UserError, match=said):
        Perturbed(inner, **change)
