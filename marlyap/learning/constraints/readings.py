"""The readings of Delta L: what one transition adds to J_pi, before the weight.

A new reading is a subclass of `AbstractReading` and a line in READINGS.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.nets.nets import LyapunovNet, NormNet, Sample
from marlyap.types import Action, Scalar, Transition


class Terms(NamedTuple):
    """All that a reading may use of one transition."""

    L: LyapunovNet | NormNet
    b: Transition  # b.action is the one in the memory
    now: Sample  # drawn from the current policy at s
    nxt: Sample  # the same at s'
    due: Scalar  # decrease times the team's cost: L must fall by so much
    slope: Scalar  # l_L l_f, the change of L per unit of action
    scale: Scalar  # running mean square of the fall of L
    clip: Scalar | float  # the ratio of `score` stays within 1 -+ this
    agents: tuple[int, ...]  # whom the constraint is about; empty: everybody

    def rise(self, next_action: Action) -> Scalar:
        """L(s', a') - L(s, a) + decrease c."""
        return rise(self.L, self.b, next_action, self.due)

    def margin(self) -> Scalar:
        """slope ||a_phi - a|| of Theorem 1."""
        return self.slope * distance(self.now.action, self.b.action)


class AbstractReading(eqx.Module):
    """One way to read Delta L."""

    functions: ClassVar[tuple[str, ...]] = ("squares", "norm")  # forms of L that it works with
    condition: ClassVar[bool] = True  # whether it is one, whose weight can be learnt

    @abc.abstractmethod
    def __call__(self, t: Terms) -> Scalar:
        """Delta L of one transition, with its gradient by the current policy."""


class Han(AbstractReading):
    """L(s', a') - L(s, a) + decrease c, with a' from the current policy (Han et al. 2020)."""

    functions = ("squares",)

    def __call__(self, t):
        return t.rise(t.nxt.action)


class Printed(AbstractReading):
    """The same without gradient, plus slope ||a_phi - a||: eq. (14) to the letter."""

    def __call__(self, t):
        return t.rise(jax.lax.stop_gradient(t.nxt.action)) + t.margin()


class Hinge(AbstractReading):
    """max(0, L(s', a') - L(s, a) + decrease c + slope ||a_phi - a||) where L fell enough."""

    def __call__(self, t):
        rise = jax.lax.stop_gradient(t.rise(t.nxt.action))
        return jnp.where(rise <= 0, jax.nn.relu(rise + t.margin()), 0.0)


class Score(AbstractReading):
    """Raise the likelihood of actions after which V(s) fell, with a clipped ratio."""

    functions = ("norm",)

    def __call__(self, t):
        b = t.b
        fall = t.L(b.features, b.action) - t.L(b.next_features, b.action)
        advantage = jax.lax.stop_gradient((fall - t.due) / jnp.sqrt(t.scale))
        ratio = jnp.exp(jnp.clip(t.now.log_prob_memory - b.log_prob, -20.0, 20.0))
        near = jnp.clip(ratio, 1 - t.clip, 1 + t.clip)
        return -mean_over(t.agents, jnp.minimum(ratio * advantage, near * advantage))


class Critic(AbstractReading):
    """L(s, a) itself, with a from the current policy: the control without any condition."""

    functions = ("squares",)
    condition = False

    def __call__(self, t):
        return t.L(t.b.features, t.now.action)


READINGS: dict[str, AbstractReading] = {
    "han": Han(),
    "literal": Printed(),
    "hinge": Hinge(),
    "score": Score(),
    "critic": Critic(),
}


def rise(L: LyapunovNet | NormNet, b: Transition, next_action: Action, due: Scalar) -> Scalar:
    """L(s', a') - L(s, a) + decrease c, without the margin slope ||a_phi - a|| of Theorem 1."""
    fall = L(b.features, b.action) - L(b.next_features, next_action)
    return due - fall


def mean_over(agents: tuple[int, ...], per_agent: Float[Array, "agent"]) -> Scalar:
    """The mean over these agents; over all where none is named."""
    return jnp.mean(per_agent[jnp.array(agents)] if agents else per_agent)


def distance(a: Action, b: Action) -> Scalar:
    """||a - b||, with a gradient of 0 where they are equal."""
    square = jnp.sum((a - b) ** 2)
    safe = jnp.where(square > 0, square, 1.0)
    return jnp.where(square > 0, jnp.sqrt(safe), 0.0)
