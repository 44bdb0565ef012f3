"""Cars that calm the traffic on a ring road, and one that drives like a human."""

import jax.numpy as jnp

from marlyap.controllers.controller import AbstractController, as_action
from marlyap.tasks.ring import Ring, RingRoad


class FollowerStopper(AbstractController):
    """Drive at the speed U, a share of the uniform flow's; slower where the gap asks for it.

    With D = min(v_ahead - v, 0)^2 and three gaps d_k = (4.5, 5.25, 6) + D (1/3, 1/2, 1), the speed
    to go for rises from 0 at d_1 over v_ahead at d_2 to U at d_3, linearly; the agent reaches it in
    one step as far as its limit allows. Stern and others, Transportation Research C 89, 2018.
    """

    drives = (RingRoad,)

    game: Ring
    share: float = 0.85  # U over the speed of the uniform flow

    def __call__(self, state, key):
        game, n = self.game, self.game.agents
        v, gap, ahead = state.x[:n, 1], game.gaps(state)[:n], game.ahead(state)[:n]
        U = self.share * state.scenario.flow
        closing = jnp.minimum(ahead - v, 0.0) ** 2
        d_1, d_2, d_3 = 4.5 + closing / 3, 5.25 + closing / 2, 6.0 + closing
        w = jnp.clip(ahead, 0.0, U)
        near = w * jnp.clip((gap - d_1) / (d_2 - d_1), 0, 1)
        wish = near + (U - w) * jnp.clip((gap - d_2) / (d_3 - d_2), 0, 1)
        return as_action(game, ((wish - v) / game.dt)[:, None])


class RingLinear(AbstractController):
    """Feedback a = k_v (U - v) + k_r (v_ahead - v), but never more than a human's acceleration."""

    drives = (RingRoad,)

    game: Ring
    share: float = 0.85  # U over the speed of the uniform flow
    k_v: float = 0.5  # 1/s
    k_r: float = 0.0  # 1/s

    def __call__(self, state, key):
        game, n = self.game, self.game.agents
        v, gap, ahead = state.x[:n, 1], game.gaps(state)[:n], game.ahead(state)[:n]
        u = self.k_v * (self.share * state.scenario.flow - v) + self.k_r * (ahead - v)
        return as_action(game, jnp.minimum(u, game.plant.human(v, ahead, gap))[:, None])


class RingHuman(AbstractController):
    """One more human: the intelligent driver model, without noise."""

    drives = (RingRoad,)

    game: Ring

    def __call__(self, state, key):
        game, n = self.game, self.game.agents
        v, gap, ahead = state.x[:n, 1], game.gaps(state)[:n], game.ahead(state)[:n]
        return as_action(game, game.plant.human(v, ahead, gap)[:, None])
