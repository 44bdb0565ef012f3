"""Feedback of each car by its own headway and speed, and the speed of the one ahead."""

import jax.numpy as jnp

from marlyap.controllers.controller import AbstractController, as_action
from marlyap.tasks.platoon import Cars, Platoon


class PlatoonOVM(AbstractController):
    """The optimal velocity model u = alpha (V(h) - v) + beta (v_ahead - v).

    Bando, Hasebe, Nakayama, Shibata and Sugiyama, Physical Review E 51(2), 1995, with the gains
    that Chu, Chinchali and Katti (ICLR 2020) let their agents choose among at most. It is not
    string stable: its largest gain from car to car is 1.144, at 0.62 rad/s, so long platoons
    collide.
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

    From one car to the next, G(s) = (k_r s + k_h) / (s^2 + (k_r + k_v) s + k_h) with |G| <= 1 at
    every frequency for these gains: string stable. Tuned for the cost of the nominal games of
    eight cars by Nelder and Mead's method, once where the leader keeps its speed and once where it
    changes it.
    """

    drives = (Cars,)

    game: Platoon
    keeping: tuple[float, ...] = (5.409, 10.878, 2.790)  # k_h (1/s^2), k_r (1/s), k_v (1/s)
    slowing: tuple[float, ...] = (1.804, 13.669, 0.470)  # the same where the leader slows down

    def __call__(self, state, key):
        game, (h, v, _) = self.game, state.x.T
        k_h, k_r, k_v = self.slowing if game.slows else self.keeping
        u = k_h * (h - game.headway) + k_r * (game.ahead(state) - v) + k_v * (game.plant.cruise - v)
        return as_action(game, jnp.stack([u], axis=1))
