"""A parameter, the memory of its optimiser, and one step downhill."""

from collections.abc import Callable
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import PyTree

from marlyap.types import Scalar


M = TypeVar("M")
ADAM = optax.scale_by_adam()


class Learnt(eqx.Module, Generic[M]):
    """theta and what Adam remembers of its gradients."""

    value: M
    memory: PyTree

    @classmethod
    def of(cls, value: M) -> "Learnt[M]":
        """A parameter that has not moved yet."""
        return cls(value, ADAM.init(eqx.filter(value, eqx.is_inexact_array)))

    def step(self, gradient: PyTree, rate: Scalar | float) -> "Learnt[M]":
        """theta <- theta - rate * gradient, preconditioned by Adam."""
        direction, memory = ADAM.update(gradient, self.memory)
        move = jax.tree.map(lambda d: -rate * d, direction)
        return Learnt(eqx.apply_updates(self.value, move), memory)

    def descend(
        self, J: Callable[..., Scalar], *batch: PyTree, rate: Scalar | float
    ) -> tuple["Learnt[M]", Scalar]:
        """theta <- theta - rate * grad E_D[J(theta, *one)], and E_D[J] before the step.

        J takes the parameter and one row of each batched argument.
        """

        @eqx.filter_value_and_grad
        def expectation(value):
            return jnp.mean(jax.vmap(lambda *one: J(value, *one))(*batch))

        loss, gradient = expectation(self.value)
        return self.step(gradient, rate), loss


def polyak(new: M, old: M, tau: float) -> M:
    """tau theta + (1 - tau) theta-bar, leaf by leaf."""
    mix = lambda n, o: tau * n + (1 - tau) * o if eqx.is_inexact_array(n) else n
    return jax.tree.map(mix, new, old)
