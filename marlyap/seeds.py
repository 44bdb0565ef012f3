"""Random streams that never meet: the same seed gives other numbers to each purpose."""

import zlib
from typing import Literal

import jax

from marlyap.types import Key


Purpose = Literal["train", "select", "evaluate", "calibrate", "certify", "perturb"]


def stream(seed: int, purpose: Purpose) -> Key:
    """The random key of `purpose` under `seed`; what is trained on is never what judges."""
    return jax.random.fold_in(jax.random.key(seed), zlib.crc32(purpose.encode()))
