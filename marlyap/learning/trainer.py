"""The outer loop of Algorithms 1 and 2, compiled an iteration at a time."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from marlyap.compute.devices import shard
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm, Info, KeyPair, Watch, unwatched
from marlyap.learning.health import Health
from marlyap.learning.schedule import SCHEDULES, Schedule
from marlyap.learning.source import Play, Simulated
from marlyap.seeds import stream
from marlyap.simulation.evaluation import outcomes
from marlyap.simulation.rollout import Decentralised, Policy
from marlyap.types import Key, Scalar


class Carry(eqx.Module):
    """All that training is at one instant; saved whole, so that a resumed run is the same run."""

    learner: PyTree  # the algorithm's
    key: Key
    iteration: Int[Array, ""]
    best: Policy  # of those evaluated, the one with the highest score
    score: Scalar


class Trainer(eqx.Module):
    """One training run as two pure functions, `begin` and `iterate`."""

    game: AbstractGame
    algorithm: AbstractAlgorithm
    schedule: Schedule

    def __check_init__(self):
        self.algorithm.fits(self.game.agents)

    @property
    def play(self) -> Play:
        """What the algorithm is given to learn from."""
        return Play(Simulated(self.game), self.schedule)

    @property
    def steps_per_iteration(self) -> int:
        return self.play.steps_per_iteration

    @property
    def iterations(self) -> int:
        return self.play.iterations

    @property
    def updates_per_iteration(self) -> int:
        return self.algorithm.updates_per_iteration(self.play)

    def begin(self, key: Key) -> tuple[Carry, Health]:
        """A fresh carry, and the health of what was played to begin with."""
        a = self.algorithm
        k_learn, k_play, key = jax.random.split(key, 3)
        learner, health = a.begin(self.play, KeyPair(k_play, k_learn))
        best = a.policy(a.networks(learner))
        return Carry(learner, key, jnp.asarray(0), best, jnp.zeros(())), health

    def iterate(self, carry: Carry, watch: Watch = unwatched) -> tuple[Carry, Info]:
        """One iteration of the algorithm; `watch` is asked about the networks after each update."""
        key, k_play, k_learn = jax.random.split(carry.key, 3)
        keys, decay = KeyPair(k_play, k_learn), self.decay(carry.iteration)
        learner, info = self.algorithm.iterate(carry.learner, self.play, keys, decay, watch)
        health = info.health.with_networks(self.algorithm.networks(learner))
        after = Carry(learner, key, carry.iteration + 1, carry.best, carry.score)
        return after, info._replace(health=health)

    def select_best(self, carry: Carry) -> tuple[Carry, dict[str, Scalar]]:
        """Evaluate the policy from starts kept for this alone, and keep it if it is the best.

        Its score is the success rate, plus a tenth of that at half the radius. Ties are broken by
        how far and how fast the agents end, which count for less than one start in all.
        """
        policy = self.algorithm.policy(self.algorithm.networks(carry.learner))
        keys = shard(jax.random.split(stream(0, "select"), self.schedule.select_episodes))
        seen = outcomes(self.game, Decentralised(policy, self.game), keys)
        rate = lambda hits: jnp.mean(hits.astype(float))
        near = rate(seen.success & (seen.final <= self.game.edge / 2))
        less = lambda x, unit: jnp.mean(jnp.nan_to_num(1 / (1 + x / unit)))
        tie = less(seen.final, self.game.edge) + less(seen.speed + seen.spin, 1.0)
        score = rate(seen.success) + 0.1 * near + 0.02 * tie / self.schedule.select_episodes
        better = score >= carry.score
        keep = lambda new, old: jnp.where(better, new, old) if eqx.is_array(new) else new
        best = jax.tree.map(keep, policy, carry.best)
        score = jnp.maximum(score, carry.score)
        carry = Carry(carry.learner, carry.key, carry.iteration, best, score)
        look = {"success": rate(seen.success), "distance": jnp.mean(seen.final)}
        return carry, look | {"speed": jnp.mean(seen.speed), "spin": jnp.mean(seen.spin)}

    def decay(self, iteration: Int[Array, ""]) -> Scalar:
        """What the learning rates are multiplied by."""
        s = self.schedule
        span = s.decay_episodes or self.iterations * s.environments
        return s.decay ** (iteration * s.environments / span)


def schedule_for(algorithm: AbstractAlgorithm, preset: str = "tuned") -> Schedule:
    """The algorithm's own schedule where it has one, else the one named after the preset."""
    return algorithm.default_schedule or SCHEDULES[preset]
