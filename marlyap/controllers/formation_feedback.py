"""Feedback of displacements and velocities for formations of double integrators."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.controllers.controller import AbstractController, Robots, as_action, needs_a_chain
from marlyap.games.dynamics import DoubleIntegrator
from marlyap.types import Action


class FormationConsensus(AbstractController):
    """Second-order consensus u_i = k_p e_i - k_d v_i, every agent by the same gains.

    e_i is the mean, over the neighbours and for a leader its own place, of how far i is from where
    each says it should be. With the grounded Laplacian L + diag(b), b_i = 1 for a leader and n_i
    the number of those asked, e = diag(1 / n) (L + diag(b)) (goal - p): stable on a connected graph
    for any positive gains in continuous time (Ren and Beard, Distributed Consensus in
    Multi-vehicle Cooperative Control, 2008). Tuned on a path of five by Nelder and Mead's method.
    """

    drives = (DoubleIntegrator,)

    game: Robots
    k_p: float = 34.21  # 1/s^2
    k_d: float = 4.118  # 1/s

    def __call__(self, state, key):
        linked, lead = self.game.linked(state), jnp.asarray(self.game.leads)
        gap = self.game.goals(state) - self.game.positions(state)
        weight = linked.astype(gap.dtype)
        asked = jnp.sum(weight, axis=1) + lead
        pull = asked[:, None] * gap - weight @ gap
        e = pull / jnp.where(asked > 0, asked, 1.0)[:, None]
        return as_action(self.game, self.k_p * e - self.k_d * state.x[:, 2:])


class FormationFeedback(AbstractController):
    """Static linear feedback with gains for each agent and each neighbour on a path of five.

    u_i = p_i (g_i - g_{i-1}) + v_i (v_{i-1} - v_i) + the same for i + 1 - own_i v_i with
    g = goal - position, and g_{-1} = 0 for the leader 0. The gains are, to two digits, those that
    minimise the expected linear-quadratic cost of the game without limits over all gains of this
    pattern (structured LQR; Levine and Athans, IEEE Trans. Automatic Control 15(1), 1970).
    """

    drives = (DoubleIntegrator,)

    game: Robots
    place_ahead: tuple[float, ...] = (27.08, 14.32, 14.53, 13.79, 13.95)  # p of i - 1 (1/s^2)
    place_behind: tuple[float, ...] = (-5.88, 1.66, 2.75, 4.43, 0.0)  # p of i + 1 (1/s^2)
    speed_ahead: tuple[float, ...] = (0.0, 6.63, 6.38, 5.84, 5.38)  # v of i - 1 (1/s)
    speed_behind: tuple[float, ...] = (-1.51, 0.97, 0.62, 1.12, 0.0)  # v of i + 1 (1/s)
    own: tuple[float, ...] = (11.57, 1.03, 1.49, 1.02, 1.36)  # of the own velocity (1/s)

    def __check_init__(self):
        super().__check_init__()
        needs_a_chain(self.game, len(self.own))

    def __call__(self, state, key) -> Action:
        game, v = self.game, state.x[:, 2:]
        gap = game.goals(state) - game.positions(state)
        heard = jnp.concatenate([jnp.ones(1, bool), jnp.diagonal(game.linked(state), offset=-1)])
        behind = jnp.concatenate([jnp.diagonal(game.linked(state), offset=1), jnp.zeros(1, bool)])

        def pull(gains, heard, difference) -> Float[Array, "agent 2"]:
            k = jnp.where(heard, jnp.asarray(np.array(gains), gap.dtype), 0.0)
            return k[:, None] * difference

        none = jnp.zeros((1, 2))
        from_ahead = lambda y: jnp.diff(y, axis=0, prepend=none)  # y_i - y_{i-1}
        from_behind = lambda y: -jnp.diff(y, axis=0, append=none)  # y_i - y_{i+1}
        u = pull(self.place_ahead, heard, from_ahead(gap))
        u = u + pull(self.place_behind, behind, from_behind(gap))
        u = u - pull(self.speed_ahead, heard, from_ahead(v))
        u = u - pull(self.speed_behind, behind, from_behind(v))
        return as_action(game, u - pull(self.own, jnp.ones_like(heard), v))
