"""Tree pursuit: every agent drives to where the next agent towards a leader will stop (B5)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from marlyap import graph as graphs
from marlyap.controllers.cascade import Cascade
from marlyap.controllers.controller import AbstractController, Robots, as_action, headings
from marlyap.controllers.drives import PointDrive, drive_of
from marlyap.games.dynamics import LateUnicycle, Unicycle
from marlyap.types import Links, State


class TreePursuit(AbstractController):
    """A leader drives to its goal, a follower to the predicted stop point of its parent.

    Each starts from where it will be when its inputs act.

    The parent of i is the neighbour with the fewest hops to a leader (the lowest index among
    equals), so errors travel down a tree only. It will stop about `margin` v_j^2 / (2 a_max) ahead
    on its heading. An agent needs its neighbours' hop counts, one local message, and its parent's
    velocity. An agent that no path joins to a leader brakes.
    """

    drives = (Unicycle, LateUnicycle)

    game: Robots
    margin: float = 1.9  # predicted stopping distance over the shortest possible
    cascade: Cascade = Cascade()

    def __call__(self, state, key):
        leads, parent = jnp.asarray(self.game.leads), self.parents(state)
        dynamics, v = self.game.dynamics, state.x[:, 3]
        stop = self.margin * v * jnp.abs(v) / (2 * dynamics.limits[0])
        ends = self.game.positions(state) + stop[:, None] * headings(self.game, state)
        x = jax.vmap(lambda x: dynamics.predict(x, self.game.dt))(state.x)
        p = jax.vmap(dynamics.position)(x)
        follow = jnp.where((parent >= 0)[:, None], ends[parent], p)
        e = jnp.where(leads[:, None], self.game.goals(state), follow) - p
        u = jax.vmap(self.cascade, in_axes=(None, 0, 0))(self.game, x, e)
        return as_action(self.game, u)

    def parents(self, state: State) -> Int[Array, "agent"]:
        """The parent of each agent, -1 where there is no path to a leader."""
        return parents(self.game, self.game.linked(state))


class PointPursuit(AbstractController):
    """Drive a leader to its goal, a follower to where its parent will stop: for point masses.

    As `TreePursuit`, by the law of `drives.PointDrive`, also for those that run away by themselves.
    """

    drives = PointDrive.moves

    game: Robots

    def __call__(self, state, key):
        game, law = self.game, drive_of(self.game)
        parent = parents(game, game.linked(state))
        places = jnp.asarray(game.displacements, state.x.dtype)
        ends = jax.vmap(lambda x: law.stop(game, x))(state.x)
        follow = ends[parent] + places - places[parent]
        q = jnp.where((parent >= 0)[:, None], follow, ends)
        q = jnp.where(jnp.asarray(game.leads)[:, None], game.goals(state), q)
        return as_action(game, jax.vmap(lambda x, q: law.drive(game, x, q))(state.x, q))


def parents(game: Robots, linked: Links) -> Int[Array, "agent"]:
    """The parent of each agent over these links, -1 where there is no path to a leader.

    It is the neighbour with the fewest hops to a leader, the lowest index among equals.
    """
    n = game.agents
    if graphs.disk_radius(game.graph) is None:
        hops = jnp.asarray(graphs.hops(game.adjacency, game.informed))
    else:
        start = jnp.where(jnp.asarray(game.leads), 0, n)
        relax = lambda _, h: jnp.minimum(h, 1 + jnp.min(jnp.where(linked, h[None], n), axis=1))
        hops = jax.lax.fori_loop(0, n - 1, relax, start)
    seen = jnp.where(linked, hops[None], n)
    return jnp.where(jnp.min(seen, axis=1) < n, jnp.argmin(seen, axis=1), -1)
