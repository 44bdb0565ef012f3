"""What the hand-written controllers share: their seam, and what one agent may know."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.games.planar import AbstractPlanar
from marlyap.games.wrapper import AbstractWrapper
from marlyap.types import Action, Key, State


Robots = AbstractPlanar | AbstractWrapper  # robots in the plane, as they are or wrapped


class AbstractController(eqx.Module):
    """A control law for a team; its fields are the game and the gains.

    Row i of the action may depend on agent i, on its neighbours in this state and, for a leader,
    on its goal. Nothing enforces this: a law that reads more is centralised. A controller keeps no
    memory, and is a pytree, so that jit compiles it once.

    Raises UserError for a game whose dynamics, or plant, are none of `drives`.
    """

    game: eqx.AbstractVar[AbstractGame]
    drives: ClassVar[tuple[type, ...]] = ()  # dynamics or plants, exactly these; empty: any

    def __check_init__(self):
        moves = self.game.plant.moves
        if self.drives and moves not in self.drives:
            known = " or ".join(cls.__name__ for cls in self.drives)
            raise UserError(
                f"controller: {type(self).__name__} drives {known} only, not {moves.__name__}; "
                "choose another controller or task, or other dynamics for the task."
            )

    @abc.abstractmethod
    def __call__(self, state: State, key: Key) -> Action:
        """The inputs of all agents, each divided by its limit, in [-1, 1].

        `key` is for laws that act at random.
        """


def headings(game: Robots, state: State) -> Float[Array, "agent 2"]:
    """h_i, the unit vector along each agent's forward axis."""
    return jax.vmap(game.dynamics.heading)(state.x)


def left(h: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """The vector n a quarter turn to the left of h."""
    return jnp.stack([-h[..., 1], h[..., 0]], axis=-1)


def mean_pull(
    game: Robots, state: State, q: Float[Array, "agent 2"], leader_gain: float
) -> Float[Array, "agent 2"]:
    """e_i = (sum_j (q_j - q_i) + b_i (p*_i - q_i)) / (sum_j 1 + b_i), j over the neighbours (m).

    b_i is `leader_gain` for a leader and 0 for a follower; e_i is 0 where nothing pulls.
    """
    linked = game.linked(state)
    b = jnp.where(jnp.asarray(game.leads), leader_gain, 0.0)
    gaps = jnp.where(linked[:, :, None], q[None, :] - q[:, None], 0.0)
    weight = jnp.sum(linked, axis=1) + b
    pull = jnp.sum(gaps, axis=1) + b[:, None] * (game.goals(state) - q)
    return pull / jnp.where(weight > 0, weight, 1.0)[:, None]


def needs_a_chain(game: AbstractGame, agents: int | None = None) -> None:
    """Raise UserError unless agent 0 leads, and every other one sees the one before it."""
    i = np.arange(1, game.agents)
    if not game.leads[0] or not game.adjacency[i, i - 1].all():
        raise UserError("controller: it needs agent 0 as a leader and graph path or complete.")
    if agents is not None and agents != game.agents:
        raise UserError(f"controller: it has gains for {agents} agents, not for {game.agents}.")


def as_action(game: AbstractGame, u: Float[Array, "agent du"]) -> Action:
    """Physical inputs, in the units of the plant, as an action: over their limits, and clipped."""
    return jnp.clip(u / jnp.asarray(game.plant.limits)[None], -1.0, 1.0)
