"""Base laws: how one agent, by its own equations of motion, is driven to rest at a point."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from marlyap.controllers.cascade import Cascade
from marlyap.controllers.controller import Robots
from marlyap.errors import UserError
from marlyap.games.dynamics import DoubleIntegrator, SingleIntegrator, Unicycle, UnstablePoint


X = Float[Array, "dx"]  # the state of one agent, in SI units
Point = Float[Array, "2"]  # m


class AbstractDrive(eqx.Module):
    """A law for one agent and a point q, which needs nothing but the agent's own state.

    Every method takes the game for its `dynamics` and `dt`. Inputs are in physical units and not
    clipped yet.
    """

    moves: eqx.AbstractClassVar[tuple[type, ...]]  # the dynamics that it drives

    @abc.abstractmethod
    def drive(self, game: Robots, x: X, q: Point) -> Float[Array, "du"]:
        """Towards q; smooth only where the agent is neither at q nor at rest."""

    @abc.abstractmethod
    def brake(self, game: Robots, x: X) -> Float[Array, "du"]:
        """To rest in a single step; with `slow`, without meeting a limit."""

    @abc.abstractmethod
    def slow(self, game: Robots, x: X) -> Bool[Array, ""]:
        """Whether `brake` stays within the limits."""

    @abc.abstractmethod
    def stop(self, game: Robots, x: X) -> Point:
        """About where the agent comes to rest if it brakes (m); its position where it rests."""


class UnicycleDrive(AbstractDrive):
    """The cascade of tree pursuit; an agent stops about `margin` v^2 / (2 a_max) ahead."""

    cascade: Cascade = Cascade()
    margin: float = 1.9  # predicted stopping distance over the shortest possible
    moves: ClassVar[tuple[type, ...]] = (Unicycle,)

    def drive(self, game, x, q):
        return self.cascade(game, x, q - game.dynamics.position(x))

    def brake(self, game, x):
        return -x[3:5] / game.dt

    def slow(self, game, x):
        return jnp.all(jnp.abs(x[3:5]) <= jnp.asarray(game.dynamics.limits) * game.dt)

    def stop(self, game, x):
        v, d = x[3], game.dynamics
        return d.position(x) + self.margin * v * jnp.abs(v) / (2 * d.limits[0]) * d.heading(x)


class PointDrive(AbstractDrive):
    """A point mass, axis by axis; it may be unstable: v' = g v + u with |u| <= b.

    Braking with all of b from v = s b / g takes (-ln(1 - s) - s) b / g^2 metres, which is at most
    s^2 / (2 (1 - s)) of that unit, and v^2 / (2 b) for g = 0. The speed to go for is the least of
    k |e|, of the one from which the share `braking` of |e| is enough by that bound, and of the
    share `calm` of b / g, beyond which no input would bring it back. The input
    u = (v_d - v) / dt - g v reaches it in one step, as far as the limit allows.
    """

    near: float = 5.0  # k (1/s)
    braking: float = 0.8  # share of the way that has to be enough for braking
    calm: float = 0.8  # share of b / g that no desired speed exceeds
    moves: ClassVar[tuple[type, ...]] = (DoubleIntegrator, UnstablePoint)

    def drive(self, game, x, q):
        e, b, g = q - x[:2], jnp.asarray(game.dynamics.limits), growth(game)
        way = self.braking * jnp.maximum(jnp.abs(e), 1e-9)
        if g:
            y = way * g**2 / b
            share = 2 * y / (y + jnp.sqrt(y * (y + 2)))  # the s with s^2 / (2 (1 - s)) = y
            stoppable = b / g * jnp.minimum(share, self.calm)
        else:
            stoppable = jnp.sqrt(2 * b * way)
        speed = jnp.minimum(self.near * jnp.abs(e), stoppable)
        return (jnp.sign(e) * speed - x[2:]) / game.dt - g * x[2:]

    def brake(self, game, x):
        return -x[2:] / game.dt - growth(game) * x[2:]

    def slow(self, game, x):
        return jnp.all(jnp.abs(self.brake(game, x)) <= jnp.asarray(game.dynamics.limits))

    def stop(self, game, x):
        v, b, g = x[2:], jnp.asarray(game.dynamics.limits), growth(game)
        if not g:
            return x[:2] + v * jnp.abs(v) / (2 * b)
        s = jnp.minimum(g * jnp.abs(v) / b, 0.95)
        return x[:2] + jnp.sign(v) * b / g**2 * (-jnp.log1p(-s) - s)


class SpeedDrive(AbstractDrive):
    """A point whose velocity is its input: there in one step, as far as the limits allow."""

    moves: ClassVar[tuple[type, ...]] = (SingleIntegrator,)

    def drive(self, game, x, q):
        return (q - x) / game.dt

    def brake(self, game, x):
        return jnp.zeros(2)

    def slow(self, game, x):
        return jnp.asarray(True)

    def stop(self, game, x):
        return x


DRIVES: tuple[AbstractDrive, ...] = (UnicycleDrive(), PointDrive(), SpeedDrive())


def growth(game: Robots) -> float:
    """g of v' = g v + u (1/s); 0 for a double integrator."""
    return game.dynamics.growth if game.plant.moves is UnstablePoint else 0.0  # pyright: ignore


def drive_of(game: Robots) -> AbstractDrive:
    """The base law for the dynamics of a game. Raises UserError where there is none."""
    for drive in DRIVES:
        if game.plant.moves in drive.moves:
            return drive
    known = ", ".join(cls.__name__ for drive in DRIVES for cls in drive.moves)
    raise UserError(
        f"shield: there is no base law for {game.plant.moves.__name__}, only for {known}; choose "
        "another task, or other dynamics for this one."
    )
