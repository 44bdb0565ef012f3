"""Flock: agents that see those nearby fly with a leader and keep apart."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.errors import check_range
from marlyap.games.dynamics import DoubleIntegrator, Independent
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.games.sensing import beside, beside_entries, length
from marlyap.tasks.cartpoles import check_weights
from marlyap.types import Entry, Links, Obs, Scene, State


SEEN = tuple(
    Entry(f"{what}, {axis}", unit, "world")
    for what, unit in (("position of {j} - own", "m"), ("velocity of {j} - own", "m/s"))
    for axis in "xy"
)


class Wind(eqx.Module):
    """The scenario: what the flock has to follow, and what pushes it."""

    velocity: Float[Array, "2"]  # of the leader, who starts at the origin (m/s)
    push: Float[Array, "agent 2"]  # a steady acceleration of each agent (m/s^2)


class PointMasses(AbstractPlant):
    """q' = p, p' = u + push: each agent by itself."""

    limits: tuple[float, ...] = (10.0, 10.0)  # largest ax and ay (m/s^2)
    integrator: Integrator = "euler"
    states: ClassVar[tuple[Entry, ...]] = Independent(DoubleIntegrator()).states  # pyright: ignore
    inputs: ClassVar[tuple[Entry, ...]] = (
        Entry("ax", "m/s^2", "world"),
        Entry("ay", "m/s^2", "world"),
    )
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = DoubleIntegrator.blocks
    coupled: ClassVar[bool] = False

    def field(self, x, u, scenario, time):
        return pushed(x, u + scenario.push)


def pushed(x: Float[Array, "agent 4"], a: Float[Array, "agent 2"]) -> Float[Array, "agent 4"]:
    """The rates of places and velocities under these accelerations."""
    return jnp.concatenate([x[:, 2:], a], axis=1)


def around(
    game: AbstractRegulation, state: State, own: Float[Array, "agent n"], links: Links
) -> Obs:
    """What each agent knows of itself, and how those nearby lie and move against it: `SEEN`."""
    return beside(own, state.x[None, :] - state.x[:, None], jnp.asarray(game.slots), links)


def flying(state: State) -> Scene:
    """A flock on the map; no place has to be reached."""
    return Scene(position=state.x[:, :2], velocity=state.x[:, 2:])


class Flock(AbstractRegulation):
    """Agents that all see a leader, the gamma agent, fly with it and keep apart.

    Olfati-Saber, IEEE Trans. Automatic Control 51(3), 2006, with its spacing d of 7 m and a sight
    of 1.2 d. His lattice has no closed form; the target here is the set in which everybody has the
    leader's velocity v_r, is no closer than 0.8 d to anybody, and within a disc of radius
    0.75 sqrt(N) d about the leader. With `far` for how far an agent is beyond the disc and `tight`
    for how much too close its nearest one is, its cost is

        |v - v_r|^2 + (far / d)^2 + 10 (tight / d)^2.

    The team fails when somebody is `most` from the leader in x or y.
    """

    agents: int = 10  # N
    graph: str = "disk:8.4"  # who sees whom
    plant: PointMasses = PointMasses()  # pyright: ignore
    spacing: float = 7.0  # d (m)
    least: float = 0.8  # of d: no two may be closer
    room: float = 0.75  # of sqrt(N) d: the radius of the disc
    speed: float = 0.2  # an agent has arrived with this much of |v - v_r| (m/s)
    edging: float = 0.01  # and this far beyond the disc (m)
    crowding: float = 0.1  # and this much too close, in d
    most: float = 500.0  # farther away the team has failed (m)
    weights: tuple[float, ...] = (1.0, 1.0, 1 / 49, 10 / 49)  # of the squared errors in the cost
    start: float = 15.0  # starts are uniform in [-start, start]^2 (m)
    start_speed: float = 2.0  # and so are velocities (m/s)
    leader_speed: float = 3.0  # and that of the leader (m/s)
    push: float = 0.0  # largest steady acceleration of each agent in x and y (m/s^2)
    dt: float = 0.05  # s
    horizon: int = 400  # steps in an episode

    def __check_init__(self):
        for name in ("spacing", "least", "room", "speed", "edging", "crowding", "most"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("start", "start_speed", "leader_speed"):
            check_range(name, getattr(self, name), 0, 1e6)
        check_range("push", self.push, 0, min(self.plant.limits))
        check_weights(self.weights, 4)

    @property
    def tolerances(self):
        return (
            Tolerance("velocity - leader's, x", "m/s", self.speed, "world"),
            Tolerance("velocity - leader's, y", "m/s", self.speed, "world"),
            Tolerance("how far beyond the disc", "m", self.edging),
            Tolerance("how much too close to the nearest", "m", self.crowding * self.spacing),
        )

    @property
    def disc(self) -> float:
        """Its radius (m)."""
        return self.room * self.agents**0.5 * self.spacing

    def leader(self, state: State) -> Float[Array, "4"]:
        """Its place (m) and velocity (m/s)."""
        v = state.scenario.velocity
        return jnp.concatenate([state.t * self.dt * v, v])

    def reset(self, key):
        k_x, k_leader, k_push = jax.random.split(key, 3)
        near = lambda key, shape: jax.random.uniform(key, shape, minval=-1.0)
        most = jnp.array([self.start, self.start, self.start_speed, self.start_speed])
        wind = Wind(
            velocity=self.leader_speed * near(k_leader, (2,)),
            push=self.push * near(k_push, (self.agents, 2)),
        )
        x = most[None] * near(k_x, (self.agents, 4))
        return State(x=x, scenario=wind, t=jnp.asarray(0))

    def observe(self, state, links):
        """Where the leader is and how fast, against itself, and the same of those nearby."""
        return around(self, state, self.leader(state)[None] - state.x, links)

    def observation_entries(self):
        own = tuple(e._replace(name=e.name.replace("{j}", "the leader")) for e in SEEN)
        return beside_entries(own, SEEN, self.slots.shape[1])

    def errors(self, state):
        q, leader = state.x[:, :2], self.leader(state)
        far = jnp.maximum(length(q - leader[None, :2]) - self.disc, 0)
        alone = jnp.asarray(np.diag(np.full(self.agents, np.inf)), q.dtype)
        nearest = jnp.min(length(q[None, :] - q[:, None]) + alone, axis=1)
        tight = jnp.maximum(self.least * self.spacing - nearest, 0)
        return jnp.concatenate([state.x[:, 2:] - leader[None, 2:], jnp.stack([far, tight], 1)], 1)

    def distance(self, state):
        errors, most = self.errors(state), [e.most for e in self.tolerances]
        off = jnp.abs(errors[:, 2:]) / jnp.array(most[2:])[None]
        return jnp.maximum(length(errors[:, :2]) / self.speed, jnp.max(off, axis=1))

    def hold(self, state):
        return -state.scenario.push / jnp.asarray(self.plant.limits)[None]

    def costs(self, state, action):
        return self.errors(state) ** 2 @ jnp.asarray(self.weights)

    def failed(self, state):
        away = jnp.abs(state.x[:, :2] - self.leader(state)[None, :2])
        return ~jnp.all(away <= self.most)

    @property
    def edge_cost(self):
        return self.weights[0] * self.speed**2

    @property
    def failure_cost(self):
        return 50.0

    def at_target(self, state):
        """On a lattice of triangles about the leader, with its velocity."""
        wide = int(self.agents**0.5) + 3
        a, b = (m.ravel() for m in np.mgrid[-wide : wide + 1, -wide : wide + 1])
        points = np.stack([a + b / 2, b * 3**0.5 / 2], axis=1)
        first = np.argsort(np.linalg.norm(points, axis=1).round(6), kind="stable")[: self.agents]
        places = jnp.asarray(self.spacing * points[first], state.x.dtype)
        x = jnp.concatenate([places, jnp.zeros_like(places)], axis=1) + self.leader(state)[None]
        return eqx.tree_at(lambda s: s.x, state, x)

    def scene(self, state):
        return flying(state)

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.agents, 4))}
