"""What may be added to the policy objective, learnt beside it."""

import abc

import jax.numpy as jnp
from jaxtyping import PyTree

from marlyap.learning.source import CostWindow
from marlyap.learning.traced import AbstractTraced
from marlyap.nets.nets import LyapunovNet, NormNet, Sample, Shape
from marlyap.types import Key, Scalar, Transition


class AbstractConstraint(AbstractTraced):
    """A term of the policy objective (`penalty`) and how its parts are learnt (`update`)."""

    @property
    @abc.abstractmethod
    def cost_window(self) -> CostWindow:
        """Which sums of costs episodes are to hold for its L_target."""

    def fits(self, agents: int) -> None:
        """Raise UserError if it cannot be asked of a team of so many agents."""

    def paper(self) -> "AbstractConstraint":
        """The same as section 4 of the paper has it; the default has nothing to change."""
        return self

    @abc.abstractmethod
    def init(self, shape: Shape, key: Key) -> PyTree:
        """What the constraint learns, before it has learnt anything."""

    @abc.abstractmethod
    def penalty(self, L: PyTree, b: Transition, now: Sample, nxt: Sample) -> Scalar:
        """What one transition adds to J_pi; `now` and `nxt` are drawn from the current policy."""

    @abc.abstractmethod
    def update(
        self, L: PyTree, b: Transition, now: Sample, nxt: Sample, decay: Scalar
    ) -> tuple[PyTree, dict[str, Scalar]]:
        """One step of learning on a batch (all arguments but L and decay are batched)."""

    @abc.abstractmethod
    def lyapunov(self, L: PyTree) -> LyapunovNet | NormNet | None:
        """The Lyapunov function (features, action) -> L learnt so far, if there is one."""


class Unconstrained(AbstractConstraint):
    """Algorithm 1: nothing is added."""

    @property
    def cost_window(self):
        return CostWindow()

    def init(self, shape, key):
        return None

    def penalty(self, L, b, now, nxt):
        return jnp.zeros(())

    def update(self, L, b, now, nxt, decay):
        return L, {}

    def lyapunov(self, L):
        return None
