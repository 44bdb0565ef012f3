"""A cure for a known delay of the inputs: each agent acts on where it will be when it acts."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.games.wrapper import plain_game
from marlyap.simulation.rollout import Controller
from marlyap.types import Action, Key, State


class Predicting(eqx.Module):
    """A controller or policy, shown each agent's own state as its inputs under way will leave it.

    Agent i predicts its own state by its own equations of motion and its own inputs that have been
    asked for and have no effect yet; of its neighbours it sees where they are. So nothing is
    communicated, and no policy has to be trained anew. It is a Smith predictor (Smith, Chemical
    Engineering Progress 53, 1957), exact for a known delay without disturbance. Without a delay it
    is the controller itself.

    Arguments: controller, of the game; game, which knows what is under way (`underway`).

    Raises UserError for a game whose agents do not move on their own.
    """

    controller: Controller
    game: AbstractGame

    def __check_init__(self):
        if self.game.plant.coupled:
            raise UserError(
                f"predicting: the agents of {type(plain_game(self.game)).__name__} do not move on "
                "their own, so that none can predict itself; leave the prediction out."
            )

    def __call__(self, state: State, key: Key) -> Action:
        plant, x = plain_game(self.game).plant, state.x
        for k, action in enumerate(self.game.underway(state)):
            u, time = plant.inputs_of(action), (state.t + k) * self.game.dt
            x = plant.step(x, u, state.scenario, time, self.game.dt)

        def of(i: Int[Array, ""]) -> Float[Array, "du"]:
            own = jnp.arange(self.game.agents) == i
            seen = jnp.where(own[:, None], x, state.x)
            return self.controller(eqx.tree_at(lambda s: s.x, state, seen), key)[i]

        return jax.vmap(of)(jnp.arange(self.game.agents))
