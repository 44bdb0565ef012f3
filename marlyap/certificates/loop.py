"""The closed loop: a game, the controller that drives it, and V, with one game between them."""

from typing import Any, TypeVar

import equinox as eqx
import jax

from marlyap.certificates.lyapunov import AbstractLyapunov, CostSum
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame, AbstractRegulation, regulated
from marlyap.games.perturbed import Perturbed, nominal_limits, traced
from marlyap.games.wrapper import AbstractWrapper
from marlyap.simulation.rollout import Controller


T = TypeVar("T")


class ClosedLoop(eqx.Module):
    """What a certificate judges. The controller, and V, see the game that is driven and no other.

    A controller holds the game that it observes through. It must be the loop's own, or the game
    inside its perturbations; the loop then replaces it, so that a perturbed game is also observed
    as perturbed: with the messages and agents that are left. The limits that the controller divides
    its inputs by stay the nominal ones. V belongs to the loop because a `CostSum` is the sum of the
    loop's own costs: whatever changes the loop changes V.

    A game that a controller hides, in a function or a static field, cannot be found.

    Arguments: game, with a target set; controller, a function of the state and a key; V, by default
    the T-step cost sum beyond the edge of success.

    Raises UserError for a controller or V that was made for another game.
    """

    game: AbstractRegulation
    controller: Controller
    V: AbstractLyapunov

    def __init__(
        self, game: AbstractRegulation, controller: Controller, V: AbstractLyapunov | None = None
    ):
        self.game = game
        self.controller = seen_through(game, controller, "controller")
        V = CostSum(controller=self.controller, ball=game.edge, unit=game.unit) if V is None else V
        self.V = seen_through(game, V, "V")

    def under(self, **change: Any) -> "ClosedLoop":
        """The same loop with its game disturbed; `change` are fields of `Perturbed`.

        Raises UserError for a perturbation that cannot be applied to this game.
        """
        struck = lambda game: traced(Perturbed(inner=regulated(game), **change))
        game = regulated(self.game.beneath(struck))
        eqx.filter_eval_shape(game.reset, jax.random.key(0))  # a game may refuse to move its starts
        return ClosedLoop(game, self.controller, self.V)


def seen_through(game: AbstractGame, observer: T, what: str = "controller") -> T:
    """The controller, or V, observing through this game, with nominal limits.

    Raises UserError where it was made for another game.
    """
    known, eyes = [k for g in views(game) for k in (g, nominal_limits(g))], nominal_limits(game)

    def replaced(part: Any) -> Any:
        if not isinstance(part, AbstractGame):
            return part
        if not any(bool(eqx.tree_equal(part, one)) for one in known):
            raise UserError(
                f"{what}: {type(observer).__name__} was made for another game than the "
                f"{type(game).__name__} it is to drive; make it for this one."
            )
        return eyes

    return jax.tree.map(replaced, observer, is_leaf=lambda part: isinstance(part, AbstractGame))


def views(game: AbstractGame) -> list[AbstractGame]:
    """The game, and what it is without some of what wraps it: a controller may be made for any."""
    if not isinstance(game, AbstractWrapper):
        return [game]
    below = views(game.inner)
    rewrapped = [eqx.tree_at(lambda g: g.inner, game, inner) for inner in below[1:]]
    return [game, *rewrapped, *below]
