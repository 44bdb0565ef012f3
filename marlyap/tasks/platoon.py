"""Platoon: cars on a road keep their distance and speed behind a leader whose speed is given."""

import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.games.sensing import beside, beside_entries
from marlyap.tasks.cartpoles import check_weights
from marlyap.types import Entry, Scalar, Scene, State


class Road(eqx.Module):
    """The scenario: what the leader does in this episode, and what the cars are like."""

    start: Scalar  # speed of the leader at the start (m/s)
    swing: Scalar  # amplitude by which its speed swings at first (m/s)
    gain: Float[Array, "agent"]  # of each car's engine, 1 being nominal
    lag: Float[Array, "agent"]  # time constant of each car's engine (s)


class Cars(AbstractPlant):
    """Cars in one lane: headway h to the car ahead, speed v and acceleration, driven by the latter.

        h_i' = v_{i-1} - v_i,    v_i' = u_i,    0 <= v_i <= v_max,

    with v_0 = v* + (start - v* + swing sin(2 pi t / period)) (1 - t / ramp), and v* from `ramp` on.
    One step is exact for constant accelerations; then speeds are clipped, and the third state is
    the acceleration that came about. An engine with a lag reaches the share 1 - exp(-dt / lag) of a
    change within a step. Chu, Chinchali and Katti, Multi-agent Reinforcement Learning for
    Networked System Control, ICLR 2020.
    """

    limits: tuple[float, ...] = (2.5,)  # largest acceleration (m/s^2)
    cruise: float = 15.0  # v*, the speed of the leader in the end (m/s)
    fastest: float = 30.0  # v_max (m/s)
    ramp: float = 29.9  # when the leader has reached v* (s)
    period: float = 10.0  # of the swings of the leader's speed (s)
    integrator: ClassVar[Integrator] = "rk4"  # what it amounts to between the clipped speeds
    states: ClassVar[tuple[Entry, ...]] = (
        Entry("headway", "m"),
        Entry("speed", "m/s"),
        Entry("acceleration in the last step", "m/s^2"),
    )
    inputs: ClassVar[tuple[Entry, ...]] = (Entry("acceleration", "m/s^2"),)
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((1, 2), (0,))

    def __check_init__(self):
        for name in ("cruise", "fastest", "ramp", "period"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)

    def lead(self, scenario: Road, time: Scalar) -> Scalar:
        """The speed of the leader (m/s)."""
        swing = scenario.swing * jnp.sin(2 * jnp.pi * time / self.period)
        left = 1 - jnp.clip(time / self.ramp, 0, 1)
        return self.cruise + (scenario.start - self.cruise + swing) * left

    def ahead(self, v: Float[Array, "agent"], scenario: Road, time: Scalar) -> Array:
        """The speed of the one ahead of each car (m/s)."""
        return jnp.concatenate([self.lead(scenario, time)[None], v[:-1]])

    def field(self, x, u, scenario, time):
        h, v, _ = x.T
        closing = self.ahead(v, scenario, time) - v
        return jnp.stack([closing, scenario.gain * u[:, 0], jnp.zeros_like(h)], axis=1)

    def step(self, x, u, scenario, time, dt):
        h, v, before = x.T
        late = scenario.lag > 0
        kept = jnp.where(late, jnp.exp(-dt / jnp.where(late, scenario.lag, 1.0)), 0.0)
        now = kept * before + (1 - kept) * scenario.gain * u[:, 0]
        after = jnp.clip(v + dt * now, 0.0, self.fastest)
        closing = self.ahead(v, scenario, time) - v
        closing = closing + self.ahead(after, scenario, time + dt) - after
        return jnp.stack([h + dt / 2 * closing, after, (after - v) / dt], axis=1)


