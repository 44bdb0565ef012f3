"""How a batch lies in memory when a network written for one sample is vmapped.

Left to itself, vmap puts the batch first wherever it likes, and XLA then copies activations to
turn them round between layers. Here a vmapped input becomes the last axis, so that activations
are [features, batch] forwards and backwards, and each layer is one matrix product for its value,
one for the gradient of its input and one for the gradient of its weights.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, PyTree


Forward = Callable[[Any, PyTree], PyTree]  # (net, x) with every array of x [*stack, in, batch]


def batch_last(forward: Forward) -> Forward:
    """Give `forward(net, x)`, written for arrays of shape [*stack, in, batch], its rule under vmap.

    Weights and x both batched: one more axis of stacked nets (agents, seeds). Weights alone:
    stacked nets that look at the same x (twins). x alone: the batch, which becomes columns; reverse
    differentiation goes through this case only, so `vmap` an objective before taking its gradient.
    """
    rule = custom_vmap(forward)

    @rule.def_vmap
    def _(size: int, batched: list[PyTree], net: Any, x: PyTree) -> tuple[PyTree, PyTree]:
        repeated = lambda a, has: a if has else jnp.broadcast_to(a, (size, *a.shape))
        if any(jax.tree.leaves(batched[0])):
            net = jax.tree.map(repeated, net, batched[0])
            # `matmul` knows of one axis that all share, the last: others are written out.
            stacked = max(w.ndim for w in jax.tree.leaves(net)) > 3
            if stacked or any(jax.tree.leaves(batched[1])):
                x = jax.tree.map(repeated, x, batched[1])
            y = rule(net, x)
        else:
            x = jax.tree.map(repeated, x, batched[1])
            columns = lambda a: jnp.moveaxis(a, 0, -1).reshape(*a.shape[1:-1], -1)
            rows = lambda a: jnp.moveaxis(a.reshape(*a.shape[:-1], -1, size), -1, 0)
            y = jax.tree.map(rows, forward(net, jax.tree.map(columns, x)))
        return y, jax.tree.map(lambda _: True, y)

    return rule


def grad(f: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """`jax.grad` at one sample of a function with networks in it: as a batch of one."""
    return lambda x: jax.grad(lambda xs: jnp.sum(jax.vmap(f)(xs)))(x[None])[0]


def rows_as_columns(forward: Forward) -> Forward:
    """One net for a whole stack: arrays [*stack, row, in, batch] pass through it as columns."""

    def folded(net: Any, x: PyTree) -> PyTree:
        rows = jax.tree.leaves(x)[0].shape[-3]
        fold = lambda a: jnp.moveaxis(a, -3, -2).reshape(*a.shape[:-3], a.shape[-2], -1)
        unfold = lambda y: jnp.moveaxis(y.reshape(*y.shape[:-1], rows, -1), -2, -3)
        return jax.tree.map(unfold, forward(net, jax.tree.map(fold, x)))

    return folded


@jax.custom_vjp
def matmul(W: Float[Array, "*stack out in"], x: Array) -> Array:
    """W @ x for x of shape [*stack, in, batch], or without the last stack axis if all share x."""
    if W.ndim == x.ndim:
        return W @ x
    tall = W.reshape(*W.shape[:-3], -1, W.shape[-1])
    return (tall @ x).reshape(*W.shape[:-1], -1)


def _backward(residual: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    W, x = residual
    if W.ndim == x.ndim:
        gradient_W = g @ jnp.swapaxes(x, -1, -2)
        if W.shape[-2] == 1:
            # One output: XLA would multiply without a product, and compute g for each input anew.
            W, g = (jnp.concatenate([a, jnp.zeros_like(a)], axis=-2) for a in (W, g))
        return gradient_W, jnp.swapaxes(W, -1, -2) @ g
    tall_W, tall_g = (a.reshape(*a.shape[:-3], -1, a.shape[-1]) for a in (W, g))
    gradient_W = (tall_g @ jnp.swapaxes(x, -1, -2)).reshape(W.shape)
    return gradient_W, jnp.swapaxes(tall_W, -1, -2) @ tall_g


matmul.defvjp(lambda W, x: (matmul(W, x), (W, x)), _backward)


def total(x: Float[Array, "*stack in batch"]) -> Float[Array, "*stack 1 batch"]:
    """The sum over the features, as a product with ones.

    XLA takes whatever leads to a plain sum, exp and log too, into the loop of the sum, and where
    that is not over the last axis it computes one number at a time.
    """
    ones = jnp.ones((*x.shape[:-2], 1, x.shape[-2]))
    return jnp.matmul(ones, x, precision="highest")


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def broadcast(x: Float[Array, "*stack 1 batch"], size: int) -> Float[Array, "*stack in batch"]:
    """`x` for each of `size` features; its gradient is a `total`."""
    return jnp.broadcast_to(x, (*x.shape[:-2], size, x.shape[-1]))


broadcast.defvjp(lambda x, size: (broadcast(x, size), None), lambda size, _, g: (total(g),))
