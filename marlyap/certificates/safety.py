"""Does the team keep to the rules of its game, and its agents apart?"""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from marlyap.certificates.certificate import (
    AbstractCertificate,
    Claim,
    Draw,
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
from marlyap.types import State


def claim_safe(bound: float, game: str, rules: tuple[str, ...], steps: int, dt: float) -> str:
    """`rules` are those of `violations` and `failed` that the game replaces."""
    broken = f"no agent breaks a rule of {game} (its `violations`)"
    failed = f"{'nothing' if 'violations' in rules else f'no team of {game}'} fails (its `failed`)"
    parts = {"violations": broken, "failed": failed}
    never = " and ".join(parts[rule] for rule in rules)
    return f"on at least {percent(bound)} of starts {never} at any step {until_step(steps, dt)}"


def claim_apart(bound: float, gap: float, least: float, steps: int, dt: float) -> str:
    little = f", which is less than the {least:g} m asked" if gap < least else ""
    return (
        f"on at least {percent(bound)} of starts no two agents come closer than {gap:g} m"
        f"{little}, at any step {until_step(steps, dt)}"
    )


class Safe(AbstractCertificate):
    """No agent violates a rule of the game, and nothing fails.

    With the confidence asked for, over the sampling of starts s_0 ~ rho,

        P[ no agent violates a rule and the team has not failed in s_t, for all t <= H + S ] >=
        bound,

    with `game.violations` the rules and `game.failed` the failures, whichever the game has. It says
    nothing of what comes after H + S.
    """

    rollouts: int = 10_000
    stay: int = 40  # S, steps
    share: float = 0.98
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"

    def refuse(self, loop):
        game, name = loop.game, type(plain_game(loop.game)).__name__
        if not has_rules(game):
            raise UserError(
                f"safe: {name} has no rule to break, since it does not replace `violations`; "
                "replace it, as by `crowded`."
            )
        if not can_fire(game):
            raise UserError(
                f"safe: the `{rules(game)[0]}` of {name} never fire, not even with all agents in "
                "one place or far out; set what they depend on, such as clearance."
            )

    def check(self, loop, seed):
        self.refuse(loop)
        enough(self.rollouts, self.share, self.confidence)
        game, name = loop.game, type(plain_game(loop.game)).__name__
        steps = game.horizon + self.stay
        found = judged(self.judge, loop, Draw(seed, "certify", self.rollouts), steps)
        say = lambda bound: claim_safe(bound, name, rules(game), steps, game.dt)
        what = Claim("safe", say, steps, figures={"stay_steps": self.stay})
        return of_share(self, loop, seed, found, what)

    def judge(self, game, V, trajectory, key):
        broken = jax.vmap(lambda s: is_broken(game, s))(trajectory.state)
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

    def refuse(self, loop):
        game = loop.game
        if (
            eqx.filter_eval_shape(lambda key: game.scene(game.reset(key)), jax.random.key(0))
            is None
        ):
            raise UserError(
                f"apart: {type(plain_game(game)).__name__} has no map, so that its agents have no "
                "distance; return a Scene from `scene`, or leave out apart."
            )
        if game.agents < 2:
            raise UserError("apart: a team of one has no two agents; set agents to 2 or more.")

    def check(self, loop, seed):
        self.refuse(loop)
        enough(self.rollouts, self.share, self.confidence)
        game, steps = loop.game, loop.game.horizon + self.stay
        draw = lambda purpose, n: judged(self.judge, loop, Draw(seed, purpose, n), steps)
        first, found = draw("calibrate", self.calibration), draw("certify", self.rollouts)
        gaps = np.where(first.holds, first.figures["gap"], 0.0)
        # To 0.1 mm, rounded down: the claim says what is tested.
        d = passing(gaps, self.rollouts, self.share, self.confidence)
        d = float(np.floor(d * 1e4) / 1e4)
        found = dataclasses.replace(found, holds=found.holds & (found.figures["gap"] >= d))
        say = lambda bound: claim_apart(bound, d, self.least, steps, game.dt)
        figures = {"gap": d, "stay_steps": self.stay, "calibration": self.calibration}
        what = Claim("apart", say, steps, also=d >= self.least, figures=figures)
        return of_share(self, loop, seed, found, what)

    def judge(self, game, V, trajectory, key):
        p = jax.vmap(game.positions)(trajectory.state)
        apart = jnp.linalg.norm(p[:, :, None] - p[:, None], axis=-1)
        apart = jnp.where(jnp.eye(game.agents, dtype=bool)[None], jnp.inf, apart)
        gap = jnp.min(apart)
        return Judgement(jnp.asarray(True), -gap, {"gap": gap})


def rules(game: AbstractGame) -> tuple[str, ...]:
    """Which of `violations` and `failed` the game replaces: what `safe` is about."""
    kind = type(plain_game(game))
    own = lambda name: getattr(kind, name) is not getattr(AbstractGame, name)
    return tuple(name for name in ("violations", "failed") if own(name))


def has_rules(game: AbstractGame) -> bool:
    """Whether the game has violations or failures of its own."""
    return bool(rules(game))


def is_broken(game: AbstractGame, state: State) -> Bool[Array, ""]:
    """Whether an agent breaks a rule in this state, or the team has failed."""
    return jnp.any(game.violations(state)) | game.failed(state)


def can_fire(game: AbstractGame) -> bool:
    """Whether a rule is broken anywhere: at starts, all in one place, far out, or very fast."""

    def one(key):
        start = game.reset(key)
        at = lambda x: is_broken(game, eqx.tree_at(lambda s: s.x, start, x))
        together = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), start.x)
        far = lambda size: jax.tree.map(lambda x: size * (x + 1.0), start.x)
        return at(together) | jnp.any(jax.vmap(lambda size: at(far(size)))(10.0 ** jnp.arange(5)))

    return bool(jnp.any(jax.vmap(one)(jax.random.split(jax.random.key(0), 64))))
