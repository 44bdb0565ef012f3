"""Cascades for quadrotors in a chain: each follows the one before it, and the first its place."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.controllers.controller import AbstractController, as_action, needs_a_chain
from marlyap.games.quadrotors import PlanarQuads, SpaceQuads, turned
from marlyap.tasks.quads_planar import PlanarFormation
from marlyap.tasks.quads_space import SpaceFormation
from marlyap.types import State


class QuadChain(AbstractController):
    """Acceleration, then pitch, then thrusts: u_d = -k_p e - k_d e', e against the one before.

    With u_d = (u_x, u_z), |u_x| <= `most`, the pitch to go for is -atan(u_x / g), the torque
    J (k_pitch (its gap) - k_rate theta'), and the thrust m (g + u_z) / cos theta. Gains by Nelder
    and Mead's method for the cost of the nominal game. Lee, Leok and McClamroch, CDC 2010, have the
    same order of loops.
    """

    drives = (PlanarQuads,)

    game: PlanarFormation
    k_p: float = 2.538  # 1/s^2
    k_d: float = 3.236  # 1/s
    k_pitch: float = 182.2  # 1/s^2
    k_rate: float = 25.1  # 1/s
    most: float = 3.0  # largest acceleration to the side that is asked for (m/s^2)

    def __check_init__(self):
        super().__check_init__()
        needs_a_chain(self.game)

    def __call__(self, state, key):
        plant, (_, _, pitch, rate) = self.game.plant, self.game.plant.parts(state.x)
        e, e_dot = against_the_one_before(self.game, state)
        asked = -self.k_p * e - self.k_d * e_dot
        aim = -jnp.arctan(jnp.clip(asked[:, :1], -self.most, self.most) / plant.gravity)
        lift = (plant.gravity + asked[:, 1:]) / jnp.cos(jnp.clip(pitch, -1, 1)) - plant.gravity
        torque = plant.inertia * (self.k_pitch * (aim - pitch) - self.k_rate * rate)
        lift, twist = plant.mass / 2 * lift, torque / (plant.arm * 2**0.5)
        return as_action(self.game, jnp.concatenate([lift - twist, lift + twist], axis=1))


class QuadChainSpace(AbstractController):
    """Acceleration, then the direction of thrust, then body rates: the same loops in space.

    The acceleration to the side is at most `most_aside`, that up and down `most_up`. With b the
    direction of u_d + g e_z in the body's frame, the rates asked for are k_tilt (-b_y, b_x) and
    -k_yaw yaw, the thrust over the mass |u_d + g e_z| b_z. Gains as for the planar one.
    """

    drives = (SpaceQuads,)

    game: SpaceFormation
    k_p: float = 6.877  # 1/s^2
    k_d: float = 4.918  # 1/s
    k_tilt: float = 32.67  # 1/s
    k_yaw: float = 2.0  # 1/s
    most_aside: float = 4.0  # m/s^2
    most_up: float = 3.0  # m/s^2

    def __check_init__(self):
        super().__check_init__()
        needs_a_chain(self.game)

    def __call__(self, state, key):
        g, q = self.game.plant.gravity, state.x[:, 6:10]
        e, e_dot = against_the_one_before(self.game, state)
        asked = -self.k_p * e - self.k_d * e_dot
        aside, up = asked[:, :2], jnp.clip(asked[:, 2:], -self.most_up, self.most_up)
        size = jnp.sqrt(jnp.sum(aside**2, axis=1, keepdims=True) + 1e-18)  # smooth at 0
        aside = aside * jnp.minimum(1.0, self.most_aside / size)
        push = jnp.concatenate([aside, g + up], axis=1)
        thrust = jnp.sqrt(jnp.sum(push**2, axis=1, keepdims=True))
        b = turned(q * jnp.array([[1.0, -1.0, -1.0, -1.0]]), push / thrust)
        yaw = 2 * jnp.arctan2(q[:, 3:], q[:, :1])
        yaw = (yaw + jnp.pi) % (2 * jnp.pi) - jnp.pi
        rates = [-self.k_tilt * b[:, 1:2], self.k_tilt * b[:, :1], -self.k_yaw * yaw]
        return as_action(self.game, jnp.concatenate([thrust * b[:, 2:] - g, *rates], axis=1))


def against_the_one_before(
    game: PlanarFormation | SpaceFormation, state: State
) -> tuple[Float[Array, "agent d"], Float[Array, "agent d"]]:
    """Gap (m) and velocity (m/s) of each against agent i - 1; of agent 0 against its place."""
    p, v, _, _ = game.plant.parts(state.x)
    first = jnp.zeros((1, p.shape[1]))
    difference = lambda y: jnp.diff(y, axis=0, prepend=first)
    return difference(p - state.scenario.goal), difference(v)
