"""Consensus of points ahead of the agents, by feedback linearisation (baseline B1)."""

import jax.numpy as jnp

from marlyap.controllers.controller import (
    AbstractController,
    Robots,
    as_action,
    headings,
    left,
    mean_pull,
)
from marlyap.games.dynamics import Unicycle


class PointOffset(AbstractController):
    """Bring z_i = p_i + d h_i, a point ahead of the agent, to the goal as a double integrator.

    With u_i = k_p e_i - k_d z_i' and z_i' = v h + d w n, the inputs a = u.h + d w^2 and
    r = (u.n - v w) / d give z_i'' = u_i exactly, as long as they stay within the limits: stable on
    an undirected connected graph for any positive gains. The agent itself rests d metres from the
    goal, which a unicycle, unlike z_i, cannot approach exponentially (Brockett).
    """

    drives = (Unicycle,)

    game: Robots
    offset: float = 0.015  # d (m), smaller than the radius of success
    leader_gain: float = 17.0  # b, weight of the goal against one neighbour
    k_p: float = 24.0  # 1/s^2
    k_d: float = 4.5  # 1/s

    def __call__(self, state, key):
        d, v, w = self.offset, state.x[:, 3], state.x[:, 4]
        h = headings(self.game, state)
        n = left(h)
        z = self.game.positions(state) + d * h
        z_dot = v[:, None] * h + (d * w)[:, None] * n
        u = self.k_p * mean_pull(self.game, state, z, self.leader_gain) - self.k_d * z_dot
        a = jnp.sum(u * h, axis=1) + d * w**2
        r = (jnp.sum(u * n, axis=1) - v * w) / d
        return as_action(self.game, jnp.stack([a, r], axis=1))
