"""Learning from the newest episodes alone, by how much better than expected each action was."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from marlyap.learning.algorithm import AbstractFromData, Log, unwatched
from marlyap.learning.health import Health
from marlyap.learning.replay import Episode
from marlyap.learning.source import CostWindow
from marlyap.types import Action, Features, Obs, Scalar


class Experience(eqx.Module):
    """One step of an episode, judged."""

    obs: Obs
    features: Features
    action: Action
    log_prob: Float[Array, "agent"]  # of the action, under the policy that took it
    advantage: Float[Array, "agent"]
    target: Float[Array, "agent"]  # what the values are fitted to: advantage + value
    weight: Scalar  # 0 after the game has terminated; 1 on average


class AbstractOnPolicy(AbstractFromData):
    """A subclass has values, and says what one `update` on a minibatch is."""

    gamma: eqx.AbstractVar[float]
    trace: eqx.AbstractVar[float]  # lambda of the advantages: 0 one step, 1 the whole episode
    batch: eqx.AbstractVar[int]  # steps for one update, at most
    epochs: eqx.AbstractVar[int]  # how often an iteration goes through its steps

    @abc.abstractmethod
    def values(self, networks: PyTree, obs: Obs, features: Features) -> Float[Array, "agent"]:
        """What each agent expects: its rewards from here on, discounted."""

    @abc.abstractmethod
    def update(self, networks: PyTree, b: Experience, decay: Scalar) -> tuple[PyTree, Log]:
        """One gradient step on a minibatch (leading axis `batch`), rates multiplied by `decay`."""

    @property
    def cost_window(self):
        return CostWindow()

    def updates_per_iteration(self, play):
        return self.epochs * self._minibatches(play.steps_per_iteration)[0]

    def begin(self, play, keys):
        return self.init(play.source.shape, keys.learn), Health.sound()

    def learn(self, learner, new, schedule, key, decay, watch=unwatched):
        """`epochs` times through all steps, in an order drawn anew each time."""
        judged = self.judge(learner, new)
        count, size = self._minibatches(new.steps)
        dynamic, static = eqx.partition(learner, eqx.is_array)

        def one(dynamic, rows):
            batch = jax.tree.map(lambda x: x[rows], judged)
            networks, log = self.update(eqx.combine(dynamic, static), batch, decay)
            return eqx.filter(networks, eqx.is_array), (log, watch(networks))

        def epoch(dynamic, key):
            order = jax.random.permutation(key, new.steps)[: count * size]
            return jax.lax.scan(one, dynamic, order.reshape(count, size))

        keys = jax.random.split(key, self.epochs)
        dynamic, (log, seen) = jax.lax.scan(epoch, dynamic, keys)
        seen = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), seen)
        return eqx.combine(dynamic, static), jax.tree.map(jnp.mean, log), seen

    def judge(self, networks: PyTree, new: Episode) -> Experience:
        """Every step of these episodes with its advantage, one after the other."""

        def one(e: Episode) -> Experience:
            value = jax.vmap(lambda o, f: self.values(networks, o, f))(e.obs, e.features)
            ended = jnp.concatenate([jnp.zeros(1, bool), e.terminated[:-1]])
            advantage = advantages(e.reward, value, e.terminated, self.gamma, self.trace)
            return jax.vmap(lambda **step: Experience(**step))(
                obs=e.obs[:-1],
                features=e.features[:-1],
                action=e.action,
                log_prob=e.log_prob,
                advantage=advantage,
                target=advantage + value[:-1],
                weight=1.0 - ended,
            )

        steps = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), jax.vmap(one)(new))
        return eqx.tree_at(lambda e: e.weight, steps, steps.weight / jnp.mean(steps.weight))

    def _minibatches(self, steps: int) -> tuple[int, int]:
        """How many there are in an epoch, and their size; what is left over is not used."""
        size = min(self.batch, steps)
        return steps // size, size


def advantages(
    reward: Float[Array, "time agent"],
    value: Float[Array, "time+1 agent"],
    terminated: Bool[Array, "time"],
    gamma: Scalar | float,
    trace: Scalar | float,
) -> Float[Array, "time agent"]:
    """Generalised advantage estimates (Schulman et al. 2016, eq. 16).

    Beyond the time limit the last value stands for what would follow; after termination nothing
    follows.
    """
    alive = 1.0 - terminated[:, None]
    surprise = reward + gamma * alive * value[1:] - value[:-1]

    def back(later, now):
        surprise, alive = now
        total = surprise + gamma * trace * alive * later
        return total, total

    _, found = jax.lax.scan(back, jnp.zeros_like(value[0]), (surprise, alive), reverse=True)
    return found
