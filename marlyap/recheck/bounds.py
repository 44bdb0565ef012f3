"""Exact bounds from the tail of the binomial distribution, by bisection."""

import math

import numpy as np


def mass(n: int, p: float) -> np.ndarray:
    """P(X = 0 ... n) for X ~ Binomial(n, p), 0 < p < 1."""
    i, log = np.arange(n + 1), np.array([math.lgamma(j + 1) for j in range(n + 1)])
    return np.exp(log[n] - log - log[::-1] + i * math.log(p) + (n - i) * math.log1p(-p))


def lower(k: int, n: int, tail: float) -> float:
    """Clopper and Pearson's lower bound: the p at which P(X >= k) = tail, by bisection."""
    if k == n:
        return tail ** (1 / n) if n else 0.0
    low, high = 0.0, float(k > 0)
    for _ in range(50):
        p = (low + high) / 2
        low, high = (low, p) if k == 0 or mass(n, p)[k:].sum() > tail else (p, high)
    return low


def needed(share: float, tail: float) -> int:
    """The fewest trials, all without failure, whose lower bound reaches `share`."""
    return max(1, math.ceil(math.log(tail) / math.log(share) * (1 - 1e-12)))


def order(sample: np.ndarray, q: float, tail: float) -> float:
    """The j-th smallest value, for the smallest j with P(Binomial(n, q) <= j - 1) >= 1 - tail."""
    n = len(sample)
    j = int(np.searchsorted(np.cumsum(mass(n, q))[:n], 1 - tail))
    return float(np.sort(sample)[j]) if j < n else math.inf
