"""Laws for flocks: Olfati-Saber's and Tanner's, alignment, and braking by all that is known."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.controllers.controller import AbstractController, as_action
from marlyap.tasks.flock import Flock, PointMasses
from marlyap.tasks.gnn_flock import GnnFlock, HeldPointMasses
from marlyap.types import State


EPSILON, STRENGTH, FLAT = 0.1, 5.0, 0.2  # of the sigma-norm; a = b of phi; h of the bump


def sigma_norm(squared: Array | float) -> Array:
    """(sqrt(1 + eps |z|^2) - 1) / eps, of |z|^2: differentiable at 0."""
    return (jnp.sqrt(1 + EPSILON * jnp.asarray(squared)) - 1) / EPSILON


def bump(z: Array) -> Array:
    """1 up to `FLAT`, then a cosine down to 0 at 1, and 0 beyond."""
    falls = 0.5 * (1 + jnp.cos(jnp.pi * (z - FLAT) / (1 - FLAT)))
    return jnp.where(z < FLAT, 1.0, jnp.where(z <= 1, falls, 0.0))


def cohere(game: Flock, state: State) -> Float[Array, "agent 2"]:
    """sum_j phi(|q_j - q_i|) n_ij + sum_j a_ij (p_j - p_i), over those that i sees (m/s^2)."""
    gap = state.x[None, :] - state.x[:, None]
    squared = jnp.sum(gap[..., :2] ** 2, axis=-1)
    z, reach = sigma_norm(squared), sigma_norm((1.2 * game.spacing) ** 2)
    off = z - sigma_norm(game.spacing**2)
    weight = jnp.where(game.linked(state), bump(z / reach), 0.0)
    force = weight * STRENGTH * off / jnp.sqrt(1 + off**2)
    normal = gap[..., :2] / jnp.sqrt(1 + EPSILON * squared)[..., None]
    return jnp.sum(force[..., None] * normal + weight[..., None] * gap[..., 2:], axis=1)


class OlfatiSaber(AbstractController):
    """Algorithm 2: cohesion, alignment, and feedback of the leader's place and velocity.

    u_i = sum_j phi(|q_j - q_i|) n_ij + sum_j a_ij (p_j - p_i) - c1 (q_i - q_r) - c2 (p_i - p_r):
    Olfati-Saber, IEEE Trans. Automatic Control 51(3), 2006, with eps = 0.1, a = b = 5, h = 0.2.
    """

    drives = (PointMasses,)

    game: Flock
    c1: float = 0.3  # 1/s^2
    c2: float = 1.1  # 1/s

    def __call__(self, state, key):
        off = state.x - self.game.leader(state)[None]
        u = cohere(self.game, state) - self.c1 * off[:, :2] - self.c2 * off[:, 2:]
        return as_action(self.game, u)


class FreeFlock(AbstractController):
    """Algorithm 1: cohesion and alignment alone, with which most flocks break up (same paper)."""

    drives = (PointMasses,)

    game: Flock

    def __call__(self, state, key):
        return as_action(self.game, cohere(self.game, state))


class Alignment(AbstractController):
    """Reynolds' second rule: u_i = gain (mean velocity of i and those it sees - v_i) / dt.

    Reynolds, Computer Graphics 21(4), 1987.
    """

    drives = (PointMasses, HeldPointMasses)

    game: Flock | GnnFlock
    gain: float = 1.0

    def __call__(self, state, key):
        linked, v = self.game.linked(state), state.x[:, 2:]
        gap = jnp.where(linked[..., None], v[None, :] - v[:, None], 0.0)
        mean = jnp.sum(gap, axis=1) / (1 + jnp.sum(linked, axis=1))[:, None]
        return as_action(self.game, self.gain * mean / self.game.dt)


class Tanner(AbstractController):
    """Alignment and a potential of distance, of those nearby: the usual baseline of GNN flocking.

    u_i = -sum_j (p_i - p_j) - sum_j grad V(q_i - q_j), V = 1 / r^2 + log r^2: Tanner, Jadbabaie and
    Pappas, Proc. IEEE Conf. Decision and Control, 2003. With a limited sight the repulsion blows
    flocks apart; `everybody` aligns with all, as the expert of Tolstaya et al. does.
    """

    drives = (PointMasses, HeldPointMasses)

    game: Flock | GnnFlock
    everybody: bool = False

    def __call__(self, state, key):
        linked = self.game.linked(state)[..., None]
        gap = state.x[:, None] - state.x[None, :]
        squared = jnp.where(linked, jnp.sum(gap[..., :2] ** 2, axis=-1, keepdims=True), 1.0)
        slope = jnp.where(linked, 2 * (1 / squared - 1 / squared**2) * gap[..., :2], 0.0)
        seen = gap[..., 2:] if self.everybody else jnp.where(linked, gap[..., 2:], 0.0)
        return as_action(self.game, -jnp.sum(seen + slope, axis=1))


class Braking(AbstractController):
    """Everybody knows the mean velocity and takes it as fast as the limits allow: centralised."""

    drives = (PointMasses, HeldPointMasses)

    game: Flock | GnnFlock

    def __call__(self, state, key):
        v = state.x[:, 2:]
        return as_action(self.game, (jnp.mean(v, axis=0, keepdims=True) - v) / self.game.dt)
