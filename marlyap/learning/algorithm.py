"""What every algorithm offers: it begins, iterates, and says which policy is deployed."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import PyTree

from marlyap.compute.devices import gathered
from marlyap.errors import UserError
from marlyap.learning.health import Health
from marlyap.learning.replay import Episode
from marlyap.learning.schedule import Schedule
from marlyap.learning.source import CostWindow, Play
from marlyap.learning.traced import AbstractTraced
from marlyap.nets.nets import LyapunovNet, NormNet, Shape
from marlyap.simulation.rollout import AbstractExplorer, Policy
from marlyap.types import Key, Scalar


Log = dict[str, Scalar]
Watch = Callable[[PyTree], PyTree]  # asked about the networks after each update


def unwatched(networks: PyTree) -> None:
    """Nobody asks."""


class KeyPair(NamedTuple):
    """Two independent streams, so that what is played does not depend on how one learns."""

    play: Key
    learn: Key


class Info(NamedTuple):
    """What an iteration tells."""

    log: Log
    health: Health
    seen: PyTree = None  # what `watch` returned, with a leading axis `update`


class AbstractAlgorithm(AbstractTraced):
    """Owns its iteration. The fields of a subclass are its hyperparameters and its configuration.

    `networks` are all that gradients move, with the optimisers' states; a `learner` is the networks
    and whatever else lasts from one iteration to the next.
    """

    default_schedule: ClassVar[Schedule | None] = None  # None: the one named after the preset

    def fits(self, agents: int) -> None:
        """Raise UserError if it cannot train a team of so many agents; the default takes any."""

    def paper(self) -> "AbstractAlgorithm":
        """The same with the settings of section 4 of the paper; the default has none."""
        return self

    @abc.abstractmethod
    def updates_per_iteration(self, play: Play) -> int:
        """Gradient steps in one iteration, for the log."""

    @abc.abstractmethod
    def init(self, shape: Shape, key: Key) -> PyTree:
        """Fresh networks."""

    @abc.abstractmethod
    def begin(self, play: Play, keys: KeyPair) -> tuple[PyTree, Health]:
        """A fresh learner, and the health of what was played for it."""

    @abc.abstractmethod
    def iterate(
        self, learner: PyTree, play: Play, keys: KeyPair, decay: Scalar, watch: Watch = unwatched
    ) -> tuple[PyTree, Info]:
        """Play and learn once, with all learning rates multiplied by `decay`."""

    def from_steps(self) -> Any:
        """Itself as an `AbstractOffPolicy`, for games outside JAX, of which single steps are kept.

        Raises UserError where it needs more than that.
        """
        raise UserError(
            "algorithm: it needs a game in JAX or whole episodes; for a game outside JAX take one "
            "that learns from single steps, such as masac or maddpg."
        )

    def networks(self, learner: PyTree) -> PyTree:
        """The networks of a learner; the default is all of it."""
        return learner

    def with_networks(self, learner: PyTree, networks: PyTree) -> PyTree:
        """The learner with other networks in it."""
        return networks

    def with_room(self, learner: PyTree, like: PyTree) -> PyTree:
        """The learner with as much room to remember as `like` has, for a longer run."""
        return learner

    @abc.abstractmethod
    def policy(self, networks: PyTree) -> Policy:
        """The deterministic policy that is evaluated, certified and deployed."""

    @abc.abstractmethod
    def lyapunov(self, networks: PyTree) -> LyapunovNet | NormNet | None:
        """The Lyapunov function (features, action) -> L learnt so far, if there is one."""


class AbstractFromData(AbstractAlgorithm):
    """Learns from episodes alone, whoever played them: an iteration plays, then learns."""

    @property
    @abc.abstractmethod
    def cost_window(self) -> CostWindow:
        """Which sums of costs its episodes hold; CostWindow() where it needs none."""

    @abc.abstractmethod
    def explore(self, networks: PyTree) -> AbstractExplorer:
        """The policy that collects data."""

    @abc.abstractmethod
    def learn(
        self,
        learner: PyTree,
        new: Episode,
        schedule: Schedule,
        key: Key,
        decay: Scalar,
        watch: Watch = unwatched,
    ) -> tuple[PyTree, Log, PyTree]:
        """All updates of an iteration from its new episodes (leading axis `episode`).

        Returns the learner, the log (means over the updates) and what `watch` saw after each.
        """

    def iterate(self, learner, play, keys, decay, watch=unwatched):
        """Play `environments` episodes, and learn from them."""
        explorer, episodes = self.explore(self.networks(learner)), play.schedule.environments
        new = gathered(play(explorer, keys.play, episodes, self.cost_window))
        learner, log, seen = self.learn(learner, new, play.schedule, keys.learn, decay, watch)
        log["return"] = jnp.mean(jnp.sum(jnp.mean(new.reward, axis=2), axis=1))
        return learner, Info(log, Health.of(new), seen)
