"""C5: bounds that hold for all but a few starts, whatever the distribution."""

import decimal
import math
from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from marlyap.certificates.certificate import (
    AbstractCertificate,
    Draw,
    Evidence,
    Judgement,
    Verdict,
    judged,
    limits,
    no_lyapunov,
    until_step,
    worst_of,
)
from marlyap.errors import UserError
from marlyap.statistics import bonferroni, quantile_upper_bound, trials_needed


NAMES = ("final_distance", "settling_time", "largest_rise")
FLOAT32 = 1e-6  # relative: 0.3 seconds may be 0.30000001


def claim(q: float, bounds: Mapping[str, float], V: str, unit: str, until: str) -> str:
    distance, time, rise = (at_most(bounds[name]) for name in NAMES)
    unit = "tolerances" if unit == "tolerance" else unit
    of, s = (f" {unit}" if distance != "unbounded" else ""), (" s" if time != "unbounded" else "")
    return (
        f"each of these is true of at least {100 * q:g} % of starts, {until}: "
        f"final distance {distance}{of}; settling time {time}{s}; largest rise {rise} of V, {V}"
    )


def at_most(bound: float) -> str:
    """An upper bound to four digits, rounded up; an infinite one is none."""
    if not math.isfinite(bound):
        return "unbounded"
    upward = decimal.Context(prec=4, rounding=decimal.ROUND_CEILING)
    return f"at most {float(upward.create_decimal_from_float(bound * (1 - FLOAT32))):.4g}"


class Quantiles(AbstractCertificate):
    """Quantiles of the final distance, the settling time and the largest rise of V.

    C5. With the confidence asked for, for all three together and over s_0 ~ rho,

        P[ distance at H <= d ] >= q,
        P[ settling time <= t ] >= q,
        P[ largest rise of V <= w ] >= q,

    by order statistics (a tolerance interval). The settling time is the time from which every
    agent is within the radius until H, and infinite if there is none; the largest rise is that of
    V from any earlier to any later state. What is not finite counts as infinite.
    """

    rollouts: int = 10_000
    q: float = 0.95
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"
    asks_V: ClassVar[bool] = True

    def check(self, loop, seed):
        game, V = loop.game, loop.V
        each = bonferroni(self.confidence, len(NAMES))
        needed = trials_needed(1 - self.q, each)
        if self.rollouts < needed:
            raise UserError(
                f"rollouts: {self.rollouts} cannot bound the {self.q:g}-quantile at confidence "
                f"{each:.6g}; at least {needed} are needed."
            )
        H, n = game.horizon, self.rollouts
        draw = Draw(seed, "certify", n)
        found = judged(self.judge, loop, draw, H + V.beyond, uses_V=True)
        sample = {
            name: np.where(found.holds & ~np.isnan(v), v, np.inf)
            for name, v in found.figures.items()
        }
        bounds = {name: quantile_upper_bound(sample[name], self.q, each) for name in NAMES}
        void = no_lyapunov(found)
        return Verdict(
            name="quantiles",
            claim=void or claim(self.q, bounds, V.meaning, game.unit, until_step(H, game.dt)),
            evidence=self.evidence,
            holds=void is None and bool(np.all(np.isfinite(list(bounds.values())))),
            bound=None if void else bounds["final_distance"],
            confidence=self.confidence,
            scope=limits(game, H),
            trials=n,
            worst=worst_of(game, seed, "certify", found),
            figures={"q": self.q, "bounds": bounds, "V": type(V).__name__},
        )

    def judge(self, game, V, trajectory, key):
        H = game.horizon
        states = jax.tree.map(lambda leaf: leaf[: H + 1], trajectory.state)
        distance = jnp.max(jax.vmap(game.distance)(states), axis=1)
        inside = jax.vmap(game.success)(states)
        stays = jnp.cumprod(inside[::-1])[::-1].astype(bool)
        settled = jnp.where(stays[-1], jnp.argmax(stays) * game.dt, jnp.inf)
        values = V.along(game, trajectory, H + 1)
        rise = jnp.max(values - jax.lax.cummin(values))
        figures = {
            "final_distance": distance[-1],
            "settling_time": settled,
            "largest_rise": rise,
        }
        return Judgement(jnp.asarray(True), distance[-1], figures)
