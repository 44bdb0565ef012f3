"""The seam of every certificate: what is claimed, on what evidence, and the worst case found.

A sampled certificate judges whole rollouts from fresh, independent starts: one rollout is one
trial, and a rollout in which anything is not finite has failed. A rollout that leaves nothing to
judge is no trial. Bounds are exact (Clopper-Pearson).
"""

import abc
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from marlyap.certificates.loop import ClosedLoop
from marlyap.certificates.lyapunov import AbstractLyapunov, measured as measured
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame, AbstractRegulation
from marlyap.games.wrapper import plain_game as plain_game
from marlyap.seeds import Purpose, stream
from marlyap.simulation.rollout import Controller, all_finite, rollout, until
from marlyap.statistics import lower_bound, trials_needed
from marlyap.storage.hashing import as_json
from marlyap.types import Key, Scalar, State, Trajectory


Evidence = Literal["proved", "statistical", "observed"]
CHUNK = 500_000  # agent-steps that are in memory at once
ROUNDING = 1e-5  # of V in float32, relative to its usual size


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What one certificate found. `holds` is never more than its claim, evidence and scope say."""

    name: str
    claim: str  # in words
    evidence: Evidence
    holds: bool
    bound: float | None  # what is claimed of the quantity in the claim
    confidence: float | None  # over the sampling; None where nothing was sampled
    scope: dict[str, Any]  # start distribution, horizon, disturbance
    trials: int | None = None
    successes: int | None = None
    worst: dict[str, Any] | None = None  # a start that can be replayed, and its state
    figures: dict[str, Any] = dataclasses.field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON values; what is not finite is null."""
        return as_json(dataclasses.asdict(self))


def percent(share: float, up: bool = False) -> str:
    """A share as "99.87 %", rounded so that "at least" (or, `up`, "at most") stays true of it."""
    whole = math.ceil(1e4 * share - 1e-6) if up else math.floor(1e4 * share + 1e-6)
    return f"{whole / 100:.2f} %"


def until_step(steps: int, dt: float) -> str:
    """How far a finite rollout saw, such as "until step 80 (8 s)"."""
    return f"until step {steps} ({steps * dt:g} s)"


def sentence(verdict: Verdict) -> str:
    """The claim, what was asked, what was shown, and whether that is enough.

    A claim that fails for another reason than the share says which, and is not "not reached".
    """
    asked, shown = verdict.figures.get("share_asked"), verdict.bound
    said = f"{verdict.name}: {verdict.claim}"
    if asked is None or shown is None or verdict.holds != (shown >= asked):
        return f"{said}: {'holds' if verdict.holds else 'does not hold'}."
    sure = "" if verdict.confidence is None else f" (confidence {percent(verdict.confidence)})"
    answer = "reached" if verdict.holds else "not reached"
    return f"{said}. Asked {100 * asked:g} %, shown {percent(shown)}{sure}: {answer}."


class Judgement(eqx.Module):
    """What a certificate makes of one rollout."""

    holds: Bool[Array, ""]
    badness: Scalar  # larger is worse; it picks the worst case
    figures: dict[str, Array]
    asked: Bool[Array, ""] | None = None  # whether there was anything to judge; None: always


@dataclasses.dataclass(frozen=True)
class Found:
    """The judgements of many rollouts, as NumPy arrays."""

    holds: np.ndarray
    badness: np.ndarray
    figures: dict[str, np.ndarray]
    asked: np.ndarray  # whether the rollout is a trial; one that is not finite always is
    lowest: np.ndarray  # V along the rollout; 0 for a certificate that does not use it
    largest: np.ndarray

    @property
    def negative(self) -> int:
        """Along how many rollouts V is negative, by more than rounding at its usual size."""
        usual = np.median(self.largest[np.isfinite(self.largest)]) if len(self.largest) else 0.0
        return int(np.sum(self.lowest < -ROUNDING * usual))


class AbstractCertificate(eqx.Module):
    """The fields of a subclass say how much is asked: counts, region, confidence."""

    confidence: eqx.AbstractVar[float]
    evidence: eqx.AbstractClassVar[Evidence]
    asks_V: ClassVar[bool] = False  # whether V is part of what is claimed

    def refuse(self, loop: ClosedLoop) -> None:
        """Raise UserError where this certificate is not about such a game, controller or V."""

    @abc.abstractmethod
    def check(self, loop: ClosedLoop, seed: int) -> Verdict:
        """Judge one controller. It does not raise when the controller fails.

        Raises UserError as `refuse` does, and for fields that cannot show what is asked.
        """


