"""Feedback of each car by its own headway and speed, and the speed of the one ahead."""

import jax.numpy as jnp

from marlyap.controllers.controller import AbstractController, as_action
from marlyap.tasks.platoon import Cars, Platoon


class PlatoonOVM(AbstractController):
    """The optimal velocity model u = alpha (V(h) - v) + beta (v_ahead - v).

    Bando, Hasebe, Nakayama, Shibata and Sugiyama, Physical Review E 51(2), 1995, with the largest
    gains that Chu, Chinchali and Katti (ICLR 2020) let their agents choose. It is not string
    stable: from car to car speeds grow by up to 1.16, at 0.65 rad/s, so long platoons collide.
    """

    drives = (Cars,)

    game: Platoon
    alpha: float = 0.5  # 1/s
    beta: float = 0.5  # 1/s

    def __call__(self, state, key):
        h, v, _ = state.x.T
        u = self.alpha * (self.game.optimal_speed(h) - v) + self.beta * (self.game.ahead(state) - v)
        return as_action(self.game, u[:, None])


class PlatoonLinear(AbstractController):
    """Feedback u = k_h (h - h*) + k_r (v_ahead - v) + k_v (v* - v), the same for every car.

    Sampled every dt seconds, speeds go from car to car by

        G(z) = c / (z - 1 + c + dt k_v),   c = dt (k_r + k_h dt (z + 1) / (2 (z - 1))).

    The gains are those of the least cost in the nominal games of eight cars, by Nelder and Mead's
    method, with |G| <= 1 at every frequency, once where the leader keeps its speed and once where
    it changes it: string stable, up to the highest frequency. Without that condition the cost falls
    by 0.2 % at most, at k_r = 10.9 and 13.7, where noise and round-off grow 1.7 and 2.3 times from
    one car to the next, and the last of 32 cars swings in single precision.
    """

    drives = (Cars,)

    game: Platoon
    keeping: tuple[float, ...] = (4.47, 8.78, 2.37)  # k_h (1/s^2), k_r (1/s), k_v (1/s)
    slowing: tuple[float, ...] = (1.26, 9.83, 0.34)  # the same where the leader slows down

    def __call__(self, state, key):
        game, (h, v, _) = self.game, state.x.T
        k_h, k_r, k_v = self.slowing if game.slows else self.keeping
        u = k_h * (h - game.headway) + k_r * (game.ahead(state) - v) + k_v * (game.plant.cruise - v)
        return as_action(game, jnp.stack([u], axis=1))
