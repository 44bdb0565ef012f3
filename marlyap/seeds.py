"""Random streams that never meet: the same seed gives other numbers to each purpose."""

import zlib
from typing import Literal

import jax

from marlyap.errors import UserError
from marlyap.types import Key


Purpose = Literal["train", "select", "evaluate", "calibrate", "certify", "perturb"]


def check(seed: int) -> None:
    """Raise UserError unless JAX can take this seed whole, whatever its precision."""
    if not 0 <= seed < 2**31:
        raise UserError(f"seed: {seed} must lie between 0 and {2**31 - 1}.")


def stream(seed: int, purpose: Purpose) -> Key:
    """The random key of `purpose` under `seed`; what is trained on is never what judges.

    Raises UserError unless 0 <= seed < 2^31.
    """
    check(seed)
    return branch(jax.random.key(seed), purpose)


def branch(key: Key, purpose: Purpose) -> Key:
    """A stream that branches off from `key` for one purpose, and meets none of its splits."""
    return jax.random.fold_in(key, zlib.crc32(purpose.encode()))
