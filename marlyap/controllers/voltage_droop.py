"""Voltage feedback of each inverter by itself, stable by its slope."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.controllers.controller import AbstractController, as_action
from marlyap.tasks.voltage import PowerFlow, Voltage
from marlyap.types import Action


class DeadBand(AbstractController):
    """Feedback u_i = slope times how far v_i lies outside [low, high].

    Stable, without load, for slopes below 2 / l_max(X), X = dv/dq: Feng et al., IEEE Trans. Control
    of Network Systems, 2023.
    """

    drives = (PowerFlow,)

    game: Voltage
    share: float = 0.5  # the slope, as a share of the largest that is stable
    low: float = 0.97  # p.u.
    high: float = 1.03  # p.u.

    def __call__(self, state, key):
        return sloped(self.game, self.share, outside(state.x[:, 1], self.low, self.high))


class MildDeadBand(AbstractController):
    """The same with a slope as it is usual, in MVar/p.u.: 2 on 13 buses, 5 on 33.

    The former is the linear baseline of Feng et al., the latter scaled to the larger inverters.
    """

    drives = (PowerFlow,)

    game: Voltage
    slope: float = 2.0  # of 13 buses (MVar/p.u.)
    longer: float = 5.0  # of 33 buses (MVar/p.u.)
    low: float = 0.97  # p.u.
    high: float = 1.03  # p.u.

    def __call__(self, state, key):
        slope = self.slope if self.game.plant.buses == "13" else self.longer
        off = outside(state.x[:, 1], self.low, self.high)
        return as_action(self.game, slope * off[:, None])


class LinearVoltage(AbstractController):
    """Feedback slope (v_i - 1), no dead band: inverters with different voltages never rest."""

    drives = (PowerFlow,)

    game: Voltage
    share: float = 0.5  # the slope, as a share of the largest that is stable

    def __call__(self, state, key):
        return sloped(self.game, self.share, state.x[:, 1] - 1)


def outside(v: Float[Array, "agent"], low: float, high: float) -> Float[Array, "agent"]:
    """How far v lies above the band, or below it."""
    return jnp.maximum(v - high, 0) - jnp.maximum(low - v, 0)


def sloped(game: Voltage, share: float, off: Float[Array, "agent"]) -> Action:
    """Feedback with this share of the largest stable slope, clipped."""
    most = 2 / np.linalg.eigvalsh(game.plant.sensitivity)[-1]
    return as_action(game, float(share * most) * off[:, None])
