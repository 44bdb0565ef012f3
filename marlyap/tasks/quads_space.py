"""Quadrotors in formation in space, asked for thrust and body rates."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap.games.quadrotors import SpaceQuads, unit
from marlyap.tasks.cartpoles import check_weights
from marlyap.tasks.quads import AbstractQuads
from marlyap.types import State


class SpaceFormation(AbstractQuads):
    """Four quadrotors hover at the corners of a tilted square; only the first is told its place.

    All share a compass and know the displacements between their places. The cost of one is
    |goal - p|^2 + 0.1 |v|^2 + 0.1 |tilt|^2 + 0.01 |w|^2 + 0.01 |a|^2, the tilt being twice the
    vector part of q. The team fails when one is upside down, or 5 m from its place along an axis.
    """

    agents: int = 4  # N
    leaders: tuple[int, ...] = (0,)  # the agents that are told their place
    graph: str = "path"  # who sees whom
    plant: SpaceQuads = SpaceQuads()  # pyright: ignore
    spacing: float = 0.5  # side of the square, and between squares of four, one above another (m)
    size: float = 0.5  # places of agent 0 are uniform in [-size, size]^3 (m)
    radius: float = 0.1  # a quadrotor this close to its place has arrived (m)
    calm: float = 0.1  # if it is also no faster than this (m/s)
    most: float = 5.0  # farther from a place the team has failed (m)
    weights: tuple[float, ...] = (1.0, 0.1, 0.1, 0.01)  # of squared gap, velocity, tilt and rates
    effort: float = 0.01  # weight of the squared action in the cost
    gust: float = 0.0  # largest acceleration by a gust, at a random time of an episode (m/s^2)
    inertia_spread: float = 0.0  # inertias are drawn anew in an episode, up to this share off
    start: tuple[float, ...] = (1.0, 0.1, 0.1, 0.1)  # places, velocities, quaternions, rates, up to
    dt: float = 0.02  # s
    horizon: int = 250  # steps in an episode

    def __check_init__(self):
        check_weights(self.start, 4, "start")

    @property
    def places(self):
        corner, layer = np.arange(self.agents) % 4, np.arange(self.agents) // 4
        raised = np.where(corner == 3, 0.5, 0.0) + layer
        return self.spacing * np.stack([corner % 3 > 0, corner >= 2, raised], axis=1)

    def reset(self, key):
        k_x, k_flight = jax.random.split(key)
        most = jnp.repeat(jnp.array(self.start), jnp.array([3, 3, 4, 3]), total_repeat_length=13)
        off = most[None] * jax.random.uniform(k_x, (self.agents, 13), minval=-1.0)
        level = self.plant.hovering(jnp.zeros((self.agents, 3)))
        x = unit(level + off.at[:, 6].set(0.0))
        return State(x=x, scenario=self.flight(k_flight), t=jnp.asarray(0))

    def farther(self, state, factor):
        there = self.at_target(state).x
        x = unit(there + factor * (state.x - there))
        return eqx.tree_at(lambda s: s.x, state, x)
