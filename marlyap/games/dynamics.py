"""Dynamics of one planar agent, xdot = f(x, u) (section 4), and the plant of a team of them.

The vector field is written once. Both integrators, the Lipschitz constant of Theorem 1 and
every linearisation are derived from it.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.errors import check_range
from marlyap.games.physics import AbstractPlant, Integrator, check_inputs, integrate
from marlyap.types import Entry


Position = Float[Array, "2"]


class AbstractDynamics(eqx.Module):
    """A planar agent driven by inputs u in [-limits, limits].

    `blocks` orders the state for semi-implicit Euler: velocities before what they move. `units`
    are those of `names`, `input_units` those of `inputs`, and `felt` names the entries of `rates`.
    """

    limits: eqx.AbstractVar[tuple[float, ...]]
    integrator: eqx.AbstractVar[Integrator]
    names: eqx.AbstractClassVar[tuple[str, ...]]
    inputs: eqx.AbstractClassVar[tuple[str, ...]]
    blocks: eqx.AbstractClassVar[tuple[tuple[int, ...], ...]]
    units: ClassVar[tuple[str, ...]] = ()
    input_units: ClassVar[tuple[str, ...]] = ()
    felt: ClassVar[tuple[str, ...]] = ()

    def __check_init__(self):
        check_inputs(self.limits, self.inputs, self.integrator)

    @property
    def dx(self) -> int:
        return len(self.names)

    @property
    def du(self) -> int:
        return len(self.inputs)

    @abc.abstractmethod
    def field(self, x: Float[Array, "dx"], u: Float[Array, "du"]) -> Float[Array, "dx"]:
        """f(x, u), with x in SI units and radians and u in physical units."""

    @abc.abstractmethod
    def position(self, x: Float[Array, "dx"]) -> Position:
        """Where the agent is (m)."""

    @abc.abstractmethod
    def heading(self, x: Float[Array, "dx"]) -> Float[Array, "2"]:
        """Unit vector of the agent's own first axis; its observations are in that frame."""

    @abc.abstractmethod
    def velocity(self, x: Float[Array, "dx"]) -> Float[Array, "2"]:
        """Velocity of the position in the world frame (m/s)."""

    @abc.abstractmethod
    def rates(self, x: Float[Array, "dx"]) -> Float[Array, "rate"]:
        """What the agent feels of its own motion; all zero exactly when it is at rest."""

    def turning(self, x: Float[Array, "dx"]) -> Float[Array, ""]:
        """How fast the agent turns (rad/s); 0 for one without a heading."""
        return jnp.zeros(())

    def rest(self, position: Position, angle: Float[Array, ""]) -> Float[Array, "dx"]:
        """The state at rest at `position`, heading `angle` (radians) where there is a heading."""
        x = jnp.zeros(self.dx).at[jnp.array([0, 1])].set(position)
        return x.at[2].set(angle) if "psi" in self.names else x

    def step(
        self, x: Float[Array, "dx"], u: Float[Array, "du"], dt: float | Array
    ) -> Float[Array, "dx"]:
        """x after `dt` seconds of constant inputs u, in physical units."""
        return integrate(lambda x: self.field(x, u), x, dt, self.integrator, self.blocks)

    def inputs_of(self, action: Float[Array, "du"]) -> Float[Array, "du"]:
        """The inputs, in physical units, that an action in [-1, 1]^du asks for."""
        return jnp.clip(action, -1.0, 1.0) * jnp.asarray(self.limits)

    def predict(self, x: Float[Array, "dx"], dt: float | Array) -> Float[Array, "dx"]:
        """The state in which an input asked for now begins to act: x, where none is late.

        A law fed with it instead of x is a Smith predictor without model error.
        """
        return x


