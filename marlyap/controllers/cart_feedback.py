"""State feedback of each cart by itself: the springs act where the motors do, so it is enough."""

import jax.numpy as jnp
import numpy as np

from marlyap.controllers.controller import AbstractController
from marlyap.tasks.cartpoles import CartPoleRow, CartPoles


class CartFeedback(AbstractController):
    """a_i = k . (x, x', theta, theta') of cart i alone, with other gains at the ends of the row.

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
        k = jnp.asarray(np.where(end[:, None], np.array(self.ends), np.array(self.inside)))
        return jnp.clip(jnp.sum(k.astype(state.x.dtype) * state.x, axis=1)[:, None], -1.0, 1.0)