class Platoon(AbstractRegulation):
    """Cars close up behind a leader or slow down with it: 20 m apart, at 15 m/s, without a crash.

    Marginal without control. `catch-up` starts with a long first headway, `slow-down` with fast
    cars whose leader brakes for half a minute; without control they collide. The cost of a car is
    ((h - 20)^2 + (v - 15)^2 + 0.1 u^2) / 100, which is the published penalty over 100. The
    target set is one of a leader at its final speed, so `at_target` moves the clock that far on.
    """

    agents: int = 8  # N
    graph: str = "path"  # who sees whom; the cars form one line whatever it is
    plant: Cars = Cars()  # pyright: ignore
    headway: float = 20.0  # h*, to be kept (m)
    near_headway: float = 1.0  # a headway this close to h* is good (m)
    near_speed: float = 0.5  # so is a speed this close to v* (m/s)
    collision: float = 1.0  # below this headway the team has failed (m)
    stopping: float = 5.0  # below this headway the speed to go for is 0 (m)
    free: float = 35.0  # above this headway it is the largest speed (m)
    weights: tuple[float, ...] = (0.01, 0.01)  # of the squared errors in the cost
    effort: float = 0.00625  # weight of the squared action in the cost
    start_headway: tuple[float, ...] = (1.5, 2.5)  # of the first car, least and most, over h*
    start_speed: tuple[float, ...] = (1.0, 1.0)  # of all and the leader, least and most, over v*
    swing: float = 0.0  # by how much the leader's speed swings at most in the first seconds (m/s)
    gain_spread: float = 0.0  # engines are drawn anew in an episode, up to this share off
    lag: float = 0.0  # time constants of engines are drawn anew, up to this (s)
    dt: float = 0.1  # s
    horizon: int = 600  # steps in an episode

    def __check_init__(self):
        for name in ("headway", "near_headway", "near_speed"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("collision", "effort", "swing", "lag"):
            check_range(name, getattr(self, name), 0, 1e6)
        check_range("gain_spread", self.gain_spread, 0, 0.99)
        for name in ("start_headway", "start_speed"):
            span = getattr(self, name)
            if len(span) != 2 or not 0 <= span[0] <= span[1] < 1e6:
                raise UserError(f"{name}: {span} must be two numbers, the least and the most.")
        if not self.stopping < self.free:
            raise UserError(f"stopping: {self.stopping} m must be less than free.")
        check_weights(self.weights, 2)

    @property
    def slows(self) -> bool:
        """Whether the leader starts at another speed than it ends with."""
        return self.start_speed != (1.0, 1.0)

    @property
    def tolerances(self):
        return (
            Tolerance(f"headway - {self.headway:g} m", "m", self.near_headway),
            Tolerance(f"speed - {self.plant.cruise:g} m/s", "m/s", self.near_speed),
        )

    @property
    def leads(self):
        return np.arange(self.agents) == 0

    def reset(self, key):
        k_headway, k_speed, k_swing, k_gain, k_lag = jax.random.split(key, 5)
        between = lambda key, span: jax.random.uniform(key, (), minval=span[0], maxval=span[1])
        n, start = self.agents, self.plant.cruise * between(k_speed, self.start_speed)
        first = self.headway * between(k_headway, self.start_headway)
        h = jnp.full(n, self.headway).at[0].set(first)
        road = Road(
            start=start,
            swing=self.swing * jax.random.uniform(k_swing, ()),
            gain=1 + self.gain_spread * jax.random.uniform(k_gain, (n,), minval=-1.0),
            lag=self.lag * jax.random.uniform(k_lag, (n,)),
        )
        x = jnp.stack([h, jnp.full(n, start), jnp.zeros(n)], axis=1)
        return State(x=x, scenario=road, t=jnp.asarray(0))

    def lead(self, state: State) -> Scalar:
        """The speed of the leader now (m/s)."""
        return self.plant.lead(state.scenario, state.t * self.dt)

    def ahead(self, state: State) -> Float[Array, "agent"]:
        """The speed of the one ahead of each car (m/s)."""
        return self.plant.ahead(state.x[:, 1], state.scenario, state.t * self.dt)

    def optimal_speed(self, h: Float[Array, "agent"]) -> Float[Array, "agent"]:
        """V(h), the speed that the optimal velocity model goes for at this headway (m/s)."""
        share = jnp.clip((h - self.stopping) / (self.free - self.stopping), 0, 1)
        return self.plant.fastest / 2 * (1 - jnp.cos(jnp.pi * share))

    def observe(self, state, links):
        """Its own headway, speed and acceleration, and what it knows of those beside it, scaled."""
        h, v, last = state.x.T
        told = jnp.where(jnp.asarray(self.leads), self.lead(state) - v, 0.0)
        off, size = (h - self.headway) / self.headway, (self.agents, self.agents)
        own = [off, v / self.plant.cruise - 1, (self.optimal_speed(h) - v) / 5]
        own += [last / self.plant.limits[0], told / 5]
        seen = jnp.stack([(v[None, :] - v[:, None]) / 5, jnp.broadcast_to(off, size)], axis=2)
        return beside(jnp.stack(own, axis=1), seen, jnp.asarray(self.slots), links)

    def observation_entries(self):
        h, cruise, most = self.headway, self.plant.cruise, self.plant.limits[0]
        own = (
            Entry(f"headway / {h:g} m - 1"),
            Entry(f"speed / {cruise:g} m/s - 1"),
            Entry("(speed to go for at this headway - speed) / 5 m/s"),
            Entry(f"acceleration in the last step / {most:g} m/s^2"),
            Entry("(speed of the leader - speed) / 5 m/s, 0 if not told"),
        )
        seen = (
            Entry("(speed of {j} - own speed) / 5 m/s"),
            Entry(f"headway of {{j}} / {h:g} m - 1"),
        )
        return beside_entries(own, seen, self.slots.shape[1])

    def errors(self, state):
        return state.x[:, :2] - jnp.array([[self.headway, self.plant.cruise]])

    def features(self, state):
        """The errors, magnified near zero too, and how fast the leader still is."""
        lead = jnp.full((self.agents, 1), self.lead(state) / self.plant.cruise - 1)
        return jnp.concatenate([super().features(state), lead], axis=1)

    def costs(self, state, action):
        effort = jnp.sum(jnp.clip(action, -1.0, 1.0) ** 2, axis=1)
        return self.errors(state) ** 2 @ jnp.asarray(self.weights) + self.effort * effort

    def failed(self, state):
        return jnp.any(state.x[:, 0] < self.collision)

    @property
    def edge_cost(self):
        return max(self.weights[0] * self.near_headway**2, self.weights[1] * self.near_speed**2)

    @property
    def failure_cost(self):
        return 10.0

    def at_target(self, state):
        x = jnp.tile(jnp.array([[self.headway, self.plant.cruise, 0.0]]), (self.agents, 1))
        late = jnp.maximum(state.t, math.ceil(self.plant.ramp / self.dt)).astype(state.t.dtype)
        return eqx.tree_at(lambda s: (s.x, s.t), state, (x, late))

    def farther(self, state, factor):
        """The start with the leader's speed `factor` times as far off too."""
        there, cruise = self.at_target(state).x, self.plant.cruise
        x = there + factor * (state.x - there)
        start = cruise + factor * (state.scenario.start - cruise)
        return eqx.tree_at(lambda s: (s.x, s.scenario.start), state, (x, start))

    def scene(self, state):
        """The cars on the road, and last the leader, seen from which they are placed."""
        back = jnp.concatenate([-jnp.cumsum(state.x[:, 0]), jnp.zeros(1)])
        slower = jnp.concatenate([state.x[:, 1] - self.lead(state), jnp.zeros(1)])
        return Scene(position=back[:, None], velocity=slower[:, None])

    def signals(self, state):
        return {
            "headway (m)": state.x[:, 0],
            "speed (m/s)": state.x[:, 1],
            "speed of the leader (m/s)": jnp.full(self.agents, self.lead(state)),
        }

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.agents, 3))}
