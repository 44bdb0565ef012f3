"""State feedback of each cart by itself: the springs act where the motors do, so it is enough."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from marlyap.controllers.controller import AbstractController
from marlyap.tasks.cartpoles import CartPoleRow, CartPoles
from marlyap.types import Action, State


class CartFeedback(AbstractController):
    """Feedback a_i = k . (x, x', theta, theta') of cart i alone, with other gains at the ends.

    The gains are, to three digits, those that minimise the expected linear-quadratic cost of the
    nominal row over all feedback of the own state (structured LQR; Levine and Athans, IEEE Trans.
    Automatic Control 15(1), 1970).
    """

    drives = (CartPoleRow,)

    game: CartPoles
    ends: tuple[float, ...] = (3.83, 3.69, 19.21, 4.35)  # k of the two ends (1/m, s/m, 1, s)
    inside: tuple[float, ...] = (5.00, 4.30, 21.65, 4.94)  # k of the others (1/m, s/m, 1, s)

    def __call__(self, state, key):
        i = np.arange(self.game.agents)
        end = (i == 0) | (i == self.game.agents - 1)
        return fed_back(state, np.where(end[:, None], np.array(self.ends), np.array(self.inside)))


class CartLQR(AbstractController):
    """Feedback a_i = k . (x, x', theta, theta') with the gains of one cart's LQR, springs ignored.

    The cost is that of the game. It stabilises the coupled row all the same.
    """

    drives = (CartPoleRow,)

    game: CartPoles
    gains: tuple[float, ...] = (2.384, 2.673, 14.857, 3.257)  # k (1/m, s/m, 1, s)

    def __call__(self, state, key):
        return fed_back(state, np.tile(np.array(self.gains), (self.game.agents, 1)))


def fed_back(state: State, k: Float[np.ndarray, "agent 4"]) -> Action:
    """k_i . x_i for each agent, clipped."""
    gains = jnp.asarray(k, state.x.dtype)
    return jnp.clip(jnp.sum(gains * state.x, axis=1, keepdims=True), -1.0, 1.0)
