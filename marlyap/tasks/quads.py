"""What quadrotors in formation share, planar or in space."""

import abc
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from marlyap.errors import check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.planar import check_leaders
from marlyap.games.quadrotors import AbstractFlyers, Flight
from marlyap.games.sensing import beside, beside_entries, near
from marlyap.tasks.cartpoles import check_weights
from marlyap.types import Entry, Key, Scene


class AbstractQuads(AbstractRegulation):
    """Quadrotors that hover at their places; only leaders know theirs.

    All share a compass and know the displacements between their places. The cost of one weighs the
    squares of its gap, velocity, tilt, rates and action. The team fails when one is upside down, or
    farther than `most` from its place along an axis.
    """

    plant: eqx.AbstractVar[AbstractFlyers]  # pyright: ignore
    leaders: eqx.AbstractVar[tuple[int, ...]]
    radius: eqx.AbstractVar[float]
    calm: eqx.AbstractVar[float]
    most: eqx.AbstractVar[float]
    weights: eqx.AbstractVar[tuple[float, ...]]
    effort: eqx.AbstractVar[float]
    gust: eqx.AbstractVar[float]
    inertia_spread: eqx.AbstractVar[float]
    spacing: eqx.AbstractVar[float]
    size: eqx.AbstractVar[float]

    def __check_init__(self):
        for name in ("radius", "calm", "most"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("effort", "gust", "spacing", "size"):
            check_range(name, getattr(self, name), 0, 1e6)
        check_range("inertia_spread", self.inertia_spread, 0, 0.99)
        check_weights(self.weights, 4)
        check_leaders(self.leaders, self.agents)

    @property
    @abc.abstractmethod
    def places(self) -> Float[np.ndarray, "agent d"]:
        """The formation: the place of each agent, from that of agent 0 (m)."""

    @property
    def leads(self):
        return np.isin(np.arange(self.agents), self.leaders)

    @property
    def tolerances(self):
        ways, angles = self.plant.ways, self.plant.angles
        return (
            *(Tolerance(f"position - goal, {w}", "m", self.radius, "world") for w in ways),
            *(Tolerance(f"velocity, {w}", "m/s", self.calm, "world") for w in ways),
            *(Tolerance(f"{a}", "rad") for a in angles),
            *(Tolerance(f"rate of {a}", "rad/s", frame="own") for a in angles),
        )

    def flight(self, key: Key) -> Flight:
        """The scenario of an episode."""
        k_goal, k_gust, k_time, k_body = jax.random.split(key, 4)
        n, d = self.agents, len(self.plant.ways)
        centre = jax.random.uniform(k_goal, (d,), minval=-self.size, maxval=self.size)
        return Flight(
            goal=centre[None] + jnp.asarray(self.places, jnp.float32),
            gust=self.gust * jax.random.uniform(k_gust, (n, d), minval=-1.0),
            begins=jax.random.uniform(k_time, ()) * self.horizon * self.dt,
            inertia=1 + self.inertia_spread * jax.random.uniform(k_body, (n,), minval=-1.0),
        )

    def observe(self, state, links):
        """Its own motion, its goal if it is told, and each neighbour against where it should be."""
        p, v, tilt, rates = self.plant.parts(state.x)
        told = jnp.asarray(self.leads)[:, None]
        q = p - jnp.asarray(self.places, p.dtype)
        goal, gap = jnp.where(told, state.scenario.goal - p, 0.0), q[None, :] - q[:, None]
        own = [tilt, rates, v, told.astype(p.dtype), goal, near(goal, self.radius)]
        seen = [gap, near(gap, self.radius), v[None, :] - v[:, None]]
        seen = jnp.concatenate(seen, axis=2)
        return beside(jnp.concatenate(own, axis=1), seen, jnp.asarray(self.slots), links)

    def observation_entries(self):
        def along(what: str, unit: str) -> tuple[Entry, ...]:
            return tuple(Entry(f"{what}, {way}", unit, "world") for way in self.plant.ways)

        own = (
            *(Entry(f"{angle}", "rad") for angle in self.plant.angles),
            *(Entry(f"rate of {angle}", "rad/s", "own") for angle in self.plant.angles),
            *along("velocity", "m/s"),
            Entry("1 if the goal is told, else 0"),
            *along("goal - position, 0 if not told", "m"),
            *along("e / (|e| + radius) of e = goal - position", "1"),
        )
        gap = "position of {j} - own - displacement"
        seen = (
            *along(gap, "m"),
            *along(f"e / (|e| + radius) of e = {gap}", "1"),
            *along("velocity of {j} - own", "m/s"),
        )
        return beside_entries(own, seen, self.slots.shape[1])

    def errors(self, state):
        p, *rest = self.plant.parts(state.x)
        return jnp.concatenate([p - state.scenario.goal, *rest], axis=1)

    def distance(self, state):
        """How far each is from its place, or how fast, in units of what is tolerated."""
        p, v, _, _ = self.plant.parts(state.x)
        size = lambda y: jnp.linalg.norm(y, axis=1)
        return jnp.maximum(size(p - state.scenario.goal) / self.radius, size(v) / self.calm)

    def costs(self, state, action):
        p, *rest = self.plant.parts(state.x)
        parts = (p - state.scenario.goal, *rest, jnp.clip(action, -1.0, 1.0))
        squares = [jnp.sum(part**2, axis=1) for part in parts]
        return jnp.stack(squares, axis=1) @ jnp.array([*self.weights, self.effort])

    def failed(self, state):
        p, *_ = self.plant.parts(state.x)
        up = self.plant.frame(state.x)[:, -1, -1]
        return ~jnp.all((up >= 0) & jnp.all(jnp.abs(p - state.scenario.goal) <= self.most, axis=1))

    @property
    def edge_cost(self):
        return max(self.weights[0] * self.radius**2, self.weights[1] * self.calm**2)

    @property
    def failure_cost(self):
        return 30.0

    def at_target(self, state):
        return eqx.tree_at(lambda s: s.x, state, self.plant.hovering(state.scenario.goal))

    def scene(self, state):
        p, v, _, rates = self.plant.parts(state.x)
        return Scene(
            position=p,
            velocity=v,
            frame=self.plant.frame(state.x),
            goal=state.scenario.goal,
            spin=jnp.sqrt(jnp.sum(rates**2, axis=1)),
        )

    def state_shapes(self, state):
        goals = (self.agents, len(self.plant.ways))
        x = {"x": (state.x, (self.agents, len(self.plant.states)))}
        return super().state_shapes(state) | x | {"goals": (state.scenario.goal, goals)}

    def resized(self, agents):
        leaders = tuple(i for i in self.leaders if i < agents)
        return dataclasses.replace(self, agents=agents, leaders=leaders)  # pyright: ignore
