"""Public power networks, from the files in data/: a transmission grid and two feeders."""

import json
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from marlyap.types import Key


DATA = Path(__file__).parent / "data"


class Network(eqx.Module):
    """The machines' couplings and their angles in the solved power flow, as NumPy arrays."""

    K: Float[np.ndarray, "agent agent"]  # K_ij (p.u. on 100 MVA)
    angle: Float[np.ndarray, "agent"]  # of the rotors, about their mean (rad)

    def flow(self, angle: Array, stronger: Array) -> Array:
        """What leaves each machine, lines being `stronger` times as strong (p.u.)."""
        # With its dtype told, JAX does not take the same array in another precision.
        K = jnp.asarray(self.K, angle.dtype) * stronger
        return jnp.sum(K * jnp.sin(angle[:, None] - angle[None, :]), axis=1)

    @property
    def stiffness(self) -> Float[np.ndarray, "agent agent"]:
        """d flow / d angle at the solved power flow (p.u./rad)."""
        K = self.K * np.cos(self.angle[:, None] - self.angle[None, :])
        return np.diag(K.sum(axis=1)) - K


@lru_cache(maxsize=1)
def new_england() -> Network:
    """The New England system, 39 buses and ten machines, reduced to its machines (Kron).

    K_ij = |E_i E_j Y_ij| from the solved power flow of MATPOWER's case39 and the transient
    reactances of Athay, Podmore and Virmani, IEEE Trans. Power Apparatus and Systems 98(2), 1979;
    loads are impedances, and losses are left out.
    """
    data = json.loads((DATA / "ieee39.json").read_text())
    K, angle = np.array(data["K"]), np.array(data["delta"])
    return Network(K * (1 - np.eye(len(K))), angle - angle.mean())


class Feeder(eqx.Module):
    """A tree of lines and what its buses draw, the substation left out, as NumPy arrays."""

    Z: Complex[np.ndarray, "bus bus"]  # impedance of the way that two buses share (p.u.)
    load: Complex[np.ndarray, "bus"]  # nominal (MVA)
    base: float  # of what is in p.u. (MVA)


@lru_cache(maxsize=2)
def feeder(name: str) -> Feeder:
    """The feeder with so many buses.

    13: the single-phase form of the IEEE 13-bus feeder of Feng, Shi, Qu, Low, Anandkumar and
    Wierman, IEEE Trans. Control of Network Systems, 2023, on 5 MVA and 4.16 kV. 33: Baran and Wu,
    IEEE Trans. Power Delivery 4(2), 1989, 12.66 kV.
    """
    data = json.loads((DATA / "feeders.json").read_text())[f"case{name}"]
    base = data.get("base_mva", 10.0)
    ohm = data["kv"] ** 2 / base if "kv" in data else 1.0
    up = {b: (a, complex(r, x) / ohm) for a, b, r, x in data["lines"]}
    ways = [dict(_way(up, bus)) for bus in sorted(up)]
    Z = np.array([[sum((z for b, z in w.items() if b in v), 0j) for v in ways] for w in ways])
    load = [complex(*data.get("loads", {}).get(str(bus), (0, 0))) for bus in sorted(up)]
    return Feeder(Z, np.array(load), base)


def _way(up: dict[int, tuple[int, complex]], bus: int) -> Iterator[tuple[int, complex]]:
    """The lines from a bus up to the substation."""
    while bus in up:
        yield bus, up[bus][1]
        bus = up[bus][0]


def low_or_high(grid: Feeder, at: Int[np.ndarray, "agent"], key: Key) -> tuple[Array, Array]:
    """P and Q of the 13 buses: heavy loads, or as often strong sun, as Feng et al. publish them."""
    r = jax.random.uniform(key, (12,))
    P, Q = jnp.zeros(12), jnp.zeros(12)
    between = lambda k, low, high: low + (high - low) * r[k]
    heavy = P.at[jnp.array([1, 6, 8])].set(
        -jnp.stack([0.5 * between(1, 1, 7), 0.8 * between(2, 1, 4), 0.3 * between(3, 1, 5)])
    )
    sunny = P.at[jnp.array([1, 2, 6, 8, 10, 11])].set(
        jnp.stack(
            [between(4, 0.5, 4), 0.5 * between(5, 2, 3), between(6, 0, 4.51)]
            + [between(7, 0, 5), between(8, 0.2, 3), between(9, 0, 1.5)]
        )
    )
    rising = Q.at[jnp.array([0, 3])].set(
        jnp.stack([0.3 * between(10, 0, 0.2), 0.4 * between(11, 0, 10)])
    )
    low = r[0] < 0.5
    return jnp.where(low, heavy, sunny), jnp.where(low, Q, rising)


def sun_and_load(grid: Feeder, at: Int[np.ndarray, "agent"], key: Key) -> tuple[Array, Array]:
    """P and Q of a feeder under a fifth to 1.4 of its loads, with up to 2 MW of sun an inverter."""
    load = grid.load
    k_all, k_load, k_sun = jax.random.split(key, 3)
    level, sun = jax.random.uniform(k_all, (2,)) * jnp.array([1.2, 2.0]) + jnp.array([0.2, 0.0])
    drawn = level * jax.random.uniform(k_load, load.shape, minval=0.8, maxval=1.2)
    shine = sun * jax.random.uniform(k_sun, at.shape, minval=0.8, maxval=1.2)
    P, Q = (-drawn * jnp.asarray(part(load), drawn.dtype) for part in (np.real, np.imag))
    return P.at[at].add(shine), Q


STARTS: dict[str, Callable[[Feeder, Int[np.ndarray, "agent"], Key], tuple[Array, Array]]] = {
    "13": low_or_high,
    "33": sun_and_load,
}
