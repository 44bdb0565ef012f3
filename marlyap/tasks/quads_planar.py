"""Planar quadrotors in formation, with little thrust to spare."""

import jax
import jax.numpy as jnp
import numpy as np

from marlyap.games.quadrotors import PlanarQuads
from marlyap.tasks.cartpoles import check_weights
from marlyap.tasks.quads import AbstractQuads
from marlyap.types import State


class PlanarFormation(AbstractQuads):
    """Three planar quadrotors hover in a row; only the first is told its place.

    All share a compass and know the displacements between their places. The cost of one is
    |goal - p|^2 + 0.1 |v|^2 + 0.1 theta^2 + 0.01 theta'^2 + 0.01 |a|^2. The team fails when one is
    upside down, or 5 m from its place along an axis. With a tenth of the thrust to spare it is a
    game of saturation: the linear-quadratic optimum, clipped, loses half of the starts.
    """

    agents: int = 3  # N
    leaders: tuple[int, ...] = (0,)  # the agents that are told their place
    graph: str = "path"  # who sees whom
    plant: PlanarQuads = PlanarQuads()  # pyright: ignore
    spacing: float = 0.5  # between the places (m)
    size: float = 0.5  # places of agent 0 are uniform in [-size, size]^2 (m)
    radius: float = 0.1  # a quadrotor this close to its place has arrived (m)
    calm: float = 0.1  # if it is also no faster than this (m/s)
    most: float = 5.0  # farther from a place the team has failed (m)
    weights: tuple[float, ...] = (1.0, 0.1, 0.1, 0.01)  # of squared gap, velocity, tilt and rates
    effort: float = 0.01  # weight of the squared action in the cost
    gust: float = 0.0  # largest acceleration by a gust, at a random time of an episode (m/s^2)
    inertia_spread: float = 0.0  # inertias are drawn anew in an episode, up to this share off
    start: tuple[float, ...] = (1.0, 0.5, 0.2, 0.1, 0.1, 0.1)  # of each state, up to (m, rad, s)
    dt: float = 0.02  # s
    horizon: int = 250  # steps in an episode

    def __check_init__(self):
        check_weights(self.start, 6, "start")

    @property
    def places(self):
        return self.spacing * np.arange(self.agents)[:, None] * np.array([[1.0, 0.0]])

    def reset(self, key):
        k_x, k_flight = jax.random.split(key)
        off = jax.random.uniform(k_x, (self.agents, 6), minval=-1.0) * jnp.array([self.start])
        middle = self.places - self.places.mean(axis=0)
        x = self.plant.hovering(jnp.asarray(middle, jnp.float32)) + off
        return State(x=x, scenario=self.flight(k_flight), t=jnp.asarray(0))
