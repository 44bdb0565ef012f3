"""The outer loop of Algorithms 1 and 2, compiled an iteration at a time."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap.compute import devices, export_cache
from marlyap.compute.devices import shard
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm, Info, KeyPair, Watch, unwatched
from marlyap.learning.diagnose import diagnose
from marlyap.learning.health import Health
from marlyap.learning.schedule import SCHEDULES, Schedule
from marlyap.learning.source import Play, Simulated, shape
from marlyap.learning.traced import with_arrays
from marlyap.learning.training import AbstractTrainer, Carry as Carry, Told
from marlyap.seeds import stream
from marlyap.simulation.evaluation import outcomes
from marlyap.simulation.rollout import Decentralised
from marlyap.types import Key, Scalar


class Trainer(AbstractTrainer):
    """One training run as two pure functions, `begin` and `iterate`."""

    game: AbstractGame
    algorithm: AbstractAlgorithm
    schedule: Schedule

    def __check_init__(self):
        self.algorithm.fits(self.game.agents)

    @property
    def shape(self):
        return shape(self.game)

    @property
    def play(self) -> Play:
        """What the algorithm is given to learn from."""
        return Play(Simulated(self.game), self.schedule)

    @property
    def steps_per_iteration(self) -> int:
        return self.play.steps_per_iteration

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

    def advance(self, carry, stop=lambda: False):
        done, mesh = int(np.min(carry.iteration)), devices.mesh_for(carry.iteration.size)
        carry = devices.placed(carry, carry.iteration.ndim > 0, mesh)
        given = with_arrays(self)
        compiled = lambda f: export_cache.compiled(f, given, carry, lambda: carry, donate=True)
        iterate = select = None
        while done < self.iterations and not stop():
            done += 1
            with devices.using(mesh):
                iterate = iterate or compiled(_iterate)
                carry, info = iterate(carry)
                log, health = info["log"], info["health"]
                if done % self.schedule.select_every == 0 or done == self.iterations:
                    select = select or compiled(_select_best)
                    carry, look = select(carry)
                    log |= look
            yield done, carry, Told(*jax.tree.map(np.atleast_1d, (log, Health(**health))))

    def model(self):
        return self.game

    def diagnose(self, carry, iteration):
        return diagnose(self, carry, iteration)


def _each(
    f: Callable[[Trainer, Carry], tuple[Carry, dict[str, Any]]], trainer: Trainer, carry: Carry
) -> tuple[Carry, dict[str, Any]]:
    """`f` for every run: vmapped only when there are several, since a batch of one costs speed."""
    several = carry.iteration.ndim > 0
    own = lambda x: 0 if eqx.is_array(x) and x.ndim else None  # a run's own, or that of all
    axes: dict[str, Any] = {"in_axes": (own, eqx.if_array(0)), "spmd_axis_name": devices.RUNS}
    each = eqx.filter_vmap(f, **axes) if several else f
    after, info = each(trainer, carry)
    return devices.kept(after, several), info


def _iterate(trainer: Trainer, carry: Carry) -> tuple[Carry, dict[str, Any]]:
    def told(trainer, carry):
        after, info = trainer.iterate(carry)
        return after, {"log": info.log, "health": info.health._asdict()}

    return _each(told, trainer, carry)


def _select_best(trainer: Trainer, carry: Carry) -> tuple[Carry, dict[str, Any]]:
    return _each(lambda trainer, carry: trainer.select_best(carry), trainer, carry)


def schedule_for(algorithm: AbstractAlgorithm, preset: str = "tuned") -> Schedule:
    """The algorithm's own schedule where it has one, else the one named after the preset."""
    return algorithm.default_schedule or SCHEDULES[preset]
