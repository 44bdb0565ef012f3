"""Gradient consensus: every agent descends its share of the disagreement (baseline B2)."""

import jax

from marlyap.controllers.cascade import Cascade
from marlyap.controllers.controller import AbstractController, Robots, as_action, mean_pull
from marlyap.games.dynamics import Unicycle


class GradientConsensus(AbstractController):
    """Head for the mean of the neighbours and, as a leader, the goal, by the cascaded law.

    The leader gain decides: with b = 1, plain averaging, a leader waits for its followers.
    """

    drives = (Unicycle,)

    game: Robots
    leader_gain: float = 20.0  # b, weight of the goal against one neighbour
    cascade: Cascade = Cascade(near=0.11, near_angle=0.09, k_r=10.0, braking=0.43, alignment=1.25)

    def __call__(self, state, key):
        e = mean_pull(self.game, state, self.game.positions(state), self.leader_gain)
        u = jax.vmap(self.cascade, in_axes=(None, 0, 0))(self.game, state.x, e)
        return as_action(self.game, u)
