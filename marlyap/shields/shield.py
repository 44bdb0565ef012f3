"""The fields of a credit shield: how much worse than the base law an agent may do, and when."""

from typing import Literal

import equinox as eqx

from marlyap.controllers.controller import Robots
from marlyap.controllers.drives import drive_of
from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractGame
from marlyap.games.planar import AbstractPlanar
from marlyap.shields.plan import Plan


WINDOW = 45  # steps within which the plan of a follower in a chain has to arrive


class Shield(eqx.Module):
    """A credit shield: its theorems, and what they ask for, are in docs/stability.md.

    Each agent simulates a base law from its own state by its own equations of motion. An action is
    applied if the plan from the next state arrives and the credit pays for what it costs more than
    the base law; otherwise the base law acts. What an action saves is earned as credit.
    """

    action: Literal["proposal", "residual"] = "proposal"  # residual: added to the base law's action
    reach: float = 1.0  # of a residual, in multiples of the limits
    sigma: float = 0.25  # the most credit, as a share of what the base law's plan costs
    rho: float = 0.005  # an agent within this of its reference may come to rest (m)
    tau: float = 0.1  # cost of each step that is not at rest there (m)
    weight: float = 0.02  # of the speed in the cost of a plan (s)
    steps: int = 60  # T: a plan that does not arrive in so many steps licenses nothing
    window: int | None = None  # see `window_of`; none: 45 in a chain, 0 where all hear a leader
    caution: float = 1.0  # share of the limits that plans count on: of the weakest motors
    on: bool = True  # whether it shields; if not, the action is applied as it is

    def __check_init__(self):
        if self.action not in ("proposal", "residual"):
            raise UserError(f"action: '{self.action}' must be proposal or residual.")
        for name in ("rho", "tau", "reach"):
            check_range(name, getattr(self, name), 0, 1e3, open=True)
        for name in ("sigma", "weight"):
            check_range(name, getattr(self, name), 0, 1e3)
        check_range("steps", self.steps, 1, 10_000)
        check_range("caution", self.caution, 0, 1, open=True)
        if self.window is not None:
            check_range("window", self.window, 0, 10_000)

    def plan(self, game: AbstractGame) -> Plan:
        """The plans of the agents of a game, which is the one inside all that wraps it.

        Raises UserError for a game whose agents have no base law towards a point.
        """
        robots = planar(game)
        if robots.dynamics.integrator != "euler":
            raise UserError("shield: rest in one step needs the integrator euler; set that.")
        model = robots.strengthened(self.caution) if self.caution != 1 else robots
        return Plan(model, drive_of(robots), self.rho, self.tau, self.weight, self.steps)

    def window_of(self, hops: int) -> int:
        """T_g: while its reference moves, a follower may take any action from whose outcome the
        plan arrives within so many steps, whatever that costs. `hops`: of the farthest follower.
        """
        if self.window is not None:
            return self.window
        return WINDOW if hops > 1 else 0


def planar(game: AbstractGame) -> Robots:
    """The game, if it is about robots in the plane. Raises UserError where it is not."""
    if not isinstance(game, AbstractPlanar):
        raise UserError(
            f"shield: {type(game).__name__} has no base law that drives an agent by itself to a "
            "point; there is one for robots in the plane only."
        )
    return game
