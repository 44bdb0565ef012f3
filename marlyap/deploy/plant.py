"""The robots' motion in NumPy, for simulators that run without JAX.

`step` repeats `games.dynamics` and `games.physics`; `marlyap export` compares the two on the starts
of an evaluation and refuses to write a bundle where they differ.
"""

from collections.abc import Callable
from typing import Any

import numpy as np


Array = np.ndarray


def rolling(x: list[Array], u: list[Array], k: int) -> Array:
    """x_k' of a unicycle: x, y (m), psi (rad), v (m/s), omega (rad/s)."""
    match k:
        case 0:
            return x[3] * np.cos(x[2])
        case 1:
            return x[3] * np.sin(x[2])
        case 2:
            return x[4]
        case _:
            return u[k - 3]


def late(x: list[Array], u: list[Array], k: int) -> Array:
    """x_k' of a unicycle whose inputs under way are part of its state."""
    return np.zeros_like(x[0]) if k > 4 else rolling(x[:5], x[5:], k)


def double(x: list[Array], u: list[Array], k: int) -> Array:
    """x_k' of a double integrator: x, y (m), vx, vy (m/s)."""
    return x[k + 2] if k < 2 else u[k - 2]


def single(x: list[Array], u: list[Array], k: int) -> Array:
    """x_k' of a single integrator: x, y (m)."""
    return u[k]


Motion = Callable[[list[Array], list[Array], int], Array]

# x' = f(x, u), and the order in which semi-implicit Euler moves the states
MOTIONS: dict[str, tuple[Motion, tuple[tuple[int, ...], ...]]] = {
    "Unicycle": (rolling, ((3, 4), (2,), (0, 1))),
    "LateUnicycle": (late, ((3, 4), (2,), (0, 1))),
    "DoubleIntegrator": (double, ((2, 3), (0, 1))),
    "SingleIntegrator": (single, ((0, 1),)),
}


def step(plant: dict[str, Any], x: Array, u: Array, dt: float) -> Array:
    """x [..., state] after one step of training: `dt` seconds of constant inputs u [..., input].

    `plant` is that of the contract, u in its units.
    """
    if plant["integrator"] == "euler":
        after = coasted(plant, x, u, dt, 1)
    else:
        after = _rk4(plant, x, u, dt)
    if plant["kind"] == "LateUnicycle":
        after[..., 5:] = within(plant, u)
    return after


def coasted(plant: dict[str, Any], x: Array, u: Array, dt: float, pieces: int) -> Array:
    """x after `pieces` pieces of `dt` seconds each, by semi-implicit Euler; u is constant."""
    motion, blocks = MOTIONS[plant["kind"]]
    states, inputs = _parts(x), _parts(within(plant, u).astype(x.dtype))
    for _ in range(pieces):
        for block in blocks:
            slopes = [motion(states, inputs, k) for k in block]
            for k, slope in zip(block, slopes, strict=True):
                states[k] = states[k] + dt * slope
    return np.stack(states, -1)


def within(plant: dict[str, Any], u: Array) -> Array:
    """The inputs within their limits."""
    return np.clip(u, -np.array(plant["limits"]), plant["limits"])


def _rk4(plant: dict[str, Any], x: Array, u: Array, dt: float) -> Array:
    motion, _ = MOTIONS[plant["kind"]]
    inputs = _parts(within(plant, u).astype(x.dtype))

    def slope(x: Array) -> Array:
        states = _parts(x)
        return np.stack([motion(states, inputs, k) for k in range(len(states))], -1)

    k1 = slope(x)
    k2 = slope(x + dt / 2 * k1)
    k3 = slope(x + dt / 2 * k2)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + dt * k3))


def _parts(x: Array) -> list[Array]:
    return [np.ascontiguousarray(x[..., k]) for k in range(x.shape[-1])]
