"""Estimation: sensors that see one coordinate each agree on where a moving target is."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.games.sensing import beside, beside_entries, noise
from marlyap.tasks.consensus import NETWORK
from marlyap.types import Entry, Scalar, Scene, State


class Target(eqx.Module):
    """The scenario: where the target starts, and what this episode's noise follows from."""

    place: Float[Array, "2"]  # (m)
    seed: UInt32[Array, "2"]


class Prediction(AbstractPlant):
    """Estimates of a target that turns about the origin and drifts outwards.

    The target moves by z+ = A z + w with A = growth Rot(turn); an agent corrects its estimate by u
    and predicts with the same A. What is kept is its error e = estimate - z,

        e_i+ = A (e_i + u_i) - w,

    in which nothing cancels however far out the target is.
    """

    limits: tuple[float, ...] = (2.0, 2.0)  # largest correction in a step (m)
    integrator: Integrator = "euler"
    growth: float = 1.01  # of the target's distance from the origin, by step
    turn: float = 0.1  # of the target about the origin, by step (rad)
    period: float = 0.05  # of a step (s)
    wander: float = 0.0  # standard deviation of w (m)
    states: ClassVar[tuple[Entry, ...]] = tuple(
        Entry(f"estimate - target, {axis}", "m", "world") for axis in "xy"
    )
    inputs: ClassVar[tuple[Entry, ...]] = tuple(
        Entry(f"correction, {axis}", "m", "world") for axis in "xy"
    )
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1),)

    def __check_init__(self):
        check_range("growth", self.growth, 0, 100, open=True)
        check_range("turn", self.turn, -100, 100)
        check_range("period", self.period, 0, 10, open=True)
        check_range("wander", self.wander, 0, 1e6)

    def field(self, x, u, scenario, time):
        new = turned(x + u, self.turn, self.growth)
        if self.wander:
            step = jnp.round(time / self.period).astype(int)
            new = new - self.wander * noise(scenario.seed, step, (1, 2))
        return (new - x) / self.period


def turned(
    v: Float[Array, "n 2"], angle: float | Scalar, growth: float | Scalar
) -> Float[Array, "n 2"]:
    """Vectors turned to the left by an angle (rad) and stretched."""
    c, s = growth * jnp.cos(angle), growth * jnp.sin(angle)
    return jnp.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]], axis=1)


class Estimation(AbstractRegulation):
    """Each sensor measures one coordinate of the target and hears its neighbours' estimates.

    Sensors with an even number measure x, the others y, so that none can follow the target by
    itself: distributed Kalman filtering with consensus on estimates (Olfati-Saber, Proc. IEEE Conf.
    Decision and Control, 2007 and 2009). Unstable without control, by 1 % a step. The cost of an
    agent is the squared length of its error (m^2). The team fails when an error exceeds `most` in
    x or y.
    """

    agents: int = 10  # N
    graph: str = NETWORK  # who hears whom
    plant: Prediction = Prediction()  # pyright: ignore
    near: float = 0.05  # an estimate this close to the target has arrived (m)
    most: float = 20.0  # farther off the team has failed (m)
    start: float = 1.0  # the target and the errors start uniform in [-start, start]^2 (m)
    noise: float = 0.0  # standard deviation of a measurement (m)
    dt: float = 0.05  # s
    horizon: int = 100  # steps in an episode

    def __check_init__(self):
        for name in ("near", "most", "start"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        check_range("noise", self.noise, 0, 1e6)
        if self.dt != self.plant.period:
            raise UserError(f"dt: {self.dt} s is not plant.period; set both alike.")

    @property
    def edge(self):
        return self.near

    @property
    def unit(self):
        return "m"

    @property
    def kinds(self):
        return np.arange(self.agents) % 2

    @property
    def tolerances(self):
        return tuple(Tolerance(e.name, e.unit, self.near, e.frame) for e in self.plant.states)

    def reset(self, key):
        k_target, k_x, k_noise = jax.random.split(key, 3)
        place = self.start * jax.random.uniform(k_target, (2,), minval=-1.0)
        x = self.start * jax.random.uniform(k_x, (self.agents, 2), minval=-1.0)
        target = Target(place, jax.random.key_data(k_noise))
        return State(x=x, scenario=target, t=jnp.asarray(0))

    @property
    def measures(self) -> Float[np.ndarray, "agent 2"]:
        """H_i: the axis along which each sensor measures."""
        return np.eye(2)[self.kinds]

    def innovations(self, state: State) -> Float[Array, "agent 2"]:
        """H_i' (y_i - H_i x_i): measurement - estimate, along the axis of the sensor (m)."""
        seen = -state.x
        if self.noise:
            seen = seen + self.noise * noise(state.scenario.seed, -1 - state.t, seen.shape)
        return jnp.asarray(self.measures, seen.dtype) * seen

    def observe(self, state, links):
        """Its axis, measurement - estimate along it, and how each neighbour's estimate differs."""
        axis = jnp.asarray(self.measures, state.x.dtype)
        own = jnp.concatenate([axis, self.innovations(state)], axis=1)
        gap = state.x[None, :] - state.x[:, None]
        return beside(own, gap, jnp.asarray(self.slots), links)

    def observation_entries(self):
        own = [Entry(f"1 if it measures {axis}, else 0") for axis in "xy"]
        told = "measurement - estimate, {}; 0 if it is not measured"
        own += [Entry(told.format(axis), "m", "world") for axis in "xy"]
        seen = tuple(Entry(f"estimate of {{j}} - own, {axis}", "m", "world") for axis in "xy")
        return beside_entries(tuple(own), seen, self.slots.shape[1])

    def errors(self, state):
        return state.x

    def distance(self, state):
        return jnp.linalg.norm(state.x, axis=1)

    def costs(self, state, action):
        return jnp.sum(state.x**2, axis=1)

    def failed(self, state):
        return ~jnp.all(jnp.abs(state.x) <= self.most)

    @property
    def edge_cost(self):
        return self.near**2

    @property
    def failure_cost(self):
        return 400.0

    def at_target(self, state):
        return eqx.tree_at(lambda s: s.x, state, jnp.zeros_like(state.x))

    def scene(self, state):
        """The estimates as places, and the target as their goal, without its wander."""

        def target(t):
            plant = self.plant
            return turned(state.scenario.place[None], plant.turn * t, plant.growth**t)

        now, before = target(state.t), target(state.t - 1)
        goal = jnp.broadcast_to(now, (self.agents, 2))
        velocity = jnp.broadcast_to((now - before) / self.dt, (self.agents, 2))
        return Scene(position=goal + state.x, velocity=velocity, goal=goal)

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.agents, 2))}
