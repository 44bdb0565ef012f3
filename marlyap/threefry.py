"""The random numbers behind a seed, in NumPy: what JAX draws, bit for bit, without JAX.

Threefry-2x32 in 20 rounds (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011). A
key is a pair of arrays of 32-bit words, one for each stream.
"""

import math
from typing import Any

import numpy as np


GRID = np.linspace(-6.0, 6.0, 20_001)  # of standard normal numbers, and their distribution
BELOW = np.array([(1 + math.erf(z / math.sqrt(2))) / 2 for z in GRID])


def threefry(key: Any, high: Any, low: Any) -> tuple[np.ndarray, np.ndarray]:
    """Two new words from the key, for the words `high` and `low` of a counter."""
    keys = (*key, key[0] ^ key[1] ^ np.uint32(0x1BD11BDA))
    a, b = keys[0] + high, keys[1] + low
    for i in range(5):
        for r in ((13, 15, 26, 6), (17, 29, 16, 24))[i % 2]:
            a = a + b
            b = a ^ (b << np.uint32(r) | b >> np.uint32(32 - r))
        a, b = a + keys[(i + 1) % 3], b + keys[(i + 2) % 3] + np.uint32(i + 1)
    return a, b


def fold(key: Any, number: Any) -> tuple[np.ndarray, np.ndarray]:
    """Other streams, one for each number."""
    return threefry(key, np.uint32(0), np.asarray(number, np.uint32))


def uniform(key: Any, *shape: int) -> np.ndarray:
    """Numbers in [0, 1) from every stream [stream, *shape], in float32."""
    a, b = fold([word[:, None] for word in key], np.arange(math.prod(shape)))
    bits = (a ^ b) >> np.uint32(9) | np.uint32(0x3F800000)
    return (bits.view(np.float32) - 1).reshape(-1, *shape)


def uniform64(key: Any, *shape: int) -> np.ndarray:
    """Numbers in [0, 1) from every stream [stream, *shape], as JAX draws them in float64."""
    a, b = fold([word[:, None] for word in key], np.arange(math.prod(shape)))
    bits = (a.astype(np.uint64) << np.uint64(32) | b) >> np.uint64(12)
    return ((bits | np.uint64(0x3FF << 52)).view(np.float64) - 1).reshape(-1, *shape)


def normal(key: Any, *shape: int) -> np.ndarray:
    """Standard normal numbers [stream, *shape]; JAX's own to 1e-3 in the tails, 1e-5 elsewhere."""
    return np.interp(uniform(key, *shape) + 2.0**-25, BELOW, GRID)
