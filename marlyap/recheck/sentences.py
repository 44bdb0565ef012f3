"""The sentence and the scope of every certificate, written anew from the figures derived again."""

import decimal
import math
from typing import Any


MEANING = {
    "CostSum": "the sum of the next {T} costs beyond {ball:g} {unit}",
    "Quadratic": "a quadratic form in the errors",
    "Norm": "a trained network that is zero on the target set",
}


def percent(share: float, up: bool = False) -> str:
    """A share in per cent to two decimals, rounded downwards unless `up`."""
    hundredths = math.ceil(1e4 * share - 1e-6) if up else math.floor(1e4 * share + 1e-6)
    return f"{hundredths / 100:.2f} %"


def at_most(bound: float | None, unit: str) -> str:
    """An upper bound to four digits, rounded upwards; None is no bound."""
    if bound is None:
        return "unbounded"
    four = decimal.Context(prec=4, rounding=decimal.ROUND_CEILING)
    return f"at most {float(four.create_decimal_from_float(bound * (1 - 1e-6))):.4g}{unit}"


class Sentences:
    """Claims and scopes about one game and one V, as recorded."""

    # By construction: row i of a policy's action is made of row i of the observations alone.
    information = "each agent acts on its own observation"

    def __init__(self, game: dict[str, Any], V: dict[str, Any]):
        self.game, self.H, self.dt = game, game["horizon"], game["dt"]
        self.V = MEANING.get(V["kind"], "").format(T=V.get("T"), ball=V["ball"], unit=V.get("unit"))
        self.ball = V["ball"]
        self.arrived = f"every agent within {game['radius']:g} m of its goal"
        self.end = f"{self.H * self.dt:g} s"

    def until(self, steps: int) -> str:
        return f"until step {steps} ({steps * self.dt:g} s)"

    def scope(self, steps: int, disturbance: str = "none") -> dict[str, Any]:
        return {
            "starts": "the starts that Rendezvous.reset draws",
            "horizon_steps": steps,
            "horizon_seconds": steps * self.dt,
            "disturbance": disturbance,
            "edge": self.game["radius"],
            "unit": "m",
            "information": self.information,
        }

    def apart(self, bound: float, gap: float, least: float, steps: int) -> str:
        little = f", which is less than the {least:g} m asked" if gap < least else ""
        begin = f"on at least {percent(bound)} of starts no two agents come closer than {gap:g} m"
        return f"{begin}{little}, at any step {self.until(steps)}"

    def linearised(self, radius: float, margin: float, scenes: int) -> str:
        begin = f"the closed loop of the game's own step, linearised at {scenes} targets, has"
        if radius <= 1 - margin:
            says = (
                f"at most 1 - {margin:g}, so that rest on the goal is exponentially stable nearby"
            )
        else:
            says = f"more than 1 - {margin:g}: no stability is shown"
        return f"{begin} spectral radius {radius:.6f}, {says}"

    def uncontrollable(self, count: int, decay: float) -> str:
        return (
            f"NO: the linearised step at the goal has {count} uncontrollable eigenvalue(s) of size "
            "1 or more that the errors see (for a unicycle, sideways), so that no Lipschitz state "
            f"feedback that rests there makes the errors decay by more than {decay:g} of "
            "themselves a step; certify a ball, or a point ahead of the agents"
        )

    def no_equilibrium(self, action: float, moved: float) -> str:
        return (
            f"the goal is no equilibrium: on it the controller is {action:.3g} off the holding "
            f"action and the agents move by {moved:.3g} in a step"
        )

    def no_derivative(self) -> str:
        return "the closed loop has no derivative at the goal"

    def no_shield(self) -> str:
        return "shielded: the game has no shield that is on; add --shield, or leave it out."

    def not_zero(self, worst: str, usual: str) -> str:
        return (
            f"V, {self.V}, is {worst} on the target set, where it must be 0 (it is {usual} at a "
            "usual start); take a V that is 0 there, or certificates that do not ask for one, such "
            "as reach."
        )

    def no_rule(self) -> str:
        return (
            "safe: Rendezvous has no rule to break, since it does not replace `violations`; "
            "replace it, as by `crowded`."
        )

    def alone(self) -> str:
        return "apart: a team of one has no two agents; set agents to 2 or more."

    def too_long(self, T: int) -> str:
        fits = f"{T} steps do not fit into an episode of {self.H}"
        return f"contraction: {fits}; take a smaller T."

    def nothing_to_judge(
        self, trials: int, drawn: int, what: str, needed: int, share: float
    ) -> str:
        return (
            f"nothing to judge: {trials} of {drawn} rollouts {what}, and at least "
            f"{needed} are needed to show {100 * share:g} %"
        )

    def negative(self, count: int, drawn: int) -> str:
        return f"V is negative at {count} of {drawn} rollouts, so it is no Lyapunov function"

    def reach(self, bound: float) -> str:
        return f"at least {percent(bound)} of starts end with {self.arrived} at {self.end}"

    def stay(self, bound: float, steps: int) -> str:
        begin = f"at least {percent(bound)} of starts have {self.arrived}"
        return f"{begin} at every step from {self.end} {self.until(steps)}"

    def decrease(self, bound: float, beta: float) -> str:
        by = f"by step {self.H} ({self.end})"
        return (
            f"at least {percent(bound)} of the starts outside the ball come to {self.arrived} "
            f"{by}, and in every step before that V, {self.V}, falls by at least {beta:g} of the "
            f"mean distance beyond {self.ball:g} m"
        )

    def contraction(self, bound: float, beta: float, T: int, floor: float, least: float) -> str:
        of = f"at least {percent(bound)} of the starts whose cost exceeds {floor:g}"
        when = f"over every {T} steps that begin above {floor:g}, {self.until(self.H)}"
        if beta == -math.inf:
            return f"the cost does not contract: all that is known of {of} is that it stays finite"
        if beta <= 0:
            grows = f"it grows by up to {percent(-beta, up=True)}"
            return f"the cost does not contract: on {of} {grows} {when}"
        little = f", which is less than the {100 * least:g} % asked" if beta < least else ""
        return f"on {of} the cost falls by at least {percent(beta)}{little} {when}"

    def basin(self, bound: float, level: float, stay: int, mass: float) -> str:
        return (
            f"at least {percent(bound)} of the starts with V <= {level:.4g} have {self.arrived} at "
            f"every step from {self.end} {self.until(self.H + stay)}, and at least "
            f"{percent(mass)} of all starts are such, with V {self.V}"
        )

    def quantiles(self, q: float, bounds: dict[str, float | None]) -> str:
        return (
            f"each of these is true of at least {100 * q:g} % of starts, {self.until(self.H)}: "
            f"final distance {at_most(bounds['final_distance'], ' m')}; "
            f"settling time {at_most(bounds['settling_time'], ' s')}; "
            f"largest rise {at_most(bounds['largest_rise'], '')} of V, {self.V}"
        )

    def robustness(self, bound: float, count: int) -> str:
        each = f"under each of {count} perturbations at least {percent(bound)}"
        return f"{each} of starts end with {self.arrived} at {self.end}"

    def composition(self, bound: float, rho: float, farthest: float, steps: int) -> str:
        return (
            f"at least {percent(bound)} of starts obey the fitted inequalities between neighbours "
            f"(spectral radius {rho:.3f}) {self.until(steps)}; they pull every distance towards at "
            f"most {farthest:.3g} m as long as they are obeyed, and nothing is said of later steps"
        )

    def no_inequalities(self) -> str:
        return "nothing was contracted: no inequalities with a spectral radius below 1 were found"

    def nothing_contracted(self, above: int, drawn: int, farthest: float) -> str:
        return (
            f"nothing was contracted: {above} of {drawn} rollouts begin above the bound of "
            f"{farthest:.3g} m that the inequalities give, and at least half have to"
        )

    def theorem1(self, bound: float) -> str:
        return (
            f"at least {percent(bound)} of the states met outside the ball, one of each rollout, "
            f"satisfy condition (13) for V, {self.V}; the theorem asks for all of them"
        )
