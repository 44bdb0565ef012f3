"""The starts of an evaluation, for simulators that run without JAX."""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.seeds import stream
from marlyap.simulation.evaluation import episode
from marlyap.simulation.rollout import Decentralised


class Starts(NamedTuple):
    """Where evaluation episodes begin, and where they end in JAX."""

    x: np.ndarray  # [episode, agent, state]
    goal: np.ndarray  # [episode, agent, 2] (m)
    final: np.ndarray  # [episode, agent], distance at the horizon (m)

    def first(self, count: int) -> "Starts":
        return Starts(*(part[:count] for part in self))


def drawn(game: AbstractGame, controller: Decentralised, episodes: int) -> Starts:
    """The starts that `evaluate` draws with seed 0 for so many episodes, and how they end.

    Raises UserError where goals move, which no bundle can express.
    """

    @eqx.filter_jit
    def played(controller, keys):
        def one(key):
            path = episode(game, controller, key)
            first, last = (jax.tree.map(lambda leaf, k=k: leaf[k], path.state) for k in (0, -1))
            goals = game.goals  # pyright: ignore[reportAttributeAccessIssue] -- a planar game
            return first.x, goals(first), goals(last), game.distance(last)

        return jax.vmap(one)(keys)

    keys = jax.random.split(stream(0, "evaluate"), episodes)
    x, goal, later, final = map(np.asarray, played(controller, keys))
    if not np.array_equal(goal, later):
        raise UserError("export: the goals of this task move, which a bundle cannot express yet.")
    return Starts(x, goal, final)
