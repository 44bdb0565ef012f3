"""What every learning rule offers: a learner to begin with, one update, and its policies."""

import abc

import equinox as eqx
from jaxtyping import PyTree

from marlyap.game import AbstractGame
from marlyap.nets import LyapunovNet, NormNet, Shape
from marlyap.rollout import AbstractExplorer, Policy
from marlyap.types import Key, Keys, Scalar, Transition


class AbstractAlgorithm(eqx.Module):
    """The fields of a subclass are its hyperparameters: the object is its own configuration.

    A learning rule is one of two kinds, below: it learns from a memory of what was played, or by
    differentiating the game itself.
    """

    def fits(self, agents: int) -> None:
        """Raise UserError if it cannot train a team of so many agents; the default takes any."""

    @abc.abstractmethod
    def init(self, shape: Shape, key: Key) -> PyTree:
        """Fresh parameters and optimiser memories."""

    @abc.abstractmethod
    def exploit(self, learner: PyTree) -> Policy:
        """The deterministic policy that is evaluated, certified and deployed."""

    @abc.abstractmethod
    def lyapunov(self, learner: PyTree) -> LyapunovNet | NormNet | None:
        """The Lyapunov function (features, action) -> L learnt so far, if there is one."""


class AbstractOffPolicy(AbstractAlgorithm):
    """Learns from transitions that any policy may have left in the replay memory."""

    gamma: eqx.AbstractVar[float]
    batch: eqx.AbstractVar[int]
    n_step: eqx.AbstractVar[int]

    @property
    @abc.abstractmethod
    def foresight(self) -> tuple[int, bool]:
        """T of L_target, and whether episodes are to be rolled T steps further to have it."""

    @abc.abstractmethod
    def update(
        self, learner: PyTree, b: Transition, decay: Scalar
    ) -> tuple[PyTree, dict[str, Scalar]]:
        """One gradient step on a batch, rates multiplied by `decay`; the dict is for the log.

        What is random in it comes with the batch, as `b.noise`.
        """

    @abc.abstractmethod
    def explore(self, learner: PyTree) -> AbstractExplorer:
        """The policy that collects data."""


class AbstractModelBased(AbstractAlgorithm):
    """Learns from episodes that it plays itself, whose gradient it takes through the dynamics."""

    @abc.abstractmethod
    def improve(
        self, learner: PyTree, game: AbstractGame, keys: Keys, decay: Scalar
    ) -> tuple[PyTree, dict[str, Scalar]]:
        """One gradient step on the episodes of these keys; the dict has at least `return`."""
