"""Is the game the model that a formula is about? Asked before anything is proved by formulas."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from marlyap.certificates.linearisation import as_double
from marlyap.certificates.loop import ClosedLoop
from marlyap.errors import UserError
from marlyap.games.dynamics import AbstractDynamics
from marlyap.games.game import AbstractRegulation
from marlyap.games.planar import AbstractPlanar, Goals
from marlyap.tasks.rendezvous import Rendezvous
from marlyap.types import State


# What the formulas take for granted of Rendezvous: one that replaces any of it is another game.
PARTS = ("step", "observe", "observations", "local_view", "linked", "adjacency", "slots", "leads")
PARTS += ("errors", "distance", "positions", "goals", "edge", "success", "terminated", "failed")
SAMPLES = 256
ROUNDING = 1e-9  # in float64, of states of the size of metres


def require_model(
    name: str, loop: ClosedLoop, kinds: tuple[type[AbstractDynamics], ...]
) -> AbstractPlanar:
    """The loop's game, which is Rendezvous as it stands; UserError where it is not."""
    game = loop.game
    other = [
        part for part in PARTS if getattr(type(game), part, None) is not getattr(Rendezvous, part)
    ]
    part = other[0] if other else "kind"
    if other or not isinstance(game, AbstractPlanar):
        raise UserError(
            f"{name}: its formulas are about Rendezvous, and {type(game).__name__} has another "
            f"`{part}`; take a certificate that plays the game, such as reach."
        )
    if type(game.dynamics) not in kinds or game.dynamics.integrator != "euler":
        known = " or ".join(kind.__name__ for kind in kinds)
        raise UserError(
            f"{name}: its formulas are about {known} with Euler steps, not "
            f"{type(game.dynamics).__name__} with {game.dynamics.integrator}."
        )
    return game


def require_step(
    name: str,
    loop: ClosedLoop,
    states: State,
    model: Callable[[State], np.ndarray],
    of: Callable[[AbstractRegulation, State], Any],
) -> None:
    """Raise UserError unless the game's own step under the controller is the model's, in float64.

    Arguments: states [sample], in the region that is spoken of; model, the model's answer for all
    of them [sample, ...]; of, the game's, from the state after one step.
    """
    with jax.enable_x64(True):
        exact, states = as_double(loop), as_double(states)

        @jax.jit
        def after(states: State) -> Any:
            act = lambda s: exact.controller(s, jax.random.key(0))
            one = lambda s: of(exact.game, exact.game.step(s, act(s)))
            return jax.vmap(one)(states)

        mine, theirs = np.asarray(after(states), float), model(states)
    gap = float(np.max(np.abs(mine - theirs)))
    if not gap <= ROUNDING * (1 + float(np.max(np.abs(theirs)))):
        raise UserError(
            f"{name}: a step of {type(loop.game).__name__} ends {gap:.3g} beside the formula's; "
            "it is not about this game."
        )


def drawn(game: AbstractRegulation, spread: np.ndarray, goals: np.ndarray, seed: int = 0) -> State:
    """States [sample] with x uniform in +- `spread` [dx] of every agent."""
    rng, shape = np.random.default_rng(seed), (SAMPLES, game.agents, len(spread))
    x = rng.uniform(-1.0, 1.0, shape) * spread
    with jax.enable_x64(True):
        one = lambda x, goal: State(x=x, scenario=Goals(goal), t=jnp.asarray(0))
        return jax.vmap(one)(jnp.asarray(x), jnp.asarray(goals))