class Draw(NamedTuple):
    """Which rollouts: the seed, the stream of it, and how many."""

    seed: int
    purpose: Purpose
    rollouts: int


@dataclasses.dataclass(frozen=True)
class Claim:
    """What is claimed of a share of the trials, before that share is bounded."""

    name: str
    say: Callable[[float], str]  # the sentence, given the bound
    steps: int  # how far a rollout is judged
    to_judge: str = "leave something to judge"  # what a trial does, in words
    confidence: float | None = None  # of this bound, where it is not the certificate's
    void: str | None = None  # why nothing can be bounded, if so
    also: bool = True  # what else has to be true for the claim to hold
    evidence: Evidence = "statistical"
    scope: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # to be added
    figures: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # to be added


# The key is for what a certificate draws itself, such as one time of the rollout.
Judge = Callable[[AbstractRegulation, AbstractLyapunov, Trajectory, Key], Judgement]


@eqx.filter_jit
def _roll(
    game: AbstractRegulation, controller: Controller, key: Key, indices: Any, steps: int
) -> Trajectory:
    def one(index: Array) -> Trajectory:
        k_start, k_act = jax.random.split(jax.random.fold_in(key, index))
        return rollout(game, controller, game.reset(k_start), k_act, steps)

    return jax.vmap(one)(indices)


@eqx.filter_jit
def _judge(
    judge: Judge,
    game: AbstractRegulation,
    V: AbstractLyapunov,
    seen: Trajectory,
    key: Key,
    indices: Any,
    steps: int,
    uses_V: bool,
) -> dict[str, Any]:
    def one(trajectory: Trajectory, index: Array) -> dict[str, Any]:
        trajectory = until(trajectory, steps)
        own = jax.random.fold_in(jax.random.fold_in(key, index), 2)
        found, sound = judge(game, V, trajectory, own), all_finite(trajectory)
        # The last states have too few after them for a V that looks ahead.
        values = V.along(game, trajectory, steps + 1 - V.beyond) if uses_V else jnp.zeros(1)
        return {
            "holds": found.holds & sound,
            "badness": jnp.where(sound & ~jnp.isnan(found.badness), found.badness, jnp.inf),
            "figures": found.figures,
            "asked": jnp.asarray(True) if found.asked is None else found.asked | ~sound,
            "lowest": jnp.min(values),
            "largest": jnp.max(jnp.abs(values)),
        }

    return jax.vmap(one)(seen, indices)


