"""Affine bounds over many boxes at once: y(x) = A xi + b, give or take e, for x = c + r xi.

xi ranges over [-1, 1]^n. Every operation is a linear relaxation whose upper and lower bounds share
a slope, plus an interval for the rest, as in zonotope and CROWN-style verifiers. Each also widens e
by more than float64 can have lost, so that what is bounded here is bounded in exact arithmetic.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


ROUND = 1e-13  # relative to the magnitudes involved; hundreds of roundings of 1.1e-16 each


class Affine(NamedTuple):
    """m quantities over k boxes of n coordinates."""

    A: Float[np.ndarray, "k m n"]
    b: Float[np.ndarray, "k m"]
    e: Float[np.ndarray, "k m"]

    @property
    def radius(self) -> Float[np.ndarray, "k m"]:
        return np.abs(self.A).sum(axis=2) + self.e

    @property
    def low(self) -> Float[np.ndarray, "k m"]:
        return self.b - self.radius * (1 + ROUND) - ROUND * np.abs(self.b)

    @property
    def high(self) -> Float[np.ndarray, "k m"]:
        return self.b + self.radius * (1 + ROUND) + ROUND * np.abs(self.b)

    def pick(self, rows: list[int]) -> "Affine":
        return Affine(self.A[:, rows], self.b[:, rows], self.e[:, rows])


def box(centre: np.ndarray, radius: np.ndarray) -> Affine:
    """The coordinates themselves."""
    k, n = centre.shape
    return Affine(radius[:, :, None] * np.eye(n), centre, np.zeros((k, n)))


def linear(W: np.ndarray, y: Affine, bias: np.ndarray | float = 0.0) -> Affine:
    """W y + bias."""
    size = np.abs(W)
    lost = ROUND * ((np.abs(y.b) + y.radius) @ size.T + np.abs(bias))
    return Affine(np.matmul(W, y.A), y.b @ W.T + bias, y.e @ size.T + lost)


def add(x: Affine, y: Affine, sign: float = 1.0) -> Affine:
    """x + sign y."""
    lost = ROUND * (np.abs(x.b) + np.abs(y.b) + x.radius + y.radius)
    return Affine(x.A + sign * y.A, x.b + sign * y.b, x.e + y.e + lost)


def join(*parts: Affine) -> Affine:
    return Affine(*(np.concatenate(p, axis=1) for p in zip(*parts, strict=True)))


def constant(value: float, like: Affine) -> Affine:
    zero = np.zeros_like(like.b[:, :1])
    return Affine(np.zeros_like(like.A[:, :1]), zero + value, zero)


def sloped(y: Affine, slope: np.ndarray, low: np.ndarray, high: np.ndarray) -> Affine:
    """A function f(y) of which f - slope y is known to lie in [low, high]."""
    middle, half = (low + high) / 2, (high - low) / 2
    lost = ROUND * (np.abs(slope) * (np.abs(y.b) + y.radius) + np.abs(low) + np.abs(high))
    b = slope * y.b + middle
    return Affine(slope[:, :, None] * y.A, b, np.abs(slope) * y.e + half + lost)


def relu(y: Affine) -> Affine:
    """On [l, u] across 0 the chord u (y - l) / (u - l) above, its parallel through 0 below."""
    l, u = y.low, y.high
    width = np.where(u - l > 0, u - l, 1.0)
    slope = np.where(l >= 0, 1.0, np.where(u <= 0, 0.0, u / width))
    crossing = (l < 0) & (u > 0)
    top = np.where(crossing, -slope * l * (1 + 4 * ROUND), 0.0)
    return sloped(y, slope, np.zeros_like(top), top)


def tanh(y: Affine) -> Affine:
    """tanh(y) - s y does not fall for s no more than the smallest slope on [l, u]."""
    l, u = y.low, y.high
    tl, tu = np.tanh(l), np.tanh(u)
    slope = np.maximum(np.minimum(1 - tl**2, 1 - tu**2) * (1 - 1e-9) - 1e-12, 0.0)
    return sloped(y, slope, tl - slope * l, tu - slope * u)


def product(x: Affine, y: Affine) -> Affine:
    """x y: first order in both, and the rest bounded by the product of the radii."""
    rx, ry = x.radius, y.radius
    A = x.b[:, :, None] * y.A + y.b[:, :, None] * x.A
    rest = np.abs(x.b) * y.e + np.abs(y.b) * x.e + rx * ry
    lost = ROUND * (np.abs(x.b) + rx) * (np.abs(y.b) + ry)
    return Affine(A, x.b * y.b, rest * (1 + 4 * ROUND) + 4 * lost)


def sine(y: Affine, shift: float = 0.0) -> Affine:
    """sin(y + shift) = sin + cos (y - b), give or take |y - b|^2 / 2."""
    slope, rest = np.cos(y.b + shift), y.radius**2 / 2 + 1e-15
    at = np.sin(y.b + shift) - slope * y.b
    return sloped(y, slope, at - rest, at + rest)


def reciprocal(y: Affine) -> Affine:
    """1 / y for y > 0: the tangent below, and (y - b)^2 / (y b^2) above it at the most."""
    slope = -1 / y.b**2
    rest = y.radius**2 / (np.maximum(y.low, 1e-300) * y.b**2) * (1 + 8 * ROUND)
    return sloped(y, slope, 2 / y.b, 2 / y.b + rest)


def norm(y: Affine) -> Affine:
    """|y| >= g.y for a unit g, and |y| <= g.y + |y - (g.y) g|^2 / (2 g.y) where g.y > 0."""
    length = np.sqrt((y.b**2).sum(axis=1, keepdims=True))
    g = np.where(length > 0, y.b / np.where(length > 0, length, 1.0), 0.0)
    g = g * (1 - 1e-14)  # at most a unit vector after rounding
    along = Affine(
        np.einsum("km,kmn->kn", g, y.A)[:, None],
        (g * y.b).sum(axis=1, keepdims=True),
        (np.abs(g) * y.e).sum(axis=1, keepdims=True),
    )
    spread2 = (y.radius**2).sum(axis=1, keepdims=True)
    floor = along.low
    safe = np.where(floor > 0, floor, 1.0)
    bend = (spread2 / (2 * safe) + 1e-13 * (length + np.sqrt(spread2))) * (1 + 1e-12)
    thin = sloped(along, np.ones_like(length), np.zeros_like(bend) - 1e-13 * length, bend)
    most = (length + np.sqrt(spread2)) * (1 + 1e-12)
    least = np.maximum(length - np.sqrt(spread2), 0.0) * (1 - 1e-12)
    flat = Affine(np.zeros_like(thin.A), (most + least) / 2, (most - least) / 2 * (1 + 1e-12))
    use = (floor > 0) & (thin.radius < flat.radius)
    pick = lambda a, b: np.where(use, a, b)
    return Affine(
        np.where(use[:, :, None], thin.A, flat.A), pick(thin.b, flat.b), pick(thin.e, flat.e)
    )


def quadratic(P: np.ndarray, y: Affine) -> Affine:
    """y' P y for symmetric P."""
    half = y.b @ P
    d = y.radius
    A = 2 * np.einsum("km,kmn->kn", half, y.A)[:, None]
    rest = 2 * (np.abs(half) * y.e).sum(axis=1) + np.einsum("km,mj,kj->k", d, np.abs(P), d)
    size = np.abs(y.b) + d
    lost = 8 * ROUND * np.einsum("km,mj,kj->k", size, np.abs(P), size)
    return Affine(A, (half * y.b).sum(axis=1)[:, None], (rest * (1 + 8 * ROUND) + lost)[:, None])
