"""The equations of motion of quadrotors: planar ones with two motors, and those in space."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.errors import check_range
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.types import Entry, Scalar


class Flight(eqx.Module):
    """The scenario: where to go, the wind of this episode, and how hard the bodies are to turn."""

    goal: Float[Array, "agent d"]  # the place of each quadrotor (m)
    gust: Float[Array, "agent d"]  # its acceleration by the gust while it lasts (m/s^2)
    begins: Scalar  # when the gust begins (s)
    inertia: Float[Array, "agent"]  # of each body, in multiples of the plant's


class AbstractFlyers(AbstractPlant):
    """Quadrotors that do not touch; a gust of wind accelerates them for a while."""

    coupled: ClassVar[bool] = False
    gust_lasts: eqx.AbstractVar[float]  # s
    ways: eqx.AbstractClassVar[tuple[str, ...]]  # the axes of the world
    angles: eqx.AbstractClassVar[tuple[str, ...]]  # what `tilt` and `rates` are about

    @abc.abstractmethod
    def parts(self, x: Float[Array, "agent dx"]) -> tuple[Array, Array, Array, Array]:
        """Place (m), velocity (m/s), tilt (rad) and rates (rad/s), a row for each agent."""

    @abc.abstractmethod
    def frame(self, x: Float[Array, "agent dx"]) -> Float[Array, "agent d d"]:
        """The axes of each body as rows, the last one along its thrust."""

    @abc.abstractmethod
    def hovering(self, place: Float[Array, "agent d"]) -> Float[Array, "agent dx"]:
        """Hovering at these places."""

    def wind(self, scenario: Flight, time: Scalar) -> Float[Array, "agent d"]:
        """The acceleration by the wind now (m/s^2)."""
        blows = (time >= scenario.begins) & (time < scenario.begins + self.gust_lasts)
        return jnp.where(blows, scenario.gust, 0.0)


class PlanarQuads(AbstractFlyers):
    """Planar quadrotors: with F = f_1 + f_2 and f_k the thrust of motor k,

        p_x'' = -F sin(theta) / m,   p_z'' = F cos(theta) / m - g,
        theta'' = (f_2 - f_1) arm / (sqrt(2) J).

    A Crazyflie 2 (Panerati and others, Learning to Fly, IROS 2021), whose motors give 10 % more or
    less than in hover, as in safe-control-gym (Yuan and others, IEEE Robotics and Automation
    Letters 7(4), 2022).
    """

    limits: tuple[float, ...] = (0.01323, 0.01323)  # largest f_k - hover, a tenth of it (N)
    integrator: Integrator = "rk4"
    mass: float = 0.027  # m (kg)
    inertia: float = 1.4e-5  # J (kg m^2)
    arm: float = 0.0397  # from the centre to a motor (m)
    gravity: float = 9.8  # g (m/s^2)
    gust_lasts: float = 0.5  # s
    ways: ClassVar[tuple[str, ...]] = ("x", "z")
    angles: ClassVar[tuple[str, ...]] = ("pitch",)
    states: ClassVar[tuple[Entry, ...]] = (
        *(Entry(f"position, {way}", "m", "world") for way in ("x", "z")),
        Entry("pitch", "rad", "world"),
        *(Entry(f"velocity, {way}", "m/s", "world") for way in ("x", "z")),
        Entry("rate of pitch", "rad/s"),
    )
    inputs: ClassVar[tuple[Entry, ...]] = tuple(
        Entry(f"thrust of motor {k} - that in hover", "N", "own") for k in (1, 2)
    )
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((3, 4, 5), (0, 1, 2))

    def __check_init__(self):
        for name in ("mass", "inertia", "arm", "gravity", "gust_lasts"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)

    def field(self, x, u, scenario, time):
        pitch, f = x[:, 2], self.mass * self.gravity / 2 + u
        up = jnp.stack([-jnp.sin(pitch), jnp.cos(pitch)], axis=1)
        push = jnp.sum(f, axis=1, keepdims=True) / self.mass * up + self.wind(scenario, time)
        inertia = self.inertia * scenario.inertia[:, None]
        turn = (f[:, 1:] - f[:, :1]) * self.arm / (2**0.5 * inertia)
        fall = jnp.array([[0.0, self.gravity]])
        return jnp.concatenate([x[:, 3:5], x[:, 5:], push - fall, turn], axis=1)

    def parts(self, x):
        return x[:, :2], x[:, 3:5], x[:, 2:3], x[:, 5:]

    def frame(self, x):
        cos, sin = jnp.cos(x[:, 2]), jnp.sin(x[:, 2])
        return jnp.stack([jnp.stack([cos, sin], axis=1), jnp.stack([-sin, cos], axis=1)], axis=1)

    def hovering(self, place):
        return jnp.concatenate([place, jnp.zeros((len(place), 4))], axis=1)


class SpaceQuads(AbstractFlyers):
    """Quadrotors in space that are asked for a thrust and for body rates.

        v' = T R(q) e_z - g e_z - k v,   q' = q (0, w) / 2,   w' = (asked - w) / lag,

    with q the quaternion (w, x, y, z) from body to world, kept at length 1, and T = g + u_0 the
    thrust over the mass (m/s^2). A loop of its own makes the rates; its time constant `lag` grows
    with the body's inertia.
    """

    limits: tuple[float, ...] = (4.9, 3.0, 3.0, 1.0)  # largest T - g (m/s^2) and rates (rad/s)
    integrator: Integrator = "rk4"
    lag: float = 0.05  # of the loop that controls the rates (s)
    drag: float = 0.1  # k (1/s)
    gravity: float = 9.8  # g (m/s^2)
    gust_lasts: float = 0.5  # s
    ways: ClassVar[tuple[str, ...]] = ("x", "y", "z")
    angles: ClassVar[tuple[str, ...]] = ("roll", "pitch", "yaw")
    states: ClassVar[tuple[Entry, ...]] = (
        *(Entry(f"position, {way}", "m", "world") for way in ("x", "y", "z")),
        *(Entry(f"velocity, {way}", "m/s", "world") for way in ("x", "y", "z")),
        *(Entry(f"quaternion, {part}", "1", "world") for part in ("w", "x", "y", "z")),
        *(Entry(f"rate of {angle}", "rad/s", "own") for angle in ("roll", "pitch", "yaw")),
    )
    inputs: ClassVar[tuple[Entry, ...]] = (
        Entry("thrust / mass - g", "m/s^2", "own"),
        *(
            Entry(f"rate of {angle} asked for", "rad/s", "own")
            for angle in ("roll", "pitch", "yaw")
        ),
    )
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = (
        (10, 11, 12),
        (6, 7, 8, 9),
        (3, 4, 5),
        (0, 1, 2),
    )

    def __check_init__(self):
        for name in ("lag", "gravity", "gust_lasts"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        check_range("drag", self.drag, 0, 1e6)

    def field(self, x, u, scenario, time):
        v, q, w = x[:, 3:6], x[:, 6:10], x[:, 10:]
        e_z = jnp.array([[0.0, 0.0, 1.0]])
        thrust = (self.gravity + u[:, :1]) * turned(q, e_z)
        push = thrust - self.gravity * e_z - self.drag * v + self.wind(scenario, time)
        real, imaginary = q[:, :1], q[:, 1:]
        spun = -jnp.sum(imaginary * w, axis=1, keepdims=True)
        spin = jnp.concatenate([spun, real * w + jnp.cross(imaginary, w)], axis=1) / 2
        lag = self.lag * scenario.inertia[:, None]
        return jnp.concatenate([v, push, spin, (u[:, 1:] - w) / lag], axis=1)

    def step(self, x, u, scenario, time, dt):
        return unit(super().step(x, u, scenario, time, dt))

    def parts(self, x):
        """The tilt is twice the vector part of q, taken with w >= 0; an angle where it is small."""
        q = x[:, 6:10]
        return x[:, :3], x[:, 3:6], 2 * q[:, 1:] * jnp.where(q[:, :1] < 0, -1.0, 1.0), x[:, 10:]

    def frame(self, x):
        return jnp.stack([turned(x[:, 6:10], axis[None]) for axis in jnp.eye(3)], axis=1)

    def hovering(self, place):
        level = jnp.tile(jnp.array([[1.0, 0.0, 0.0, 0.0]]), (len(place), 1))
        still = jnp.zeros((len(place), 3))
        return jnp.concatenate([place, still, level, still], axis=1)


def turned(q: Float[Array, "agent 4"], v: Float[Array, "*one 3"]) -> Float[Array, "agent 3"]:
    """v turned by the unit quaternions q."""
    v = jnp.broadcast_to(v, (len(q), 3))
    t = 2 * jnp.cross(q[:, 1:], v)
    return v + q[:, :1] * t + jnp.cross(q[:, 1:], t)


def unit(x: Float[Array, "agent 13"]) -> Float[Array, "agent 13"]:
    """The states with quaternions of length 1."""
    q = x[:, 6:10]
    return x.at[:, 6:10].set(q / jnp.sqrt(jnp.sum(q**2, axis=1, keepdims=True)))