class Unicycle(AbstractDynamics):
    """The paper's unicycle: x, y (m), psi (rad), v (m/s), omega (rad/s); a (m/s^2), r (rad/s^2).

    x' = v cos psi,  y' = v sin psi,  psi' = omega,  v' = a,  omega' = r.
    """

    limits: tuple[float, ...] = (5.0, 5.0)  # largest a (m/s^2) and r (rad/s^2)
    integrator: Integrator = "euler"
    names: ClassVar[tuple[str, ...]] = ("x", "y", "psi", "v", "omega")
    inputs: ClassVar[tuple[str, ...]] = ("a", "r")
    units: ClassVar[tuple[str, ...]] = ("m", "m", "rad", "m/s", "rad/s")
    input_units: ClassVar[tuple[str, ...]] = ("m/s^2", "rad/s^2")
    felt: ClassVar[tuple[str, ...]] = ("v", "omega")
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((3, 4), (2,), (0, 1))

    def field(self, x, u):
        return rolling(x, u)

    def position(self, x):
        return x[:2]

    def heading(self, x):
        return along(x[2])

    def velocity(self, x):
        return x[3] * along(x[2])

    def rates(self, x):
        return x[3:]

    def turning(self, x):
        return x[4]


class LateUnicycle(AbstractDynamics):
    """A unicycle whose inputs act one step after they were asked for.

    Those under way, a (m/s^2) and r (rad/s^2), are part of its state, and it feels them: without
    them the next state would not follow from what is known. The usual augmented state of a sampled
    system with a delay (Astrom and Wittenmark, Computer-Controlled Systems, 1997).
    """

    limits: tuple[float, ...] = (5.0, 5.0)  # largest a (m/s^2) and r (rad/s^2)
    integrator: Integrator = "euler"
    names: ClassVar[tuple[str, ...]] = (*Unicycle.names, "a", "r")
    inputs: ClassVar[tuple[str, ...]] = Unicycle.inputs
    units: ClassVar[tuple[str, ...]] = (*Unicycle.units, *Unicycle.input_units)
    input_units: ClassVar[tuple[str, ...]] = Unicycle.input_units
    felt: ClassVar[tuple[str, ...]] = ("v", "omega", "a", "r")
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = Unicycle.blocks

    def field(self, x, u):
        return jnp.concatenate([rolling(x[:5], x[5:]), jnp.zeros(2)])

    def position(self, x):
        return x[:2]

    def heading(self, x):
        return along(x[2])

    def velocity(self, x):
        return x[3] * along(x[2])

    def rates(self, x):
        return x[3:]

    def turning(self, x):
        return x[4]

    def step(self, x, u, dt):
        after = integrate(lambda x: self.field(x, u), x, dt, self.integrator, self.blocks)
        return after.at[5:].set(u)

    def predict(self, x, dt):
        return self.step(x, jnp.zeros(2), dt)


def rolling(x: Float[Array, "5"], u: Float[Array, "2"]) -> Float[Array, "5"]:
    """x' of a unicycle."""
    _, _, psi, v, omega = x
    a, r = u
    return jnp.stack([v * jnp.cos(psi), v * jnp.sin(psi), omega, a, r])


def along(psi: Float[Array, ""]) -> Float[Array, "2"]:
    """The unit vector in the direction psi (rad)."""
    return jnp.stack([jnp.cos(psi), jnp.sin(psi)])


class DoubleIntegrator(AbstractDynamics):
    """x, y (m), vx, vy (m/s), driven by an acceleration (m/s^2)."""

    limits: tuple[float, ...] = (5.0, 5.0)  # largest ax and ay (m/s^2)
    integrator: Integrator = "euler"
    names: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy")
    inputs: ClassVar[tuple[str, ...]] = ("ax", "ay")
    units: ClassVar[tuple[str, ...]] = ("m", "m", "m/s", "m/s")
    input_units: ClassVar[tuple[str, ...]] = ("m/s^2", "m/s^2")
    felt: ClassVar[tuple[str, ...]] = ("vx", "vy")
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((2, 3), (0, 1))

    def field(self, x, u):
        return jnp.concatenate([x[2:], u])

    def position(self, x):
        return x[:2]

    def heading(self, x):
        return jnp.array([1.0, 0.0])

    def velocity(self, x):
        return x[2:]

    def rates(self, x):
        return x[2:]


