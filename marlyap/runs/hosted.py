"""Runs on games outside JAX: their policies measured and filmed where they were trained."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from scipy.special import stdtrit

from marlyap.errors import UserError
from marlyap.learning.host_trainer import played_by
from marlyap.learning.hosted import Hosted
from marlyap.runs.run import Run, expand
from marlyap.simulation.rollout import Policy
from marlyap.statistics import clopper_pearson
from marlyap.storage import store


COPIES = 16  # played side by side, whatever the run was trained with


def outside(words: Iterable[Path | str]) -> bool:
    """Whether these runs are of games outside JAX; words that are no runs are not.

    Raises UserError where some are and some are not.
    """
    places = [p for word in words if Path(word).exists() for p in expand([word])]
    found = [_kind(p) == "Hosted" for p in places]
    if any(found) and not all(found):
        raise UserError(
            "run: some of these runs are of games outside JAX and some are not; name them in two "
            "commands."
        )
    return any(found)


def _kind(place: Path) -> str:
    try:
        about = store.read_json(place / "run.json")
    except UserError:  # whoever opens it says more
        return ""
    task = about.get("task") if isinstance(about, dict) else None
    return str(task.get("kind", "")) if isinstance(task, dict) else ""


@dataclass(frozen=True)
class HostEvaluation:
    """What a policy did in so many episodes of a game outside JAX."""

    returns: np.ndarray  # [episode agent], undiscounted
    success: np.ndarray  # [episode], nan where the game does not say

    def summary(self, confidence: float = 0.95) -> dict[str, Any]:
        """Means over episodes; success where the game says so of every episode.

        The interval of the return is Student's, that of the success rate is exact.
        """
        each = self.returns.mean(axis=1)
        told: dict[str, Any] = {"episodes": len(each), "return_mean": float(each.mean())}
        if len(each) > 1:
            half = (
                stdtrit(len(each) - 1, (1 + confidence) / 2) * each.std(ddof=1) / len(each) ** 0.5
            )
            told["return_interval"] = [float(each.mean() - half), float(each.mean() + half)]
            told["confidence"] = confidence
        told["return_of_agents"] = self.returns.mean(axis=0).tolist()
        if np.isfinite(self.success).all():
            hits, n = int(self.success.sum()), len(self.success)
            rate = clopper_pearson(hits, n, confidence)
            told |= {"successes": hits, "success_rate": hits / n}
            told["interval"] = [float(rate[0]), float(rate[1])]
        return told


def actor(policy: Policy) -> Callable[[np.ndarray], np.ndarray]:
    """The policy for all copies at once, compiled: observations to actions, in NumPy."""
    leaves, static = eqx.partition(policy, eqx.is_array)
    key = jax.random.key(0)  # a deployed policy draws nothing

    @jax.jit
    def act(leaves, obs):
        return jax.vmap(lambda o: eqx.combine(leaves, static)(o, key))(obs)

    return lambda obs: np.asarray(act(leaves, obs))


def evaluate_hosted(run: Run, episodes: int = 500, seed: int = 0) -> HostEvaluation:
    """The run's policy in so many episodes that it was not trained on.

    Arguments: run, of a game outside JAX; episodes, at least 1; seed, of the episodes. The same
    seed gives the same episodes, as far as the environment follows its seed.
    Raises UserError where the game cannot be made, or does what no game may do.
    """
    if episodes < 1:
        raise UserError(f"episodes: {episodes} is too few; take at least 1.")
    game: Hosted = run.trainer.game
    with game.open(min(COPIES, episodes)) as copies:
        found = list(played_by(copies, actor(run.deployed()[0]), seed, episodes))
    return HostEvaluation(np.array([r for r, _ in found]), np.array([s for _, s in found]))


def frames(run: Run, seed: int = 0, episode: int = 0, most: int = 1000) -> Sequence[np.ndarray]:
    """One episode as the environment draws it, uint8 [height width 3] each.

    Raises UserError where it does not draw.
    """
    game: Hosted = run.trainer.game
    act, found = actor(run.deployed()[0]), list[np.ndarray]()
    with game.filmed() as copies:
        obs, _ = copies.reset(seed, [episode])
        while len(found) < most:
            frame = copies.frame()
            if frame is None or frame.ndim != 3:
                raise UserError(f"task: {game.source} draws no frames, so there is no film of it.")
            found.append(frame[..., :3])
            step = copies.step(act(obs))
            if step.ended[0]:
                break
            obs = step.obs
    return found
