"""Smooth time-varying rendezvous of unicycles (baseline B3)."""

import jax.numpy as jnp

from marlyap.controllers.controller import (
    AbstractController,
    Robots,
    as_action,
    headings,
    mean_pull,
)
from marlyap.games.dynamics import Unicycle


class LinFrancisMaggiore(AbstractController):
    """Move along the heading towards the neighbours while every heading sways with the clock.

    v_i = k sum_j h_i.(p_j - p_i) and w_i = cos t: Lin, Francis and Maggiore, IEEE Trans. Automatic
    Control 50(1), 2005, who prove rendezvous for small k where a globally reachable node exists.
    Here the sum is a mean, a leader counts its goal as a neighbour of weight b, and the speeds are
    tracked by a = k_a (v_d - v), r = k_r (w_d - w). Slow, and shipped for completeness.
    """

    drives = (Unicycle,)

    game: Robots
    gain: float = 1.0  # k (1/s)
    leader_gain: float = 1.0  # b, weight of the goal against one neighbour
    amplitude: float = 1.0  # of the turn rate (rad/s)
    frequency: float = 1.0  # of the turn rate (rad/s)
    k_a: float = 5.0  # speed loop (1/s)
    k_r: float = 5.0  # turn rate loop (1/s)

    def __call__(self, state, key):
        e = mean_pull(self.game, state, self.game.positions(state), self.leader_gain)
        v_d = self.gain * jnp.sum(e * headings(self.game, state), axis=1)
        w_d = self.amplitude * jnp.cos(self.frequency * self.game.dt * state.t)
        a = self.k_a * (v_d - state.x[:, 3])
        r = self.k_r * (w_d - state.x[:, 4])
        return as_action(self.game, jnp.stack([a, r], axis=1))
