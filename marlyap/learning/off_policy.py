"""Learning from a replay memory: transitions that any policy may have left there."""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from marlyap.errors import UserError
from marlyap.learning.algorithm import AbstractFromData, Log, Watch, unwatched
from marlyap.learning.health import Health
from marlyap.learning.replay import AbstractMemory, Replay
from marlyap.learning.source import CostWindow
from marlyap.simulation.rollout import Uniform
from marlyap.types import Key, Scalar, Transition


AHEAD = 8  # batches that are drawn together, at most


class Learner(eqx.Module):
    """What an off-policy algorithm carries from one iteration to the next."""

    networks: PyTree
    memory: AbstractMemory


class AbstractOffPolicy(AbstractFromData):
    """A subclass says what one `update` on a batch is; remembering and sampling are done here."""

    gamma: eqx.AbstractVar[float]
    batch: eqx.AbstractVar[int]
    n_step: eqx.AbstractVar[int]

    @abc.abstractmethod
    def update(self, networks: PyTree, b: Transition, decay: Scalar) -> tuple[PyTree, Log]:
        """One gradient step on a batch (leading axis `batch`), rates multiplied by `decay`.

        What is random in it comes with the batch, as `b.noise`.
        """

    def networks(self, learner):
        return learner.networks

    def with_networks(self, learner, networks):
        return Learner(networks, learner.memory)

    def with_room(self, learner, like):
        return Learner(learner.networks, learner.memory.resized(like.memory))

    def from_steps(self):
        if self.cost_window != CostWindow():
            raise UserError(
                "algorithm.constraint: it needs the costs of a game in JAX, and a game outside has "
                "rewards alone; set it to none."
            )
        return self

    def updates_per_iteration(self, play):
        return play.schedule.updates(play.steps_per_iteration)

    def begin(self, play, keys):
        """Fresh networks, and a memory with the warm-up in it."""
        networks, s = self.init(play.source.shape, keys.learn), play.schedule
        horizon = play.source.horizon
        episodes = max(1, -(-s.warmup // horizon))
        warm = play(Uniform(play.source.shape.du), keys.play, episodes, self.cost_window)
        needed = episodes + play.iterations * s.environments
        rows = min(needed, max(s.capacity // horizon, episodes, s.environments))
        memory = Replay.empty(jax.tree.map(lambda x: x[0], warm), rows).add(warm)
        return Learner(networks, memory), Health.of(warm)

    def learn(self, learner, new, schedule, key, decay, watch=unwatched):
        """Remember the episodes, then update on batches from the whole memory."""
        memory = learner.memory.add(new)
        updates = schedule.updates(new.steps)
        networks, log, seen = self.improve(learner.networks, memory, updates, key, decay, watch)
        return Learner(networks, memory), log, seen

    def improve(
        self,
        networks: PyTree,
        memory: AbstractMemory,
        updates: int,
        key: Key,
        decay: Scalar,
        watch: Watch = unwatched,
    ) -> tuple[PyTree, Log, PyTree]:
        """So many updates, each on a fresh batch from the memory; results as those of `learn`."""
        dynamic, static = eqx.partition(networks, eqx.is_array)

        def one(dynamic, batch):
            networks, log = self.update(eqx.combine(dynamic, static), batch, decay)
            return eqx.filter(networks, eqx.is_array), (log, watch(networks))

        def several(dynamic, keys):
            # Batches are drawn ahead of the loop that uses them. In the same loop XLA would draw
            # each number again wherever it is used, and not by vectors.
            draw = lambda key: memory.sample(key, self.batch, self.gamma, self.n_step)
            return jax.lax.scan(one, dynamic, jax.vmap(draw)(keys))

        ahead = math.gcd(updates, AHEAD)
        keys = jax.random.split(key, (updates // ahead, ahead))
        dynamic, (log, seen) = jax.lax.scan(several, dynamic, keys)
        seen = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), seen)
        return eqx.combine(dynamic, static), jax.tree.map(jnp.mean, log), seen
