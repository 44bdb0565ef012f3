"""The plant of a game: equations of motion of the whole team, coupled or not, and integrators.

The vector field is written once. Both integrators, and every linearisation, are derived from it.
"""

import abc
from collections.abc import Callable
from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from marlyap.errors import UserError
from marlyap.types import Action, Entry, Scalar


Integrator = Literal["euler", "rk4"]
Inputs = Float[Array, "agent du"]  # in the units of `plant.inputs`
Field = Callable[[Array], Array]  # x -> f(x, u), the input held


class AbstractPlant(eqx.Module):
    """x' = f(x, u) of the whole team. It owns the equations of motion; it knows no goals.

    `states` and `inputs` name the last axis of x and u, with unit and frame. `limits` are the
    largest inputs. `blocks` orders the states for semi-implicit Euler: velocities before what they
    move. A plant is `coupled` if an agent's motion depends on others.
    """

    limits: eqx.AbstractVar[tuple[float, ...]]  # in the units of `inputs`
    integrator: eqx.AbstractVar[Integrator]
    states: eqx.AbstractVar[tuple[Entry, ...]]
    inputs: eqx.AbstractVar[tuple[Entry, ...]]
    blocks: eqx.AbstractVar[tuple[tuple[int, ...], ...]]
    coupled: ClassVar[bool] = True

    @property
    def moves(self) -> type:
        """What it moves: the class that has the equations of motion."""
        return type(self)

    def __check_init__(self):
        check_inputs(self.limits, tuple(u.name for u in self.inputs), self.integrator)

    @abc.abstractmethod
    def field(self, x: PyTree, u: Inputs, scenario: PyTree, time: Scalar) -> PyTree:
        """f(x, u), in the units of `states` per second.

        Arguments: x, the states of the team; u, inputs in the units of `inputs`; scenario, of the
        state (loads, parameters); time, seconds since the start, held within a step.
        """

    def inputs_of(self, action: Action) -> Inputs:
        """The inputs, in their units, that actions in [-1, 1] ask for; beyond that they clip."""
        return jnp.clip(action, -1.0, 1.0) * jnp.asarray(self.limits)[None]

    def step(
        self, x: PyTree, u: Inputs, scenario: PyTree, time: Scalar, dt: float | Array
    ) -> PyTree:
        """x after `dt` seconds of constant inputs."""
        return integrate(
            lambda x: self.field(x, u, scenario, time), x, dt, self.integrator, self.blocks
        )


def check_inputs(
    limits: tuple[float | Array, ...], inputs: tuple[str, ...], integrator: str
) -> None:
    """Raise UserError unless each input has one positive limit and the integrator is known."""
    traced = not all(isinstance(u, (int, float)) for u in limits)  # scaled inside jit
    if len(limits) != len(inputs) or not (traced or all(0 < u < 1e6 for u in limits)):
        numbers = "one positive number" if len(inputs) == 1 else f"{len(inputs)} positive numbers"
        raise UserError(f"limits: {limits} must be {numbers}, the largest {' and '.join(inputs)}.")
    if integrator not in ("euler", "rk4"):
        raise UserError(f"integrator: '{integrator}' must be euler or rk4.")


def integrate(
    f: Field,
    x: Array,
    dt: float | Array,
    integrator: Integrator,
    blocks: tuple[tuple[int, ...], ...],
) -> Array:
    """x [..., dx] after `dt` seconds of x' = f(x)."""
    return semi_implicit_euler(f, x, dt, blocks) if integrator == "euler" else rk4(f, x, dt)


def semi_implicit_euler(
    f: Field, x: Array, dt: float | Array, blocks: tuple[tuple[int, ...], ...]
) -> Array:
    """Velocities first, then what they move, each block with the values already new."""
    for block in blocks:
        rows = jnp.array(block)
        x = x.at[..., rows].add(dt * f(x)[..., rows])
    return x


def rk4(f: Field, x: Array, dt: float | Array) -> Array:
    """The classical fourth-order Runge-Kutta step."""
    k1 = f(x)
    k2 = f(x + dt / 2 * k1)
    k3 = f(x + dt / 2 * k2)
    k4 = f(x + dt * k3)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
