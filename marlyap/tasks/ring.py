"""Ring road: a few of 22 cars are ours, the others have human drivers, who make traffic jams."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.games.sensing import beside, beside_entries
from marlyap.tasks.cartpoles import check_weights
from marlyap.types import Entry, Scalar, Scene, State


class Traffic(eqx.Module):
    """The scenario: the road of this episode, and how erratically the humans drive on it."""

    length: Scalar  # of the road, L (m)
    flow: Scalar  # v*, the speed of the uniform flow on it (m/s)
    noise: Scalar  # of a human's acceleration, over sqrt(dt) (m/s^2.5)
    seed: UInt32[Array, "word"]  # of the noise


class RingRoad(AbstractPlant):
    """Cars on a ring: those of the agents accelerate as told, the others by a human's rule,

        a = a_0 (1 - (v / v_0)^4 - (s* / s)^2),   s* = s_0 + max(0, v T + v (v - v_ahead) /
        (2 sqrt(a_0 b))),   a >= -brake,

    with s the gap to the car ahead: the intelligent driver model (Treiber, Hennecke and Helbing,
    Physical Review E 62(2), 2000). To a are added sqrt(dt) noise times standard normal numbers, and
    a step is v+ = max(v + dt a, 0), p+ = p + dt v+. The uniform flow of humans is unstable and
    breaks up into stop-and-go waves (Sugiyama and others, New Journal of Physics 10, 2008);
    constants and noise as in Flow (Wu and others, IEEE Trans. Robotics 38(2), 2022).

    A row of x is a car, those of the agents first. They are spread evenly over the ring: that of
    agent i follows i / N of all cars. Places p are not wrapped at the end of a lap.
    """

    limits: tuple[float, ...] = (3.0,)  # largest acceleration of an agent's car (m/s^2)
    cars: int = 22
    size: float = 5.0  # length of a car (m)
    free: float = 30.0  # v_0, the speed on a free road (m/s)
    headway: float = 1.0  # T (s)
    pull: float = 1.0  # a_0 (m/s^2)
    comfort: float = 1.5  # b, a comfortable deceleration (m/s^2)
    still: float = 2.0  # s_0, the gap to a car that stands (m)
    brake: float = 8.0  # no human brakes harder (m/s^2)
    integrator: ClassVar[Integrator] = "euler"
    states: ClassVar[tuple[Entry, ...]] = (
        Entry("place along the road", "m"),
        Entry("speed", "m/s"),
    )
    inputs: ClassVar[tuple[Entry, ...]] = (Entry("acceleration", "m/s^2"),)
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((1,), (0,))

    def __check_init__(self):
        for name in ("size", "free", "headway", "pull", "comfort", "still", "brake"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        check_range("cars", self.cars, 2, 4096)

    def order(self, agents: int) -> Int[np.ndarray, "car"]:
        """Where in the line of cars each row is, from 0, the first."""
        ours = np.arange(agents) * self.cars // max(agents, 1)
        return np.concatenate([ours, np.setdiff1d(np.arange(self.cars), ours)]).astype(int)

    def ahead(
        self, x: Float[Array, "car 2"], agents: int, length: Scalar
    ) -> tuple[Float[Array, "car"], Float[Array, "car"]]:
        """The gap to the car ahead (m), and its speed (m/s); that of the first is a lap ahead."""
        order = self.order(agents)
        front = np.argsort(order)[(order - 1) % self.cars]
        lap = jnp.where(jnp.asarray(order == 0), length, 0.0)
        return x[front, 0] + lap - x[:, 0] - self.size, x[front, 1]

    def human(self, v: Array, v_ahead: Array, gap: Array) -> Array:
        """What a human does at this speed (m/s) and gap (m): an acceleration (m/s^2)."""
        closing = v * (v - v_ahead) / (2 * (self.pull * self.comfort) ** 0.5)
        wish = self.still + jnp.maximum(v * self.headway + closing, 0.0)
        a = self.pull * (1 - (v / self.free) ** 4 - (wish / jnp.maximum(gap, 1e-3)) ** 2)
        return jnp.maximum(a, -self.brake)

    def flow(self, gap: Scalar) -> Scalar:
        """The speed (m/s) at which humans with this gap neither gain nor lose, by bisection."""

        def halve(_, span):
            low, high = span
            v = (low + high) / 2
            slow = (self.still + v * self.headway) / jnp.sqrt(1 - (v / self.free) ** 4) < gap
            return jnp.where(slow, v, low), jnp.where(slow, high, v)

        ends = jnp.zeros_like(gap), jnp.full_like(gap, 0.999 * self.free)
        return jax.lax.fori_loop(0, 60, halve, ends)[0]

    def field(self, x, u, scenario, time):
        gap, v_ahead = self.ahead(x, len(u), scenario.length)
        human = self.human(x[:, 1], v_ahead, gap)
        return jnp.stack([x[:, 1], human.at[: len(u)].set(u[:, 0])], axis=1)

    def step(self, x, u, scenario, time, dt):
        when = jnp.round(time / dt).astype(int)
        key = jax.random.fold_in(jax.random.wrap_key_data(scenario.seed), when)
        z = jax.random.normal(key, (self.cars,), x.dtype).at[: len(u)].set(0.0)
        a = self.field(x, u, scenario, time)[:, 1] + dt**0.5 * scenario.noise * z
        v = jnp.maximum(x[:, 1] + dt * a, 0.0)
        return jnp.stack([x[:, 0] + dt * v, v], axis=1)


class Ring(AbstractRegulation):
    """The agents' cars on a ring road calm the traffic: all cars drive at the uniform flow's speed.

    Mixed traffic is stabilisable, not controllable (Zheng, Wang and Li, arXiv:1812.09544). An
    agent's errors are those of its stretch of road: of its own car and of the humans behind it, up
    to the next agent's car. The cost is the mean over all cars of ((v - v*) / v*)^2 +
    0.1 ((gap - gap*) / gap*)^2, plus 0.01 a^2. The team fails at a collision. Before an episode,
    humans drive all cars for 75 s, bunched at first. On the target set nobody is erratic.
    """

    agents: int = 1  # N
    graph: str = "path"  # which of the agents tell each other their speeds
    plant: RingRoad = RingRoad()  # pyright: ignore
    shortest: int = 220  # roads are drawn from here (m)
    longest: int = 270  # to here (m)
    noise: float = 0.2  # of a human's acceleration, over sqrt(dt) (m/s^2.5)
    bunched: float = 50.0  # so much of the road is empty when the humans start from rest (m)
    warmup: int = 750  # steps in which humans drive all cars, before an episode
    near: float = 1.0  # a car this close to the speed of the uniform flow is good (m/s)
    weights: tuple[float, ...] = (1.0, 0.1)  # of the squared errors of speed and gap in the cost
    effort: float = 0.01  # weight of the squared action in the cost
    dt: float = 0.1  # s
    horizon: int = 3000  # steps in an episode

    def __check_init__(self):
        check_range("near", self.near, 0, 1e6, open=True)
        for name in ("noise", "effort", "bunched"):
            check_range(name, getattr(self, name), 0, 1e6)
        check_range("warmup", self.warmup, 0, 100_000)
        cars = self.plant.cars
        if cars % self.agents:
            raise UserError(f"agents: {self.agents} must divide the number of cars, {cars}.")
        if self.shortest - self.bunched < cars * (self.plant.size + self.plant.still):
            raise UserError(f"shortest: {self.shortest} m leaves no room for {cars} bunched cars.")
        if not self.shortest <= self.longest <= 100_000:
            raise UserError(f"longest: {self.longest} m must be at least shortest, at most 1e5.")
        check_weights(self.weights, 2)

    @property
    def stretch(self) -> Int[np.ndarray, "agent car"]:
        """The rows of each agent's own car, and of those behind it up to the next agent's."""
        return np.argsort(self.plant.order(self.agents)).reshape(self.agents, -1)

    @property
    def tolerances(self):
        names = ["own", *(f"car {k} behind" for k in range(1, self.stretch.shape[1]))]
        of = lambda who: (
            Tolerance(f"speed - that of the uniform flow, {who}", "m/s", self.near),
            Tolerance(f"gap - that of the uniform flow, {who}", "m"),
        )
        return tuple(tolerance for who in names for tolerance in of(who))

    def reset(self, key):
        k_length, k_noise, k_warm = jax.random.split(key, 3)
        n, plant = self.plant.cars, self.plant
        length = jax.random.randint(k_length, (), self.shortest, self.longest + 1).astype(float)
        traffic = lambda key: Traffic(
            length=length,
            flow=plant.flow(length / n - plant.size),
            noise=jnp.asarray(self.noise),
            seed=jax.random.key_data(key),
        )
        place = -(length - self.bunched) / n * jnp.arange(n)
        nobody, humans = jnp.zeros((0, 1)), traffic(k_warm)
        drive = lambda k, x: plant.step(x, nobody, humans, k * self.dt, self.dt)
        line = jnp.stack([place, jnp.zeros(n)], axis=1)
        line = jax.lax.fori_loop(0, self.warmup, drive, line)
        return State(x=line[plant.order(self.agents)], scenario=traffic(k_noise), t=jnp.asarray(0))

    def gaps(self, state: State) -> Float[Array, "car"]:
        """The gap ahead of each car (m)."""
        return self.plant.ahead(state.x, self.agents, state.scenario.length)[0]

    def ahead(self, state: State) -> Float[Array, "car"]:
        """The speed of the car ahead of each (m/s)."""
        return self.plant.ahead(state.x, self.agents, state.scenario.length)[1]

    def observe(self, state, links):
        """Its own speed and gap and the speed ahead, with the speed of the uniform flow, scaled."""
        v, flow = state.x[: self.agents, 1], state.scenario.flow
        gap, ahead = self.gaps(state)[: self.agents], self.ahead(state)[: self.agents]
        own = [v / 5, (ahead - v) / 5, gap / 20, jnp.full_like(v, flow) / 5]
        seen = ((v[None, :] - v[:, None]) / 5)[..., None]
        return beside(jnp.stack(own, axis=1), seen, jnp.asarray(self.slots), links)

    def observation_entries(self):
        own = (
            Entry("speed / 5 m/s"),
            Entry("(speed of the car ahead - speed) / 5 m/s"),
            Entry("gap / 20 m"),
            Entry("speed of the uniform flow / 5 m/s"),
        )
        seen = (Entry("(speed of {j} - own speed) / 5 m/s"),)
        return beside_entries(own, seen, self.slots.shape[1])

    def off(self, state: State) -> Float[Array, "car 2"]:
        """How far the speed (m/s) and the gap (m) of each car are from the uniform flow's."""
        gap = state.scenario.length / self.plant.cars - self.plant.size
        v = state.x[:, 1] - state.scenario.flow
        return jnp.stack([v, self.gaps(state) - gap], axis=1)

    def errors(self, state):
        return self.off(state)[self.stretch].reshape(self.agents, -1)

    def features(self, state):
        """The errors, magnified near zero too, and the speed of the uniform flow on this road."""
        flow = jnp.full((self.agents, 1), state.scenario.flow / 5)
        return jnp.concatenate([super().features(state), flow], axis=1)

    def costs(self, state, action):
        effort = jnp.sum(jnp.clip(action, -1.0, 1.0) ** 2, axis=1)
        gap = state.scenario.length / self.plant.cars - self.plant.size
        share = self.off(state) / jnp.stack([state.scenario.flow, gap])[None]
        return jnp.mean(share**2, axis=0) @ jnp.asarray(self.weights) + self.effort * effort

    def failed(self, state):
        return jnp.any(self.gaps(state) < 0)

    @property
    def edge_cost(self):
        gap = (self.shortest + self.longest) / 2 / self.plant.cars - self.plant.size
        flow = (gap - self.plant.still) / self.plant.headway  # far below the speed of a free road
        return self.weights[0] * (self.near / flow) ** 2

    @property
    def failure_cost(self):
        return 4.0

    def at_target(self, state):
        line, length = jnp.asarray(self.plant.order(self.agents)), state.scenario.length
        place = state.x[0, 0] - line * length / self.plant.cars
        x = jnp.stack([place, jnp.full_like(place, state.scenario.flow)], axis=1)
        calm = jnp.zeros_like(state.scenario.noise)
        return eqx.tree_at(lambda s: (s.x, s.scenario.noise), state, (x, calm))

    def scene(self, state):
        """All cars on a circle, those of the agents first."""
        radius = state.scenario.length / (2 * jnp.pi)
        angle, v = state.x[:, 0] / radius, state.x[:, 1]
        out = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        along = jnp.stack([-out[:, 1], out[:, 0]], axis=1)
        return Scene(
            position=radius * out,
            velocity=v[:, None] * along,
            frame=jnp.stack([along, -out], axis=1),
            spin=v / radius,
        )

    def signals(self, state):
        return {
            "speed (m/s)": state.x[: self.agents, 1],
            "gap (m)": self.gaps(state)[: self.agents],
            "slowest speed up to the next agent (m/s)": state.x[self.stretch, 1].min(axis=1),
        }

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.plant.cars, 2))}
