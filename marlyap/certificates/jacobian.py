"""The one Jacobian of every certificate that linearises."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def jacobian(
    f: Callable[[Float[Array, "n"]], Float[Array, "m"]], x: Float[Array, "n"]
) -> Float[Array, "m n"]:
    """df/dx by reverse differentiation, in the precision of x.

    x is copied once for each row: networks are differentiated backwards, in batches.
    """
    copies = jnp.tile(x, (jax.eval_shape(f, x).size, 1))
    y, pull = jax.vjp(jax.vmap(f), copies)
    return pull(jnp.eye(y.shape[1], dtype=y.dtype))[0]
