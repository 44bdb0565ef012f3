"""C1 and C1': does the team arrive, and does it stay?"""

from typing import ClassVar

import jax
import jax.numpy as jnp

from marlyap.certificates.certificate import (
    AbstractCertificate,
    Claim,
    Draw,
    Evidence,
    Judgement,
    arrival,
    enough,
    judged,
    of_share,
    percent,
    until_step,
)


def claim(bound: float, arrived: str, seconds: float) -> str:
    return f"at least {percent(bound)} of starts end with {arrived} at {seconds:g} s"


def claim_stay(bound: float, arrived: str, horizon: int, steps: int, dt: float) -> str:
    return (
        f"at least {percent(bound)} of starts have {arrived} at every step from {horizon * dt:g} s "
        f"{until_step(steps, dt)}"
    )


class Reach(AbstractCertificate):
    """The team is on target at the horizon.

    C1. With the confidence asked for, over the sampling of starts s_0 ~ rho,

        P[ distance_i(s_H) <= r for every agent i ] >= bound,

    with H the game's horizon and r its radius. It says nothing of what happens after H.
    """

    rollouts: int = 10_000
    share: float = 0.98  # the probability that has to be shown
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"

    def check(self, loop, seed):
        enough(self.rollouts, self.share, self.confidence)
        game, H = loop.game, loop.game.horizon
        found = judged(self.judge, loop, Draw(seed, "certify", self.rollouts), H)
        say = lambda bound: claim(bound, arrival(game), H * game.dt)
        return of_share(self, loop, seed, found, Claim("reach", say, H))

    def judge(self, game, V, trajectory, key):
        last = jax.tree.map(lambda leaf: leaf[-1], trajectory.state)
        distance = jnp.max(game.distance(last))
        return Judgement(game.success(last), distance, {"final_distance": distance})


class ReachAndStay(AbstractCertificate):
    """The team arrives by the horizon and stays.

    C1'. With the confidence asked for, over the sampling of starts s_0 ~ rho,

        P[ there is tau <= H: distance_i(s_t) <= r for all i and tau <= t <= H + S ] >= bound,

    which is to be inside at every step from H to H + S. It says nothing of what comes after H + S.
    """

    rollouts: int = 10_000
    stay: int = 40  # S, steps
    share: float = 0.98
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"

    def check(self, loop, seed):
        enough(self.rollouts, self.share, self.confidence)
        game, steps = loop.game, loop.game.horizon + self.stay
        found = judged(self.judge, loop, Draw(seed, "certify", self.rollouts), steps)
        say = lambda bound: claim_stay(bound, arrival(game), game.horizon, steps, game.dt)
        what = Claim("reach-and-stay", say, steps, figures={"stay_steps": self.stay})
        return of_share(self, loop, seed, found, what)

    def judge(self, game, V, trajectory, key):
        late = jax.tree.map(lambda leaf: leaf[game.horizon :], trajectory.state)
        farthest = jnp.max(jax.vmap(game.distance)(late))
        inside = jnp.all(jax.vmap(game.success)(late))
        return Judgement(inside, farthest, {"farthest": farthest})
