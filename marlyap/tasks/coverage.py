"""Coverage: robots spread over a square so that each is at the centre of its Voronoi cell."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.games.sensing import length, near
from marlyap.types import Entry, Links, Scene, State


LLOYD = 400  # steps to a fixed point: on a grid it is reached exactly
EMPTY = 1e-12  # the mass of a cell without a grid point


class Density(eqx.Module):
    """The scenario: where it is worthwhile to be."""

    centre: Float[Array, "2"]  # of the bump (m)


class Wheels(AbstractPlant):
    """p' = u with |u| at most `limits`, on a square of 1 m with walls.

    An action is scaled back onto the unit disc, and a step of `period` ends at a wall.
    """

    limits: tuple[float, ...] = (0.5, 0.5)  # (m/s)
    integrator: Integrator = "euler"
    period: float = 0.1  # of a step (s)
    states: ClassVar[tuple[Entry, ...]] = (Entry("x", "m", "world"), Entry("y", "m", "world"))
    inputs: ClassVar[tuple[Entry, ...]] = (
        Entry("velocity, x", "m/s", "world"),
        Entry("velocity, y", "m/s", "world"),
    )
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1),)
    coupled: ClassVar[bool] = False

    def __check_init__(self):
        check_range("period", self.period, 0, 10, open=True)

    def field(self, x, u, scenario, time):
        squared = jnp.sum((u / jnp.asarray(self.limits)[None]) ** 2, axis=1, keepdims=True)
        u = u / jnp.sqrt(jnp.maximum(squared, 1.0))
        return (jnp.clip(x + self.period * u, 0.0, 1.0) - x) / self.period


class Coverage(AbstractRegulation):
    """Robots start in a corner and share a square out: each ends at its cell's centre of mass.

    The cell of a robot is what is nearer to it than to any other, in a density that is uniform or
    has a bump, integrated over the midpoints of a grid: Cortes, Martinez, Karatas and Bullo, IEEE
    Trans. Robotics and Automation 20(2), 2004. At the centres the mean squared distance to the
    nearest robot,

        H(p) = sum_g phi(g) min_i |p_i - g|^2,     dH/dp_i = 2 m_i (p_i - C_i),

    is stationary. The cost of an agent is |p_i - C_i| / 0.1 m; it jumps where a point of the grid
    changes hands. The target of each moves with all.
    """

    agents: int = 6  # N
    graph: str = "complete"  # whom a robot may see; of them it sees the nearest
    plant: Wheels = Wheels()  # pyright: ignore
    bump: bool = False  # whether the density has a bump
    centre: float = 0.7  # x and y of the bump (m)
    width: float = 0.2  # standard deviation of the bump (m)
    floor: float = 0.2  # the density far from the bump, in multiples of its height
    move: float = 0.0  # the bump is drawn anew in an episode, up to this far off in x and y (m)
    cells: int = 24  # grid points on a side
    nearest: int = 4  # how many others a robot sees
    near: float = 0.03  # a robot this close to its centre has arrived (m)
    scale: float = 0.1  # of the distance in the cost (m)
    least: float = 0.02  # starts are uniform in [least, most]^2 (m)
    most: float = 0.35  # (m)
    dt: float = 0.1  # s
    horizon: int = 60  # steps in an episode

    def __check_init__(self):
        if self.dt != self.plant.period:
            raise UserError(f"dt: {self.dt} s is not plant.period; set both alike.")
        for name in ("width", "floor", "near", "scale"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("centre", "move", "least", "most"):
            check_range(name, getattr(self, name), 0, 1)
        check_range("cells", self.cells, 2, 200)
        check_range("nearest", self.nearest, 1, 4095)

    @property
    def edge(self):
        return self.near

    @property
    def unit(self):
        return "m"

    @property
    def tolerances(self):
        told = "position - centre of the cell, {}"
        return tuple(Tolerance(told.format(axis), "m", self.near, "world") for axis in "xy")

    def reset(self, key):
        k_x, k_bump = jax.random.split(key)
        x = jax.random.uniform(k_x, (self.agents, 2), minval=self.least, maxval=self.most)
        centre = self.centre + self.move * jax.random.uniform(k_bump, (2,), minval=-1.0)
        return State(x=x, scenario=Density(centre), t=jnp.asarray(0))

    @property
    def grid(self) -> Float[np.ndarray, "point 2"]:
        """The midpoints of equal squares (m)."""
        axis = (np.arange(self.cells) + 0.5) / self.cells
        return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)

    def density(self, state: State) -> Float[Array, "point"]:
        """phi, at the points of the grid; it sums to 1."""
        grid = jnp.asarray(self.grid, state.x.dtype)
        if not self.bump:
            return jnp.full(len(grid), 1 / len(grid), grid.dtype)
        squared = jnp.sum((grid - state.scenario.centre[None]) ** 2, axis=1)
        phi = jnp.exp(-squared / (2 * self.width**2)) + self.floor
        return phi / jnp.sum(phi)

    def centres(self, state: State, links: Links | None = None) -> Float[Array, "agent 2"]:
        """C_i: the centre of mass of each cell (m), by those that are seen; else by all.

        A tie goes to the lower number. A robot whose cell holds no point stays where it is.
        """
        grid, phi = jnp.asarray(self.grid, state.x.dtype), self.density(state)
        squared = jnp.sum((grid[None] - state.x[:, None]) ** 2, axis=-1)
        if links is None:
            own = jnp.argmin(squared, axis=0)[None] == jnp.arange(self.agents)[:, None]
        else:
            i = np.arange(self.agents)
            first = jnp.asarray(i[:, None] < i[None, :])[..., None]  # wins a tie
            mine, others = squared[:, None], squared[None]
            wins = jnp.where(first, mine <= others, mine < others)
            own = jnp.all(wins | ~links[..., None], axis=1)
        weight = own * phi[None]
        mass = jnp.sum(weight, axis=1, keepdims=True)
        return jnp.where(mass > 0, weight @ grid / jnp.maximum(mass, EMPTY), state.x)

    def observe(self, state, links):
        """Where it is, and the nearest of those it sees, the nearest first."""
        apart = jnp.sum((state.x[None, :] - state.x[:, None]) ** 2, axis=-1)
        seen = links & ~jnp.eye(self.agents, dtype=bool)
        apart = jnp.where(seen, apart, jnp.inf)
        order = jnp.argsort(apart, axis=1)[:, : self.nearest]
        row = jnp.arange(self.agents)[:, None]
        gap = state.x[order] - state.x[:, None]
        flag = seen[row, order]
        told = jnp.concatenate([jnp.ones_like(gap[..., :1]), gap, near(gap, self.scale)], axis=-1)
        told = jnp.where(flag[..., None], told, 0.0).reshape(self.agents, -1)
        return jnp.concatenate([state.x, told], axis=1)

    def observation_entries(self):
        found = list(self.plant.states)
        for k in range(min(self.nearest, self.agents)):
            who = f"the robot that is nearest but {k}"
            found.append(Entry(f"1 if {who} is seen, else all of it is 0"))
            found += [Entry(f"position of {who} - own, {a}", "m", "world") for a in "xy"]
            told = f"e / (|e| + {self.scale:g} m) of e = position of {who} - own"
            found += [Entry(f"{told}, {a}", "1", "world") for a in "xy"]
        return tuple(found)

    def errors(self, state):
        return state.x - self.centres(state)

    def distance(self, state):
        return length(self.errors(state))

    def costs(self, state, action):
        return self.distance(state) / self.scale

    @property
    def smooth(self):
        return False

    @property
    def edge_cost(self):
        return self.near / self.scale

    def at_target(self, state):
        """Where Lloyd's steps from here end."""
        onto = lambda _, x: self.centres(eqx.tree_at(lambda s: s.x, state, x))
        return eqx.tree_at(lambda s: s.x, state, jax.lax.fori_loop(0, LLOYD, onto, state.x))

    def scene(self, state):
        still = jnp.zeros_like(state.x)
        return Scene(position=state.x, velocity=still, goal=self.centres(state))

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.agents, 2))}