def judged(judge: Judge, loop: ClosedLoop, draw: Draw, steps: int, uses_V: bool = False) -> Found:
    """`judge` of the rollouts of a draw, each of `steps` steps, as NumPy arrays.

    With `uses_V` V is also held to V >= 0 in every state of every rollout (`Found.negative`).

    They are rolled in chunks, so that memory does not grow with their number, and for a whole
    number of horizons, so that certificates share what was compiled; the judge sees `steps` steps.
    """
    game, (seed, purpose, count) = loop.game, draw
    long = math.ceil(steps / game.horizon) * game.horizon
    size = max(1, min(count, 1000, CHUNK // (game.agents * (long + 1))))
    key, parts = stream(seed, purpose), []
    for first in range(0, count, size):
        indices = np.arange(first, first + size)
        seen = _roll(game, loop.controller, key, indices, long)
        found = _judge(judge, game, loop.V, seen, key, indices, steps, uses_V)
        parts.append(jax.tree.map(np.asarray, found))
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)
    return Found(**joined)


def start_of(game: AbstractRegulation, seed: int, purpose: Purpose, episode: int) -> State:
    """The start of one rollout: what a verdict's worst case names."""
    return _start(game, stream(seed, purpose), np.asarray(episode))


@eqx.filter_jit
def _start(game: AbstractRegulation, key: Key, episode: Any) -> State:
    k_start, _ = jax.random.split(jax.random.fold_in(key, episode))
    return game.reset(k_start)


def worst_of(
    game: AbstractRegulation, seed: int, purpose: Purpose, found: Found, among: Any = None
) -> dict[str, Any]:
    """The rollout that failed worst, or came closest to failing, as a start to replay."""
    rivals = np.ones(len(found.holds), bool) if among is None else among
    if (rivals & ~found.holds).any():
        rivals = rivals & ~found.holds
    badness = np.clip(found.badness.astype(float), -1e29, 1e29)
    episode = int(np.argmax(np.where(rivals, badness, -np.inf)))
    start = start_of(game, seed, purpose, episode)
    figures = {name: float(np.asarray(values)[episode]) for name, values in found.figures.items()}
    return {
        "seed": seed,
        "purpose": purpose,
        "episode": episode,
        "failed": not bool(found.holds[episode]),
        "badness": float(found.badness[episode]),
        "state": as_json({"x": start.x, "scenario": start.scenario}),
        "figures": figures,
    }


def enough(rollouts: int, share: float, confidence: float, what: str = "rollouts") -> None:
    """Raise UserError unless `rollouts` without a failure could show the share asked for."""
    needed = trials_needed(1.0 - share, confidence)
    if rollouts < needed:
        raise UserError(
            f"{what}: {rollouts} cannot show a share of {share:g} at confidence {confidence:.6g}; "
            f"at least {needed} are needed, and more if any fails."
        )


def at_least(successes: int, trials: int, share: float, confidence: float) -> tuple[float, bool]:
    """The exact lower bound on the probability of success, and whether it reaches `share`."""
    if trials == 0:
        return 0.0, False
    bound = float(lower_bound(successes, trials, confidence))
    return bound, bound >= share


def failures_allowed(trials: int, share: float, confidence: float) -> int:
    """The most failures in `trials` with which the lower bound still reaches `share`."""
    failures = np.arange(trials + 1)
    bounds = np.asarray(lower_bound(trials - failures, trials, confidence))
    return int(np.sum(bounds >= share)) - 1


def passing(values: np.ndarray, rollouts: int, share: float, confidence: float) -> float:
    """The largest level that `values` of one set of rollouts pass, with room for bad luck.

    It is to be tested on `rollouts` fresh ones, of which `share` has to be shown to lie above it.
    """
    allowed = failures_allowed(rollouts, share, confidence)
    allowed = max(0.0, allowed - 2.5 * math.sqrt(allowed)) / rollouts
    return float(np.sort(values)[int(allowed * len(values))])


def no_lyapunov(*founds: Found) -> str | None:
    """One sentence if V was negative somewhere, which no Lyapunov function is; else None."""
    negative, drawn = sum(f.negative for f in founds), sum(len(f.holds) for f in founds)
    if not negative:
        return None
    return f"V is negative at {negative} of {drawn} rollouts, so it is no Lyapunov function"


def of_share(certificate: Any, loop: ClosedLoop, seed: int, found: Found, claim: Claim) -> Verdict:
    """The verdict that a share of the trials holds: bound, exact, at the share asked for.

    The trials are the rollouts that leave something to judge. Where they are too few for the share
    that is said instead of the claim. So is a negative V, or the reason that the claim is void:
    then nothing is bounded, and the bound is None.

    Arguments: certificate, with fields share and confidence; seed, of the rollouts found.
    """
    each = certificate.confidence if claim.confidence is None else claim.confidence
    n, k = int(found.asked.sum()), int((found.holds & found.asked).sum())
    bound, shown = at_least(k, n, certificate.share, each)
    void = claim.void or no_lyapunov(found)
    needed, said = trials_needed(1.0 - certificate.share, each), void or claim.say(bound)
    if void is None and n < needed:
        said = (
            f"nothing to judge: {n} of {len(found.holds)} rollouts {claim.to_judge}, and at least "
            f"{needed} are needed to show {100 * certificate.share:g} %"
        )
    return Verdict(
        name=claim.name,
        claim=said,
        evidence=claim.evidence,
        holds=void is None and shown and claim.also,
        bound=bound if void is None else None,
        confidence=certificate.confidence,
        scope=limits(loop.game, claim.steps) | dict(claim.scope),
        trials=n,
        successes=k,
        worst=worst_of(loop.game, seed, "certify", found, found.asked) if n else None,
        figures={"share_asked": certificate.share, "drawn": len(found.holds)} | dict(claim.figures),
    )


def arrival(game: AbstractGame) -> str:
    """`game.success` in words, also where a task has a definition of its own."""
    game = plain_game(game)
    if type(game).success is AbstractGame.success:
        return arrived(game.edge, game.unit)
    return f"success as {type(game).__name__}.success defines it"


def arrived(edge: float, unit: str) -> str:
    """Success of a game that replaces nothing."""
    if unit == "tolerance" and edge == 1.0:
        return "every error within its tolerance"
    return f"every agent within {measured(edge, unit)} of its {'goal' if unit == 'm' else 'target'}"


def limits(game: AbstractGame, steps: int, disturbance: str = "none") -> dict[str, Any]:
    """What a sampled claim is limited to."""
    return {
        "starts": f"the starts that {type(game).__name__}.reset draws",
        "horizon_steps": steps,
        "horizon_seconds": steps * game.dt,
        "disturbance": disturbance,
        "edge": game.edge,
        "unit": game.unit,
    }
