"""What every learning rule offers: a learner to begin with, one update, and its policies."""

import abc

import equinox as eqx
from jaxtyping import PyTree

from marlyap.nets import LyapunovNet, NormNet, Shape
from marlyap.rollout import AbstractExplorer, Policy
from marlyap.types import Key, Scalar, Transition


class AbstractAlgorithm(eqx.Module):
    """The fields of a subclass are its hyperparameters: the object is its own configuration."""

    gamma: eqx.AbstractVar[float]
    batch: eqx.AbstractVar[int]
    n_step: eqx.AbstractVar[int]

    @property
    @abc.abstractmethod
    def foresight(self) -> tuple[int, bool]:
        """T of L_target, and whether episodes are to be rolled T steps further to have it."""

    @abc.abstractmethod
    def init(self, shape: Shape, key: Key) -> PyTree:
        """Fresh parameters and optimiser memories."""

    @abc.abstractmethod
    def update(
        self, learner: PyTree, b: Transition, key: Key, decay: Scalar
    ) -> tuple[PyTree, dict[str, Scalar]]:
        """One gradient step on a batch, rates multiplied by `decay`; the dict is for the log."""

    @abc.abstractmethod
    def explore(self, learner: PyTree) -> AbstractExplorer:
        """The policy that collects data."""

    @abc.abstractmethod
    def exploit(self, learner: PyTree) -> Policy:
        """The deterministic policy that is evaluated, certified and deployed."""

    @abc.abstractmethod
    def lyapunov(self, learner: PyTree) -> LyapunovNet | NormNet | None:
        """The Lyapunov function (features, action) -> L learnt so far, if there is one."""
