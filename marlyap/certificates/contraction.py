"""C3: the paper's decrease condition without any network: does the cost contract over T steps?"""

import math
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from marlyap.certificate import (
    AbstractCertificate,
    Evidence,
    Found,
    Judgement,
    Verdict,
    enough,
    judged,
    percent,
    share_of,
    until_step,
)
from marlyap.statistics import lower_bound


def claim(bound: float, beta: float, T: int, c_min: float, least: float, steps: int, dt: float):
    """In words, for any beta: one that is not positive is no contraction, but a bound on growth."""
    of = f"at least {percent(bound)} of the starts whose cost exceeds {c_min:g}"
    when = f"over every {T} steps that begin above {c_min:g}, {until_step(steps, dt)}"
    if beta == -math.inf:
        return f"the cost does not contract: all that is known of {of} is that it stays finite"
    if beta <= 0:
        return (
            f"the cost does not contract: on {of} it grows by up to {percent(-beta, True)} {when}"
        )
    little = f", which is less than the {100 * least:g} % asked" if beta < least else ""
    return f"on {of} the cost falls by at least {percent(beta)}{little} {when}"


class Contraction(AbstractCertificate):
    """C3. With the confidence asked for, over the sampling of starts s_0 ~ rho,

        P[ c(s_{t+T}) <= (1 - beta) c(s_t) for all t <= H - T with c(s_t) >= c_min ] >= bound.

    With L the sum of the next T costs, L(s_{t+1}) - L(s_t) = c(s_{t+T}) - c(s_t), so this is the
    decrease of L by beta c that the paper asks for: c is a finite-step Lyapunov function. c_min
    leaves out a ball, for inside it no controller of unicycles can contract at a uniform rate.

    beta is the largest that passes on one set of rollouts, and is then tested on a fresh one. What
    the cost does after it has fallen below c_min is for C1' to judge.
    """

    rollouts: int = 10_000  # of the test
    calibration: int = 10_000  # rollouts that choose beta
    T: int = 20  # steps
    c_min: float | None = None  # (m); None: the game's radius
    least: float = 0.01  # a smaller beta is no contraction: in H steps it cannot be told from 0
    share: float = 0.98
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"

    def check(self, game, controller, V, seed):
        enough(self.rollouts, self.share, self.confidence)
        H, n = game.horizon, self.rollouts
        first = judged(self.judge, game, controller, V, seed, "calibrate", self.calibration, H + 1)
        beta = self.largest(rates(first))
        found = judged(self.judge, game, controller, V, seed, "certify", n, H + 1)
        passed = rates(found) >= beta
        found = Found(passed, -rates(found), found.figures)
        bound, shown, fields = share_of(self, game, seed, found, H)
        asked = int(np.sum(found.figures["windows"] > 0))
        return Verdict(
            name="contraction",
            claim=claim(bound, beta, self.T, self.floor(game), self.least, H, game.dt),
            **fields,
            holds=shown and beta >= self.least and asked > 0,
            figures={
                "beta": beta,
                "T": self.T,
                "c_min": self.floor(game),
                "share_asked": self.share,
                "rollouts_with_a_window": asked,
                "calibration": self.calibration,
            },
        )

    def floor(self, game) -> float:
        return game.radius if self.c_min is None else self.c_min

    def judge(self, game, V, trajectory, key):
        c = jnp.mean(trajectory.cost, axis=1)
        now, ahead = c[: game.horizon - self.T + 1], c[self.T : game.horizon + 1]
        asked = now >= self.floor(game)
        beta = 1.0 - ahead / jnp.where(asked, now, 1.0)
        least = jnp.min(jnp.where(asked, beta, jnp.inf))
        figures = {"beta": jnp.minimum(least, 1.0), "windows": jnp.sum(asked).astype(float)}
        return Judgement(jnp.asarray(True), -least, figures)

    def largest(self, betas) -> float:
        """The largest beta that leaves a fresh test of the same size room for bad luck."""
        allowed = failures_allowed(self.rollouts, self.share, self.confidence)
        allowed = max(0.0, allowed - 2.5 * math.sqrt(allowed)) / self.rollouts
        return float(np.sort(betas)[int(allowed * len(betas))])


def rates(found: Found) -> np.ndarray:
    """beta of each rollout; minus infinity where anything was not finite."""
    beta = found.figures["beta"]
    return np.where(found.holds & ~np.isnan(beta), beta, -np.inf)


def failures_allowed(trials: int, share: float, confidence: float) -> int:
    """The most failures in `trials` with which the lower bound still reaches `share`."""
    failures = np.arange(trials + 1)
    bounds = np.asarray(lower_bound(trials - failures, trials, confidence))
    return int(np.sum(bounds >= share)) - 1
