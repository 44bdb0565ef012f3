"""Voltage and current feedback of each converter by itself, fed forward by its load."""

import jax.numpy as jnp

from marlyap.controllers.controller import AbstractController
from marlyap.tasks.microgrid import ConverterRing, Microgrid


class GridFeedback(AbstractController):
    """Feedback u_i = V* + R P_i / V* - k_v (V_i - V*) - k_i (I_i - P_i / V*), all measured at i.

    The first two terms hold the bus at V* under the load P_i that is measured there. The gains were
    tuned for the cost of the nominal game by Nelder and Mead's method.
    """

    drives = (ConverterRing,)

    game: Microgrid
    k_v: float = 35.66  # of the voltage (V/V)
    k_i: float = 13.05  # of the current (V/A)

    def __call__(self, state, key):
        game, plant = self.game, self.game.plant
        V, current = state.x[:, 0], state.x[:, 1]
        drawn = plant.drawn(V, game.loads(state))
        power = drawn * V
        u = game.reference + plant.resistance * power / game.reference
        u = u - self.k_v * (V - game.reference) - self.k_i * (current - power / game.reference)
        return jnp.clip((u - plant.offset) / plant.limits[0], -1.0, 1.0)[:, None]