class UnstablePoint(AbstractDynamics):
    """x, y (m), vx, vy (m/s); v' = growth v + u: left alone, a velocity grows by exp(growth t).

    Beyond |v| = limit / growth on an axis no input brings it back.
    """

    limits: tuple[float, ...] = (2.0, 2.0)  # largest ax and ay (m/s^2)
    integrator: Integrator = "euler"
    growth: float = 1.0  # 1/s
    names: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy")
    inputs: ClassVar[tuple[str, ...]] = ("ax", "ay")
    units: ClassVar[tuple[str, ...]] = ("m", "m", "m/s", "m/s")
    input_units: ClassVar[tuple[str, ...]] = ("m/s^2", "m/s^2")
    felt: ClassVar[tuple[str, ...]] = ("vx", "vy")
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((2, 3), (0, 1))

    def __check_init__(self):
        check_range("growth", self.growth, 0, 1e3, open=True)

    def field(self, x, u):
        return jnp.concatenate([x[2:], self.growth * x[2:] + u])

    def position(self, x):
        return x[:2]

    def heading(self, x):
        return jnp.array([1.0, 0.0])

    def velocity(self, x):
        return x[2:]

    def rates(self, x):
        return x[2:]


class SingleIntegrator(AbstractDynamics):
    """x, y (m), driven by a velocity (m/s)."""

    limits: tuple[float, ...] = (1.0, 1.0)  # largest vx and vy (m/s)
    integrator: Integrator = "euler"
    names: ClassVar[tuple[str, ...]] = ("x", "y")
    inputs: ClassVar[tuple[str, ...]] = ("vx", "vy")
    units: ClassVar[tuple[str, ...]] = ("m", "m")
    input_units: ClassVar[tuple[str, ...]] = ("m/s", "m/s")
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1),)

    def field(self, x, u):
        return u

    def position(self, x):
        return x

    def heading(self, x):
        return jnp.array([1.0, 0.0])

    def velocity(self, x):
        return jnp.zeros(2)

    def rates(self, x):
        return jnp.zeros(0)


DYNAMICS = {
    "unicycle": Unicycle(),
    "late-unicycle": LateUnicycle(),
    "double-integrator": DoubleIntegrator(),
    "unstable-point": UnstablePoint(),
    "single-integrator": SingleIntegrator(),
}


class Independent(AbstractPlant):
    """The plant of agents that move on their own, all by the same dynamics."""

    dynamics: AbstractDynamics
    coupled: ClassVar[bool] = False

    @property
    def moves(self):
        return type(self.dynamics)

    limits = property(lambda self: self.dynamics.limits)  # pyright: ignore
    integrator = property(lambda self: self.dynamics.integrator)  # pyright: ignore
    blocks = property(lambda self: self.dynamics.blocks)  # pyright: ignore

    @property
    def states(self) -> tuple[Entry, ...]:  # pyright: ignore
        d = self.dynamics
        return entries(d.names, d.units, "world")

    @property
    def inputs(self) -> tuple[Entry, ...]:  # pyright: ignore
        return entries(self.dynamics.inputs, self.dynamics.input_units, "own")

    def field(self, x, u, scenario, time):
        return jax.vmap(self.dynamics.field)(x, u)

    def inputs_of(self, action):
        return jax.vmap(self.dynamics.inputs_of)(action)

    def step(self, x, u, scenario, time, dt):
        return jax.vmap(lambda x, u: self.dynamics.step(x, u, dt))(x, u)


def entries(names: tuple[str, ...], units: tuple[str, ...], frame: str) -> tuple[Entry, ...]:
    """Names with units; "?" where a unit is not told."""
    units = units or ("?",) * len(names)
    return tuple(Entry(name, unit, frame) for name, unit in zip(names, units, strict=True))
