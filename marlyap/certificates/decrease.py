"""C2: does V fall along every step until the team has arrived?"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from marlyap.certificates.certificate import (
    AbstractCertificate,
    Claim,
    Draw,
    Evidence,
    Judgement,
    arrival,
    enough,
    judged,
    measured,
    of_share,
    percent,
    until_step,
)
from marlyap.errors import UserError


def claim(bound: float, V: str, beta: float, ball: str, arrived: str, steps: int, dt: float) -> str:
    return (
        f"at least {percent(bound)} of the starts outside the ball come to {arrived} "
        f"{until_step(steps, dt).replace('until', 'by')}, and in every step before that V, {V}, "
        f"falls by at least {beta:g} of the mean distance beyond {ball}"
    )


class Decrease(AbstractCertificate):
    """V falls in every step until the team has arrived.

    C2. With the confidence asked for, over the sampling of starts s_0 ~ rho,

        P[ tau <= H, and V(s_{t+1}) - V(s_t) <= -beta c_rho(s_t) for every t < tau ] >= bound,

    with tau the first time at which the game is in its ball of success, and over the starts outside
    it: a start inside leaves nothing to judge. A rollout that never gets there has failed, however
    V behaves. One rollout is one trial: its transitions depend on each other, so the share of
    transitions that violate is reported without an interval of its own.
    """

    rollouts: int = 10_000
    beta: float = 0.02  # the share of c_rho by which V has to fall in a step
    share: float = 0.98
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"
    asks_V: ClassVar[bool] = True

    def check(self, loop, seed):
        enough(self.rollouts, self.share, self.confidence)
        if not self.beta > 0:
            raise UserError(f"beta: V must fall, so that {self.beta:g} must be more than 0.")
        game, V, H = loop.game, loop.V, loop.game.horizon
        draw = Draw(seed, "certify", self.rollouts)
        found = judged(self.judge, loop, draw, H + V.beyond, uses_V=True)
        steps, bad = (float(np.nansum(found.figures[name])) for name in ("steps", "violations"))
        ball = measured(V.ball, game.unit)
        say = lambda bound: claim(bound, V.meaning, self.beta, ball, arrival(game), H, game.dt)
        figures = {
            "beta": self.beta,
            "V": type(V).__name__,
            "transitions_violating": bad / max(steps, 1.0),
            "entered": int(np.sum(found.figures["entered"] > 0)),
        }
        outside = "begin outside the ball"
        what = Claim("decrease", say, H, to_judge=outside, figures=figures)
        return of_share(self, loop, seed, found, what)

    def judge(self, game, V, trajectory, key):
        H = game.horizon
        inside = jax.vmap(game.success)(jax.tree.map(lambda leaf: leaf[: H + 1], trajectory.state))
        before = jnp.cumsum(inside[:-1]) == 0  # t < tau
        values = V.along(game, trajectory, H + 1)
        cost = jax.vmap(lambda s: V.cost(game, s))(trajectory.state)[:H]
        excess = values[1:] - values[:-1] + self.beta * cost
        excess = jnp.where(jnp.isnan(excess), jnp.inf, excess)
        violated = before & ~(excess <= 0)
        entered = jnp.any(inside)
        worst = jnp.max(jnp.where(before, excess, -jnp.inf))
        badness = jnp.where(entered, worst, jnp.inf)
        figures = {
            "steps": jnp.sum(before).astype(float),
            "violations": jnp.sum(violated).astype(float),
            "entered": entered.astype(float),
        }
        return Judgement(entered & ~jnp.any(violated), badness, figures, jnp.any(before))
