"""What an agent sees: everything in its own frame, so that neither compass nor map is needed.

A turn or a shift of the whole scene changes nothing (SE(2) invariance), and nothing but the
agent itself and its neighbours enters (locality).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from marlyap.games.dynamics import AbstractDynamics
from marlyap.types import Entry, Links, Obs


class Sight(NamedTuple):
    """How a robot itself makes its row of `body_frame`, of what it measures and hears.

    `places` are subtracted from all positions before they are compared.
    """

    scale: float  # at which gaps are magnified (m)
    headings: bool  # whether neighbours tell their headings
    places: Float[np.ndarray, "agent 2"]  # m


def noise(
    seed: UInt32[Array, "2"], t: int | Int[Array, ""], shape: tuple[int, ...]
) -> Float[Array, "..."]:
    """Standard normal numbers for step t, drawn by a seed that the state holds."""
    return jax.random.normal(jax.random.fold_in(jax.random.wrap_key_data(seed), t), shape)


def into_frame(h: Float[Array, "2"], v: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """World vectors in the frame whose first axis is the unit vector h: R(-psi) v."""
    along = v[..., 0] * h[0] + v[..., 1] * h[1]
    left = v[..., 1] * h[0] - v[..., 0] * h[1]
    return jnp.stack([along, left], axis=-1)


def length(v: Float[Array, "*n d"]) -> Float[Array, "*n"]:
    """|v|, with the derivative 0 at 0, where a root has none."""
    squared = jnp.sum(v * v, axis=-1)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)


def near(v: Float[Array, "*n d"], scale: float) -> Float[Array, "*n d"]:
    """v / (|v| + scale): the direction far away, and close by a magnified v.

    A network fed with metres alone cannot tell centimetres apart.
    """
    length = jnp.sqrt(jnp.sum(v * v, axis=-1, keepdims=True) + 1e-12)
    return v / (length + scale)


def body_frame(
    dynamics: AbstractDynamics,
    x: Float[Array, "agent dx"],
    goals: Float[Array, "agent 2"],
    slots: Int[Array, "agent slot"],
    links: Links,
    leads: Bool[Array, "agent"],
    scale: float,
    headings: bool,
) -> Obs:
    """Per agent: own rates; leader flag and goal - p_i (0 for a follower); for every neighbour slot
    a presence flag, p_j - p_i, the velocity of j, and, if asked, the heading of j.

    Positions are given in metres and again magnified near zero, at `scale` metres. Empty slots
    are all zero.
    """
    p = jax.vmap(dynamics.position)(x)
    h = jax.vmap(dynamics.heading)(x)
    v = jax.vmap(dynamics.velocity)(x)
    rates = jax.vmap(dynamics.rates)(x)

    def of(i, slot, lead):
        there = (slot >= 0) & links[i, slot]
        gap = into_frame(h[i], p[slot] - p[i][None])
        seen = [gap, near(gap, scale), into_frame(h[i], v[slot])]
        if headings:
            seen.append(into_frame(h[i], h[slot]))
        flag = there.astype(p.dtype)[:, None]
        others = jnp.where(there[:, None], jnp.concatenate([flag, *seen], axis=1), 0.0)
        to_goal = jnp.where(lead, into_frame(h[i], goals[i] - p[i]), 0.0)
        own = [rates[i], lead.astype(p.dtype)[None], to_goal, near(to_goal, scale)]
        return jnp.concatenate([*own, others.ravel()])

    return jax.vmap(of)(jnp.arange(slots.shape[0]), slots, leads)


def body_frame_entries(dynamics: AbstractDynamics, slots: int, headings: bool) -> tuple[Entry, ...]:
    """What the entries of one row of `body_frame` are, in their order."""
    units = dict(zip(dynamics.names, dynamics.units, strict=False))

    def pair(what: str, unit: str) -> list[Entry]:
        return [Entry(f"{what}, ahead", unit, "own"), Entry(f"{what}, left", unit, "own")]

    own = [Entry(name, units.get(name, "1"), "own") for name in dynamics.felt]
    own.append(Entry("1 if the goal is told, else 0", "1", ""))
    own += pair("goal - position, 0 if not told", "m")
    own += pair("e / (|e| + radius) of e = goal - position", "1")
    others = []
    for k in range(slots):
        who = f"neighbour {k}"
        others.append(Entry(f"1 if {who} is seen, else all of it is 0", "1", ""))
        others += pair(f"position of {who} - own position", "m")
        others += pair(f"e / (|e| + radius) of e = position of {who} - own position", "1")
        others += pair(f"velocity of {who} over the ground", "m/s")
        others += pair(f"heading of {who}", "1") if headings else []
    return (*own, *others)


def beside(
    own: Float[Array, "agent own"],
    seen: Float[Array, "agent agent edge"],
    slots: Int[Array, "agent slot"],
    links: Links,
) -> Obs:
    """What agent i knows of itself, and of each neighbour: for the observations of any game.

    Row i is own[i], then for every neighbour slot j of i a presence flag and seen[i, j], all zero
    where i does not hear j.

    Arguments: own, each agent's own measurements; seen, of agent j as i sees it; slots, as
    `game.slots`; links, as `observe` is given them.
    """
    row = jnp.arange(slots.shape[0])[:, None]
    there = (slots >= 0) & links[row, slots]
    flagged = jnp.concatenate([jnp.ones_like(seen[..., :1]), seen], axis=-1)[row, slots]
    others = jnp.where(there[..., None], flagged, 0.0)
    return jnp.concatenate([own, others.reshape(slots.shape[0], -1)], axis=1)


def beside_entries(
    own: tuple[Entry, ...], seen: tuple[Entry, ...], slots: int
) -> tuple[Entry, ...]:
    """What the entries of one row of `beside` are; {j} in a name stands for the neighbour."""
    found = list(own)
    for k in range(slots):
        who = f"neighbour {k}"
        found.append(Entry(f"1 if {who} is seen, else all of it is 0"))
        found += [Entry(e.name.replace("{j}", who), e.unit, e.frame) for e in seen]
    return tuple(found)
