"""No control, feed-forward and random control: the floor that every controller is compared with."""

import jax
import jax.numpy as jnp

from marlyap.controllers.controller import AbstractController
from marlyap.games.game import AbstractGame


class Zero(AbstractController):
    """The action 0 for every agent, whatever the state."""

    game: AbstractGame

    def __call__(self, state, key):
        return jnp.zeros((self.game.agents, self.game.du))


class Hold(AbstractController):
    """The action that would keep the target set, wherever the team is: feed-forward alone."""

    game: AbstractGame

    def __call__(self, state, key):
        return self.game.hold(state)


class UniformlyRandom(AbstractController):
    """An action drawn anew in every step, uniform in [-1, 1] for every input of every agent."""

    game: AbstractGame

    def __call__(self, state, key):
        size = (self.game.agents, self.game.du)
        return jax.random.uniform(key, size, minval=-1.0)
