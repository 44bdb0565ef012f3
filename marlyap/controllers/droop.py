"""Droop: each machine answers its own frequency, the steeper the more it can give."""

import jax.numpy as jnp

from marlyap.controllers.controller import AbstractController, as_action
from marlyap.errors import UserError
from marlyap.tasks.frequency import Frequency, SwingEquations


class Droop(AbstractController):
    """Droop u_i = k_i w_i, with the gains that Cui, Jiang and Zhang publish beside their networks.

    IEEE Trans. Power Systems 38(2), 2023. Any increasing u_i(w_i) with u_i(0) = 0 makes the energy

        pi sum_i M_i w_i^2 + sum_{i<j} K_ij (cos d*_ij - cos d_ij - sin d*_ij (d_ij - d*_ij))

    fall, d_ij being delta_i - delta_j and d*_ij its value at rest.
    """

    drives = (SwingEquations,)

    game: Frequency
    gains: tuple[float, ...] = (2.2347659, 2.720281, 2.4595585, 43.59709, 5.7675405) + (
        2.3880444,
        156.02136,
        12.0558605,
        2.8042254,
        25.922562,
    )  # k (p.u./Hz)

    def __call__(self, state, key):
        if len(self.gains) != self.game.agents:
            raise UserError(f"gains: give one for each machine, {self.game.agents} numbers.")
        k = jnp.asarray(self.gains) / jnp.asarray(self.game.plant.largest)
        return as_action(self.game, (k * state.x[:, 1])[:, None])


class SteepDroop(AbstractController):
    """Droop u_i = u_max,i w_i / span: every machine gives its all from the same deviation on."""

    drives = (SwingEquations,)

    game: Frequency
    span: float = 0.02  # Hz

    def __call__(self, state, key):
        return as_action(self.game, state.x[:, 1:] / self.span)
