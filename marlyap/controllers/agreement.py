"""Linear agreement: each agent moves towards its neighbours, by fixed weights."""

import jax.numpy as jnp
import numpy as np

from marlyap.controllers.controller import AbstractController, as_action
from marlyap.tasks.consensus import Averaging, Consensus
from marlyap.tasks.estimation import Estimation, Prediction


class Laplacian(AbstractController):
    """Feedback u_i = growth eps sum_j (x_j - x_i), with one weight eps for all edges.

    The best is eps = 2 / (l_2 + l_N), by the eigenvalues of the graph's Laplacian: Xiao and Boyd,
    Systems and Control Letters 53, 2004.
    """

    drives = (Averaging,)

    game: Consensus
    weight: float = 1.0  # eps, in multiples of the best; stable below 1 + l_2 / l_N at growth 1

    def __call__(self, state, key):
        game = self.game
        linked = game.adjacency.astype(float)
        values = np.linalg.eigvalsh(np.diag(linked.sum(axis=1)) - linked)
        span = values[-1] + values[min(1, len(values) - 1)]
        eps = 2 / span if span > 0 else 0.0
        pull = jnp.sum(jnp.where(game.linked(state), game.heard(state), 0.0), axis=1)
        return as_action(game, (game.plant.growth * self.weight * eps * pull)[:, None])


class ConsensusFilter(AbstractController):
    """Correction k H_i' (y_i - H_i x_i) + c sum_j (x_j - x_i): own measurement, others' estimates.

    The Kalman consensus filter with constant gains: Olfati-Saber, Proc. IEEE Conf. Decision and
    Control, 2009. The gains minimise the expected cost of the game without limits; there the
    errors shrink by 0.788 a step.
    """

    drives = (Prediction,)

    game: Estimation
    measured: float = 0.619  # k
    neighbours: float = 0.225  # c

    def __call__(self, state, key):
        linked = self.game.linked(state)[..., None]
        gap = jnp.where(linked, state.x[None, :] - state.x[:, None], 0.0)
        u = self.measured * self.game.innovations(state) + self.neighbours * jnp.sum(gap, axis=1)
        return as_action(self.game, u)
