"""Dynamics of one agent in continuous time, xdot = f(x, u), and their integration (section 4).

The vector field is written once. Both integrators, the Lipschitz constant of Theorem 1 and
every linearisation are derived from it.
"""

import abc
from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.errors import UserError


Position = Float[Array, "2"]


class AbstractDynamics(eqx.Module):
    """A planar agent driven by inputs u in [-limits, limits].

    `blocks` orders the state for semi-implicit Euler: velocities before what they move. `units`
    are those of `names`, `input_units` those of `inputs`, and `felt` names the entries of `rates`.
    """

    limits: eqx.AbstractVar[tuple[float, ...]]
    integrator: eqx.AbstractVar[Literal["euler", "rk4"]]
    names: eqx.AbstractClassVar[tuple[str, ...]]
    inputs: eqx.AbstractClassVar[tuple[str, ...]]
    blocks: eqx.AbstractClassVar[tuple[tuple[int, ...], ...]]
    units: ClassVar[tuple[str, ...]] = ()
    input_units: ClassVar[tuple[str, ...]] = ()
    felt: ClassVar[tuple[str, ...]] = ()

    def __check_init__(self):
        if len(self.limits) != len(self.inputs) or not all(0 < u < 1e6 for u in self.limits):
            raise UserError(
                f"limits: {self.limits} must be {len(self.inputs)} positive numbers, "
                f"the largest {' and '.join(self.inputs)}."
            )
        if self.integrator not in ("euler", "rk4"):
            raise UserError(f"integrator: '{self.integrator}' must be euler or rk4.")

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
        self, x: Float[Array, "dx"], action: Float[Array, "du"], dt: float
    ) -> Float[Array, "dx"]:
        """x_{t+1}: one step of `dt` seconds under a constant action in [-1, 1]^du."""
        u = self.inputs_of(action)
        return (semi_implicit_euler if self.integrator == "euler" else rk4)(self, x, u, dt)

    def inputs_of(self, action: Float[Array, "du"]) -> Float[Array, "du"]:
        """The inputs, in physical units, that an action in [-1, 1]^du asks for."""
        return jnp.clip(action, -1.0, 1.0) * jnp.asarray(self.limits)

    def predict(self, x: Float[Array, "dx"], dt: float) -> Float[Array, "dx"]:
        """The state in which an input asked for now begins to act: x, where none is late.

        A law fed with it instead of x is a Smith predictor without model error.
        """
        return x


def semi_implicit_euler(
    f: AbstractDynamics, x: Float[Array, "dx"], u: Float[Array, "du"], dt: float
) -> Float[Array, "dx"]:
    """Velocities first, then what they move, each block with the values already new."""
    for block in f.blocks:
        rows = jnp.array(block)
        x = x.at[rows].add(dt * f.field(x, u)[rows])
    return x


def rk4(
    f: AbstractDynamics, x: Float[Array, "dx"], u: Float[Array, "du"], dt: float
) -> Float[Array, "dx"]:
    """The classical fourth-order Runge-Kutta step with the input held."""
    k1 = f.field(x, u)
    k2 = f.field(x + dt / 2 * k1, u)
    k3 = f.field(x + dt / 2 * k2, u)
    k4 = f.field(x + dt * k3, u)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


class Unicycle(AbstractDynamics):
    """The paper's unicycle: x, y (m), psi (rad), v (m/s), omega (rad/s); a (m/s^2), r (rad/s^2).

    x' = v cos psi,  y' = v sin psi,  psi' = omega,  v' = a,  omega' = r.
    """

    limits: tuple[float, ...] = (5.0, 5.0)  # largest a (m/s^2) and r (rad/s^2)
    integrator: Literal["euler", "rk4"] = "euler"
    names: ClassVar[tuple[str, ...]] = ("x", "y", "psi", "v", "omega")
    inputs: ClassVar[tuple[str, ...]] = ("a", "r")
    units: ClassVar[tuple[str, ...]] = ("m", "m", "rad", "m/s", "rad/s")
    input_units: ClassVar[tuple[str, ...]] = ("m/s^2", "rad/s^2")
    felt: ClassVar[tuple[str, ...]] = ("v", "omega")
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((3, 4), (2,), (0, 1))

    def field(self, x, u):
        _, _, psi, v, omega = x
        a, r = u
        return jnp.stack([v * jnp.cos(psi), v * jnp.sin(psi), omega, a, r])

    def position(self, x):
        return x[:2]

    def heading(self, x):
        return jnp.stack([jnp.cos(x[2]), jnp.sin(x[2])])

    def velocity(self, x):
        return x[3] * self.heading(x)

    def rates(self, x):
        return x[3:]

    def turning(self, x):
        return x[4]


class LateUnicycle(Unicycle):
    """A unicycle whose inputs act one step after they were asked for.

    Those under way, a (m/s^2) and r (rad/s^2), are part of its state, and it feels them: without
    them the next state would not follow from what is known. The usual augmented state of a sampled
    system with a delay (Astrom and Wittenmark, Computer-Controlled Systems, 1997).
    """

    names: ClassVar[tuple[str, ...]] = (*Unicycle.names, "a", "r")
    units: ClassVar[tuple[str, ...]] = (*Unicycle.units, *Unicycle.input_units)
    felt: ClassVar[tuple[str, ...]] = ("v", "omega", "a", "r")

    def field(self, x, u):
        return jnp.concatenate([super().field(x[:5], x[5:]), jnp.zeros(2)])

    def step(self, x, action, dt):
        return super().step(x, action, dt).at[5:].set(self.inputs_of(action))

    def predict(self, x, dt):
        return self.step(x, jnp.zeros(2), dt)


class DoubleIntegrator(AbstractDynamics):
    """x, y (m), vx, vy (m/s), driven by an acceleration (m/s^2)."""

    limits: tuple[float, ...] = (5.0, 5.0)  # largest ax and ay (m/s^2)
    integrator: Literal["euler", "rk4"] = "euler"
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


class SingleIntegrator(AbstractDynamics):
    """x, y (m), driven by a velocity (m/s)."""

    limits: tuple[float, ...] = (1.0, 1.0)  # largest vx and vy (m/s)
    integrator: Literal["euler", "rk4"] = "euler"
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
    "single-integrator": SingleIntegrator(),
}
