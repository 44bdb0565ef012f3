"""C3: the paper's decrease condition without any network: does the cost contract over T steps?"""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from marlyap.certificates.certificate import (
    AbstractCertificate,
    Claim,
    Draw,
    Evidence,
    Found,
    Judgement,
    enough,
    judged,
    of_share,
    passing,
    percent,
    until_step,
)
from marlyap.errors import UserError


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
    """The cost contracts by the share beta over any T steps.

    C3. With the confidence asked for, over the sampling of starts s_0 ~ rho,

        P[ c(s_{t+T}) <= (1 - beta) c(s_t) for all t <= H - T with c(s_t) >= c_min ] >= bound.

    With L the sum of the next T costs, L(s_{t+1}) - L(s_t) = c(s_{t+T}) - c(s_t), so this is the
    decrease of L by beta c that the paper asks for: c is a finite-step Lyapunov function. c_min
    leaves out a ball, for inside it no controller of unicycles can contract at a uniform rate.

    over the starts that have such a t. beta is the largest that passes on one set of rollouts, and
    is then tested on a fresh one. A beta that is not positive is no contraction. What
    the cost does after it has fallen below c_min is for C1' to judge.
    """

    rollouts: int = 10_000  # of the test
    calibration: int = 10_000  # rollouts that choose beta
    T: int = 20  # steps
    c_min: float | None = None  # a cost; None: that at the edge of success
    least: float = 0.01  # a smaller beta is no contraction: in H steps it cannot be told from 0
    share: float = 0.98
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"

    def check(self, loop, seed):
        self.refuse(loop)
        enough(self.rollouts, self.share, self.confidence)
        game, H = loop.game, loop.game.horizon
        draw = lambda purpose, n: judged(self.judge, loop, Draw(seed, purpose, n), H + 1)
        first = draw("calibrate", self.calibration)
        chosen, beta = rates(first)[first.asked], -math.inf
        if len(chosen):
            beta = passing(chosen, self.rollouts, self.share, self.confidence)
        found = draw("certify", self.rollouts)
        rate, floor = rates(found), self.floor(game)
        found = dataclasses.replace(found, holds=found.holds & (rate >= beta), badness=-rate)
        say = lambda bound: claim(bound, beta, self.T, floor, self.least, H, game.dt)
        what = Claim(
            "contraction",
            say,
            H,
            also=beta >= self.least,
            to_judge=f"have a cost above {floor:g} with {self.T} steps to go",
            figures={
                "beta": beta,
                "T": self.T,
                "c_min": floor,
                "rollouts_with_a_window": int(found.asked.sum()),
                "calibration": self.calibration,
            },
        )
        return of_share(self, loop, seed, found, what)

    def refuse(self, loop):
        if self.T > loop.game.horizon:
            raise UserError(
                f"contraction: {self.T} steps do not fit into an episode of {loop.game.horizon}; "
                "take a smaller T."
            )

    def floor(self, game) -> float:
        return game.edge_cost if self.c_min is None else self.c_min

    def judge(self, game, V, trajectory, key):
        c = jnp.mean(trajectory.cost, axis=1)
        now, ahead = c[: game.horizon - self.T + 1], c[self.T : game.horizon + 1]
        asked = now >= self.floor(game)
        beta = 1.0 - ahead / jnp.where(asked, now, 1.0)
        least = jnp.min(jnp.where(asked, beta, jnp.inf))
        figures = {"beta": jnp.minimum(least, 1.0), "windows": jnp.sum(asked).astype(float)}
        return Judgement(jnp.asarray(True), -least, figures, jnp.any(asked))


def rates(found: Found) -> np.ndarray:
    """beta of each rollout; minus infinity where anything was not finite."""
    beta = found.figures["beta"]
    return np.where(found.holds & ~np.isnan(beta), beta, -np.inf)
