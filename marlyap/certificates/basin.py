"""C4: the largest level set of V from which no rollout failed, confirmed on fresh starts."""

import dataclasses
from typing import ClassVar

import numpy as np

from marlyap.certificates.certificate import (
    AbstractCertificate,
    Claim,
    Draw,
    Evidence,
    Judgement,
    arrival,
    judged,
    no_lyapunov,
    of_share,
    percent,
    until_step,
)
from marlyap.certificates.reach import ReachAndStay
from marlyap.simulation.rollout import until
from marlyap.statistics import bonferroni, clopper_pearson, trials_needed


def claim(
    bound: float,
    V: str,
    level: float,
    arrived: str,
    horizon: int,
    stay: int,
    dt: float,
    mass: float,
) -> str:
    return (
        f"at least {percent(bound)} of the starts with V <= {level:.4g} have {arrived} at every "
        f"step from {horizon * dt:g} s {until_step(horizon + stay, dt)}, and at least "
        f"{percent(mass)} of all starts are such, with V {V}"
    )


class Basin(AbstractCertificate):
    """A level set of V from which the team reaches the target set and stays.

    C4. v is the largest level without a failure below it in one set of rollouts. Then, on a
    fresh set and with the confidence asked for,

        P[ reach and stay | V(s_0) <= v ] >= bound   and   P[ V(s_0) <= v ] in `mass`,

    with s_0 ~ rho. The fresh starts that fall into the level set are independent draws of rho
    conditioned on it (rejection), so the first bound is exact. Reach and stay is that of C1'.
    """

    rollouts: int = 10_000  # fresh starts, of which those in the level set count
    calibration: int = 10_000  # rollouts that choose v
    stay: int = 40  # steps that have to be stayed
    share: float = 0.98
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"
    asks_V: ClassVar[bool] = True

    def check(self, loop, seed):
        game, V, n = loop.game, loop.V, self.rollouts
        steps = game.horizon + max(self.stay, V.beyond)
        each = bonferroni(self.confidence, 2)
        draw = lambda purpose, n: judged(
            self.judge, loop, Draw(seed, purpose, n), steps, uses_V=True
        )
        first, found = draw("calibrate", self.calibration), draw("certify", n)
        level = largest_level(first.figures["V"], first.holds)
        found = dataclasses.replace(found, asked=found.figures["V"] <= level)
        m = int(found.asked.sum())
        mass = clopper_pearson(m, n, each)
        say = lambda bound: claim(
            bound,
            V.meaning,
            level,
            arrival(game),
            game.horizon,
            self.stay,
            game.dt,
            float(mass.low),
        )
        what = Claim(
            "basin",
            say,
            game.horizon + self.stay,
            confidence=each,
            void=no_lyapunov(first, found),
            to_judge=f"begin with V <= {level:.4g}, below the least V of a failure",
            scope={"starts_with": f"V <= {level:.6g}"},
            figures={
                "level": level,
                "mass": [mass.low, mass.high],
                "needed_inside": trials_needed(1 - self.share, each),
                "stay_steps": self.stay,
                "V": type(V).__name__,
                "failures_calibrating": int((~first.holds).sum()),
            },
        )
        return of_share(self, loop, seed, found, what)

    def judge(self, game, V, trajectory, key):
        seen = until(trajectory, game.horizon + self.stay)
        found = ReachAndStay(stay=self.stay).judge(game, V, seen, key)
        value = V.along(game, trajectory, 1)[0]
        return Judgement(found.holds, found.badness, {"V": value})


def largest_level(values: np.ndarray, holds: np.ndarray) -> float:
    """The largest V among the successes below every failure; minus infinity if there is none.

    A start with V that is not finite lies in no level set.
    """
    known = np.isfinite(values)
    failing = np.min(values[known & ~holds], initial=np.inf)
    below = values[known & holds & (values < failing)]
    return float(np.max(below, initial=-np.inf))
