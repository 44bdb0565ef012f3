"""The starts of an evaluation, for simulators that run without JAX."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.seeds import stream
from marlyap.simulation.evaluation import episode
from marlyap.simulation.rollout import Decentralised
from marlyap.types import Key, Keys, State


class Starts(NamedTuple):
    """Where evaluation episodes begin, and where they end in JAX."""

    x: np.ndarray  # [episode, agent, state]
    goal: np.ndarray  # [episode, agent, 2] (m)
    final: np.ndarray  # [episode, agent], distance at the horizon (m)

    def first(self, count: int) -> "Starts":
        return Starts(*(part[:count] for part in self))


class Played(NamedTuple):
    """States of evaluation episodes: the first, one on the way, and the last."""

    first: State
    way: State  # of the k-th episode, after k steps, modulo its horizon
    last: State


@eqx.filter_jit
def _played(game: AbstractGame, controller: Decentralised, keys: Keys) -> Played:
    n = jnp.arange(keys.shape[0]) % (game.horizon + 1)

    def one(key: Key, k: Int[Array, ""]) -> Played:
        states = episode(game, controller, key).state
        at = lambda k: jax.tree.map(lambda leaf: leaf[k], states)
        return Played(at(0), at(k), at(-1))

    return jax.vmap(one)(keys, n)


def played(game: AbstractGame, controller: Decentralised, episodes: int) -> Played:
    """So many of the episodes that `evaluate` plays with seed 0."""
    return _played(game, controller, jax.random.split(stream(0, "evaluate"), episodes))


def of(game: AbstractGame, states: Played) -> Starts:
    """Where these episodes of a planar game begin and end.

    Raises UserError where goals move, which no bundle can express.
    """
    goals = jax.vmap(game.goals)  # pyright: ignore[reportAttributeAccessIssue] -- of planar games
    goal, later = np.asarray(goals(states.first)), np.asarray(goals(states.last))
    if not np.array_equal(goal, later):
        raise UserError("export: the goals of this task move, which a bundle cannot express yet.")
    final = np.asarray(jax.vmap(game.distance)(states.last))
    return Starts(np.asarray(states.first.x), goal, final)
