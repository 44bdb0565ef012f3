"""C6: does the team still arrive when the game is not quite the one it was made for?"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from marlyap.certificates.certificate import (
    AbstractCertificate,
    Draw,
    Evidence,
    Verdict,
    arrival,
    at_least,
    enough,
    judged,
    limits,
    percent,
    worst_of,
)
from marlyap.certificates.loop import ClosedLoop
from marlyap.certificates.reach import Reach
from marlyap.errors import UserError
from marlyap.games.game import AbstractRegulation
from marlyap.games.perturbed import edge_to_cut, follower_to_lose
from marlyap.statistics import bonferroni
from marlyap.types import Key


def claim(bound: float, count: int, arrived: str, seconds: float, without: dict[str, str]) -> str:
    """`without` says for each perturbation that could not be applied why."""
    left = f" (left out: {listed(without)})" if without else ""
    return (
        f"under each of {count} perturbations{left} at least "
        f"{percent(bound)} of starts end with {arrived} at {seconds:g} s"
    )


def listed(without: dict[str, str]) -> str:
    """What was left out and why: names with the same reason together."""
    reasons: dict[str, list[str]] = {}
    for name, why in without.items():
        reasons.setdefault(why, []).append(name)
    return "; ".join(f"{', '.join(names)}, because {why}" for why, names in reasons.items())


class Robustness(AbstractCertificate):
    """The team is on target at the horizon under each of several perturbations.

    C6. With the confidence asked for, for all perturbations w together, over s_0 ~ rho,

        P[ distance_i(s_H) <= r for every agent i | w ] >= bound_w,

    which is C1 once for every perturbation. It holds if every bound reaches the share asked for;
    the figures are the curve. A perturbation is one fixed change, not the worst of a set. One that
    cannot be applied to this game is left out, and named with the reason.
    """

    rollouts: int = 2_000
    gains: tuple[float, ...] = (0.5, 0.75, 1.5, 2.0)
    noises: tuple[float, ...] = (0.1, 0.3)
    delays: tuple[int, ...] = (1, 2, 3)
    drops: tuple[float, ...] = (0.1, 0.3)
    spreads: tuple[float, ...] = (1.5,)
    remove: bool = True  # whether to take away an agent and an edge
    share: float = 0.9
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"

    def check(self, loop, seed):
        game = loop.game
        loops, without = self.perturbed(loop)
        if not loops:
            raise UserError(f"robustness: no perturbation can be applied ({listed(without)}).")
        each = bonferroni(self.confidence, len(loops))
        enough(self.rollouts, self.share, each)
        points, weakest = [], None
        for name, (change, other) in loops.items():
            point = self.point(other, seed, each)
            points.append({"perturbation": name, "change": change} | point)
            if weakest is None or point["successes"] < weakest["successes"]:
                weakest = points[-1]
        least = min(p["bound"] for p in points)
        disturbance = f"each in turn: {', '.join(loops)}"
        return Verdict(
            name="robustness",
            claim=claim(least, len(points), arrival(game), game.horizon * game.dt, without),
            evidence=self.evidence,
            holds=all(p["holds"] for p in points),
            bound=least,
            confidence=self.confidence,
            scope=limits(game, game.horizon, disturbance),
            trials=self.rollouts * len(points),
            successes=sum(p["successes"] for p in points),
            worst=None if weakest is None else weakest["worst"] | {"change": weakest["change"]},
            figures={
                "share_asked": self.share,
                "confidence_each": each,
                "curve": points,
                "without": without,
            },
        )

    def perturbed(
        self, loop: ClosedLoop
    ) -> tuple[dict[str, tuple[dict[str, Any], ClosedLoop]], dict[str, str]]:
        """The points of the curve that can be tested, and why the others cannot."""
        loops, without = {}, {}
        idle = self.gains and gain_is_idle(loop.game)
        for name, change in self.perturbations(loop.game).items():
            if idle and "gain" in change:
                without[name] = "the inputs of this game do not get stronger by `strengthened`"
                continue
            if "drop" in change and not loop.game.adjacency.any():
                without[name] = "no agent of this game sees another"
                continue
            try:
                loops[name] = change, loop.under(**change)
            except UserError as error:
                without[name] = str(error).partition(": ")[2].rstrip(".")
        return loops, without

    def point(self, loop: ClosedLoop, seed: int, each: float) -> dict[str, Any]:
        """C1 under one perturbation."""
        n, H = self.rollouts, loop.game.horizon
        found = judged(Reach().judge, loop, Draw(seed, "certify", n), H)
        k = int(found.holds.sum())
        bound, holds = at_least(k, n, self.share, each)
        worst = worst_of(loop.game, seed, "certify", found)
        return {"trials": n, "successes": k, "bound": bound, "holds": holds, "worst": worst}

    def perturbations(self, game: AbstractRegulation) -> dict[str, dict[str, Any]]:
        """Name and fields of `Perturbed`, for each point of the curve."""
        curve: dict[str, dict[str, Any]] = {f"gain {x:g}": {"gain": x} for x in self.gains}
        curve |= {f"action noise {x:g}": {"noise": x} for x in self.noises}
        curve |= {f"delay {x} steps": {"delay": x} for x in self.delays}
        curve |= {f"starts {x:g} times as far": {"spread": x} for x in self.spreads}
        if game.agents > 1:
            curve |= {f"messages lost {x:g}": {"drop": x} for x in self.drops}
        lost, edge = follower_to_lose(game), edge_to_cut(game)
        if self.remove and lost is not None:
            curve[f"without agent {lost}"] = {"gone": (lost,)}
        if self.remove and edge is not None:
            curve[f"without edge {edge[0]}-{edge[1]}"] = {"cut": (edge,)}
        return curve


def gain_is_idle(game: AbstractRegulation) -> bool:
    """Whether twice the gain changes nothing in how driven agents move."""
    stronger = game.strengthened(jnp.asarray(2.0))

    def same(key: Key) -> Bool[Array, ""]:
        k_start, k_act = jax.random.split(key)
        state, shape = game.reset(k_start), (game.agents, game.du)
        action = jax.random.uniform(k_act, shape, minval=0.1, maxval=0.4)
        for _ in range(2):  # inputs may act late
            state = game.step(state, action)
        return jnp.all(game.step(state, action).x == stronger.step(state, action).x)

    return bool(jnp.all(jax.vmap(same)(jax.random.split(jax.random.key(0), 8))))
