"""Does the team keep to the rules of its game, and its agents apart?"""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap.certificates.certificate import (
    AbstractCertificate,
    Evidence,
    Judgement,
    enough,
    judged,
    of_share,
    passing,
    percent,
    plain_game,
    until_step,
)
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame


def claim_safe(bound: float, game: str, steps: int, dt: float) -> str:
    return (
        f"on at least {percent(bound)} of starts no agent breaks a rule of {game} "
        f"(its `violations`) at any step {until_step(steps, dt)}"
    )


def claim_apart(bound: float, gap: float, least: float, steps: int, dt: float) -> str:
    little = f", which is less than the {least:g} m asked" if gap < least else ""
    return (
        f"on at least {percent(bound)} of starts no two agents come closer than {gap:g} m"
        f"{little}, at any step {until_step(steps, dt)}"
    )


class Safe(AbstractCertificate):
    """No agent violates a rule of the game.

    With the confidence asked for, over the sampling of starts s_0 ~ rho,

        P[ no agent violates a rule of the game in s_t, for all t <= H + S ] >= bound,

    with `game.violations` the rules. It says nothing of what comes after H + S.
    """

    rollouts: int = 10_000
    stay: int = 40  # S, steps
    share: float = 0.98
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"

    def refuse(self, game, controller, V):
        name = type(plain_game(game)).__name__
        if not has_rules(game):
            raise UserError(
                f"safe: {name} has no rule to break, since it does not replace `violations`; "
                "replace it, as by `crowded`."
            )
        if not can_fire(game):
            raise UserError(
                f"safe: the `violations` of {name} never fire, not even with all agents in one "
                "place or far out; set what they depend on, such as clearance."
            )

    def check(self, game, controller, V, seed):
        self.refuse(game, controller, V)
        enough(self.rollouts, self.share, self.confidence)
        steps, name = game.horizon + self.stay, type(plain_game(game)).__name__
        found = judged(self.judge, game, controller, V, seed, "certify", self.rollouts, steps)
        say = lambda bound: claim_safe(bound, name, steps, game.dt)
        figures = {"stay_steps": self.stay}
        return of_share(self, game, V, seed, found, steps, say, name="safe", figures=figures)

    def judge(self, game, V, trajectory, key):
        broken = jnp.any(jax.vmap(game.violations)(trajectory.state), axis=1)
        steps = jnp.sum(broken).astype(float)
        return Judgement(~jnp.any(broken), steps, {"steps_in_violation": steps})


class Apart(AbstractCertificate):
    """Agents keep a distance d from each other.

    With the confidence asked for, over the sampling of starts s_0 ~ rho,

        P[ |p_i - p_j| >= d for all agents i != j in s_t, for all t <= H + S ] >= bound.

    d is the largest that passes on one set of rollouts, and is then tested on a fresh one.
    """

    rollouts: int = 10_000  # of the test
    calibration: int = 10_000  # rollouts that choose d
    stay: int = 40  # S, steps
    least: float = 0.01  # a smaller d is not worth claiming (m)
    share: float = 0.98
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"

    def refuse(self, game, controller, V):
        if game.agents < 2:
            raise UserError("apart: a team of one has no two agents; set agents to 2 or more.")

    def check(self, game, controller, V, seed):
        self.refuse(game, controller, V)
        enough(self.rollouts, self.share, self.confidence)
        steps = game.horizon + self.stay
        draw = lambda purpose, count: judged(
            self.judge, game, controller, V, seed, purpose, count, steps
        )
        first, found = draw("calibrate", self.calibration), draw("certify", self.rollouts)
        gaps = np.where(first.holds, first.figures["gap"], 0.0)
        # To 0.1 mm, rounded down: the claim says what is tested.
        d = passing(gaps, self.rollouts, self.share, self.confidence)
        d = float(np.floor(d * 1e4) / 1e4)
        found = dataclasses.replace(found, holds=found.holds & (found.figures["gap"] >= d))
        say = lambda bound: claim_apart(bound, d, self.least, steps, game.dt)
        return of_share(
            self,
            game,
            V,
            seed,
            found,
            steps,
            say,
            name="apart",
            also=d >= self.least,
            figures={"gap": d, "stay_steps": self.stay, "calibration": self.calibration},
        )

    def judge(self, game, V, trajectory, key):
        p = jax.vmap(game.positions)(trajectory.state)
        apart = jnp.linalg.norm(p[:, :, None] - p[:, None], axis=-1)
        apart = jnp.where(jnp.eye(game.agents, dtype=bool)[None], jnp.inf, apart)
        gap = jnp.min(apart)
        return Judgement(jnp.asarray(True), -gap, {"gap": gap})


def has_rules(game: AbstractGame) -> bool:
    """Whether the game has violations of its own."""
    return type(plain_game(game)).violations is not AbstractGame.violations


def can_fire(game: AbstractGame) -> bool:
    """Whether a rule is broken anywhere: at starts, all in one place, far out, or very fast."""

    def one(key):
        start = game.reset(key)
        at = lambda x: jnp.any(game.violations(eqx.tree_at(lambda s: s.x, start, x)))
        together = jnp.broadcast_to(start.x[:1], start.x.shape)
        sizes = 10.0 ** jnp.arange(5)
        return at(together) | jnp.any(jax.vmap(lambda size: at(size * (start.x + 1.0)))(sizes))

    return bool(jnp.any(jax.vmap(one)(jax.random.split(jax.random.key(0), 64))))
