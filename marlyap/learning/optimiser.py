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
WHOLE, PART = 2_048, 512  # rows of a batch that are taken at once; rows of a part where not


class TrainState(eqx.Module, Generic[M]):
    """theta and what Adam remembers of its gradients."""

    value: M
    memory: PyTree

    @classmethod
    def of(cls, value: M) -> "TrainState[M]":
        """A parameter that has not moved yet."""
        return cls(value, ADAM.init(eqx.filter(value, eqx.is_inexact_array)))

    def step(self, gradient: PyTree, rate: Scalar | float) -> "TrainState[M]":
        """theta <- theta - rate * gradient, preconditioned by Adam."""
        direction, memory = ADAM.update(gradient, self.memory)
        move = jax.tree.map(lambda d: -rate * d, direction)
        return TrainState(eqx.apply_updates(self.value, move), memory)

    def descend(
        self, J: Callable[..., Scalar], *batch: PyTree, rate: Scalar | float, parts: int = 1
    ) -> tuple["TrainState[M]", Scalar]:
        """theta <- theta - rate * grad E_D[J(theta, *one)], and E_D[J] before the step.

        J takes the parameter and one row of each batched argument; the batch is taken in `parts`,
        a divisor of its size.
        """

        @eqx.filter_value_and_grad
        def expectation(value, *batch):
            return jnp.mean(jax.vmap(lambda *one: J(value, *one))(*batch))

        def add(total, part):
            return jax.tree.map(jnp.add, total, expectation(self.value, *part)), None

        if parts == 1:
            loss, gradient = expectation(self.value, *batch)
        else:
            split = jax.tree.map(lambda x: x.reshape(parts, -1, *x.shape[1:]), batch)
            zero = jax.tree.map(jnp.zeros_like, eqx.filter(self.value, eqx.is_inexact_array))
            total, _ = jax.lax.scan(add, (jnp.zeros(()), zero), split)
            loss, gradient = jax.tree.map(lambda x: x / parts, total)
        return self.step(gradient, rate), loss


def parts(batch: int, agents: int) -> int:
    """In how many parts a batch is best taken: so many that the activations stay in the cache.

    1 for small teams, and on accelerators, which would rather have all of it at once.
    """
    if batch * agents <= WHOLE or jax.default_backend() != "cpu":
        return 1
    few = max(PART // agents, 1)
    return next(n for n in range(1, batch + 1) if batch % n == 0 and batch // n <= few)


def in_parts(f: Callable[[PyTree], PyTree], batch: PyTree, parts: int) -> PyTree:
    """`f` of each row of a batch, so many parts of it at a time."""
    if parts == 1:
        return jax.vmap(f)(batch)
    size = len(jax.tree.leaves(batch)[0]) // parts
    return jax.lax.map(f, batch, batch_size=size)


def polyak(new: M, old: M, tau: Scalar | float) -> M:
    """tau theta + (1 - tau) theta-bar, leaf by leaf."""
    mix = lambda n, o: tau * n + (1 - tau) * o if eqx.is_inexact_array(n) else n
    return jax.tree.map(mix, new, old)
