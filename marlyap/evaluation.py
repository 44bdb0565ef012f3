"""How good is a controller? Fresh starts, deterministic policies, exact intervals."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from marlyap.errors import UserError
from marlyap.game import AbstractGame
from marlyap.rollout import AbstractPlanner, Controller, rollout
from marlyap.seeds import Purpose, stream
from marlyap.statistics import clopper_pearson, mcnemar
from marlyap.types import Key, Keys, Scalar, State, Trajectory


RADII = (0.05, 0.1, 0.15, 0.2, 0.3)  # m, for the success curve
HELD = 5  # steps over which `held` looks back


class Outcome(eqx.Module):
    """What is kept of one episode; a failure to stay finite shows as NaN and counts as failed."""

    final: Scalar  # the worst agent's distance at the last step (m)
    held: Scalar  # the worst distance over the last five steps (m)
    speed: Scalar  # the fastest agent's speed at the last step (m/s)
    settled: Scalar  # the time from which all stay within the radius (s); inf if they do not
    total: Scalar  # return: the undiscounted sum of the team's rewards


def outcome(game: AbstractGame, trajectory: Trajectory) -> Outcome:
    """Judge one episode."""
    distance = jnp.max(jax.vmap(game.distance)(trajectory.state), axis=1)
    last = jax.tree.map(lambda x: x[-1], trajectory.state)
    speed = jnp.linalg.norm(jax.vmap(game.dynamics.velocity)(last.x), axis=1)
    inside = distance <= game.radius
    stays = jnp.cumprod(inside[::-1])[::-1].astype(bool)
    first = jnp.argmax(stays) * game.dt
    return Outcome(
        final=distance[-1],
        held=jnp.max(distance[-HELD:]),
        speed=jnp.max(speed),
        settled=jnp.where(stays[-1], first, jnp.inf),
        total=jnp.sum(jnp.mean(trajectory.reward, axis=1)),
    )


def episode(game: AbstractGame, controller: Controller, key: Key) -> Trajectory:
    """One episode from the start that `key` draws; controllers with the same key share it."""
    k_start, k_act = jax.random.split(key)
    return rollout(game, controller, game.reset(k_start), k_act)


@eqx.filter_jit
def outcomes(game: AbstractGame, controller: Controller, keys: Keys) -> Outcome:
    """One outcome for every key."""
    return jax.vmap(lambda k: outcome(game, episode(game, controller, k)))(keys)


@eqx.filter_jit
def _outcomes_of_each(game: AbstractGame, controllers: Controller, keys: Keys) -> Outcome:
    """The same with a controller for every key."""
    one = lambda controller, k: outcome(game, episode(game, controller, k))
    return eqx.filter_vmap(one)(controllers, keys)


def starts(game: AbstractGame, keys: Keys) -> State:
    """Where the episodes of these keys begin."""
    return jax.vmap(lambda k: game.reset(jax.random.split(k)[0]))(keys)


class Evaluation(eqx.Module):
    """The outcomes of many episodes of one controller, as NumPy arrays of length `episodes`."""

    final: Float[np.ndarray, "episode"]
    held: Float[np.ndarray, "episode"]
    speed: Float[np.ndarray, "episode"]
    settled: Float[np.ndarray, "episode"]
    total: Float[np.ndarray, "episode"]
    radius: float

    @property
    def successes(self) -> Bool[np.ndarray, "episode"]:
        return self.final <= self.radius

    @property
    def success_rate(self) -> float:
        return float(np.mean(self.successes))

    def summary(self, confidence: float = 0.95) -> dict[str, Any]:
        """Plain numbers: rates with exact intervals, distances (m), times (s)."""
        within = [{"radius": r} | share(self.final <= r, confidence) for r in RADII]
        still = self.successes & (self.speed <= 0.1)
        return (
            share(self.successes, confidence)
            | {"confidence": confidence, "radius": self.radius, "radii": within}
            | {"held": share(self.held <= self.radius, confidence)}
            | {"at_rest": share(still, confidence)}
            | {"final_distance": quantiles(self.final), "settling_time": quantiles(self.settled)}
            | {"return_mean": float(np.mean(self.total))}
        )


def evaluate(
    game: AbstractGame,
    controller: Controller | AbstractPlanner,
    episodes: int = 500,
    seed: int = 0,
    purpose: Purpose = "evaluate",
) -> Evaluation:
    """Drive the game from `episodes` fresh starts; the same seed gives the same starts.

    Raises UserError if `episodes` is not positive.
    """
    if not 1 <= episodes <= 10_000_000:
        raise UserError(f"episodes: {episodes} is out of range; take 1 to 10000000.")
    keys = jax.random.split(stream(seed, purpose), episodes)
    if isinstance(controller, AbstractPlanner):
        out = _outcomes_of_each(game, controller.plan(starts(game, keys)), keys)
    else:
        out = outcomes(game, controller, keys)
    return Evaluation(**{k: np.asarray(v) for k, v in vars(out).items()}, radius=game.radius)


def pooled(evaluations: Sequence[Evaluation]) -> Evaluation:
    """The outcomes of several controllers taken together."""
    stack = lambda name: np.concatenate([getattr(e, name) for e in evaluations])
    names = ("final", "held", "speed", "settled", "total")
    return Evaluation(**{n: stack(n) for n in names}, radius=evaluations[0].radius)


def compare(a: Evaluation, b: Evaluation) -> dict[str, Any]:
    """McNemar's exact test on the same starts."""
    only_a, only_b, p = mcnemar(a.successes, b.successes)
    return {"only_a": int(only_a), "only_b": int(only_b), "p_value": float(p)}


def share(hits: Bool[np.ndarray, "episode"], confidence: float) -> dict[str, Any]:
    """How many of the episodes, with the exact Clopper-Pearson interval."""
    k, n = int(np.sum(hits)), len(hits)
    low, high = clopper_pearson(k, n, confidence)
    rate = {"episodes": n, "successes": k, "success_rate": k / n}
    return rate | {"interval": [float(low), float(high)]}


def quantiles(values: Array | np.ndarray) -> dict[str, float | None]:
    """Median, 95 % and largest; None where it is not finite."""
    ordered = np.sort(np.where(np.isnan(values), np.inf, values))
    pick = lambda q: float(ordered[min(int(np.ceil(q * len(ordered))), len(ordered)) - 1])
    return {str(q): (v if np.isfinite(v := pick(q)) else None) for q in (0.5, 0.95, 1.0)}
