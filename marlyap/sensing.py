"""What an agent sees: everything in its own frame, so that neither compass nor map is needed.

A turn or a shift of the whole scene changes nothing (SE(2) invariance), and nothing but the
agent itself and its neighbours enters (locality).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from marlyap.dynamics import AbstractDynamics
from marlyap.types import Obs, State


class Entry(NamedTuple):
    """One number of an observation, a state or an action: enough to build it elsewhere."""

    name: str
    unit: str  # 1 where it has none
    frame: str  # own: the agent's own axes; world; or nothing, where no axis is meant


def into_frame(h: Float[Array, "2"], v: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """World vectors in the frame whose first axis is the unit vector h: R(-psi) v."""
    along = v[..., 0] * h[0] + v[..., 1] * h[1]
    left = v[..., 1] * h[0] - v[..., 0] * h[1]
    return jnp.stack([along, left], axis=-1)


def near(v: Float[Array, "*n 2"], scale: float) -> Float[Array, "*n 2"]:
    """v / (|v| + scale): the direction far away, and close by a magnified v.

    A network fed with metres alone cannot tell centimetres apart.
    """
    length = jnp.sqrt(jnp.sum(v * v, axis=-1, keepdims=True) + 1e-12)
    return v / (length + scale)


def body_frame(
    dynamics: AbstractDynamics,
    state: State,
    slots: Int[Array, "agent slot"],
    linked: Bool[Array, "agent agent"],
    leads: Bool[Array, "agent"],
    scale: float,
    headings: bool,
) -> Obs:
    """Per agent: own rates; leader flag and goal - p_i (0 for a follower); for every neighbour slot
    a presence flag, p_j - p_i, the velocity of j, and, if asked, the heading of j.

    Positions are given in metres and again magnified near zero, at `scale` metres. Empty slots
    are all zero.
    """
    p = jax.vmap(dynamics.position)(state.x)
    h = jax.vmap(dynamics.heading)(state.x)
    v = jax.vmap(dynamics.velocity)(state.x)
    rates = jax.vmap(dynamics.rates)(state.x)

    def of(i, slot, lead):
        there = (slot >= 0) & linked[i, slot]
        gap = into_frame(h[i], p[slot] - p[i][None])
        seen = [gap, near(gap, scale), into_frame(h[i], v[slot])]
        if headings:
            seen.append(into_frame(h[i], h[slot]))
        flag = there.astype(p.dtype)[:, None]
        others = jnp.where(there[:, None], jnp.concatenate([flag, *seen], axis=1), 0.0)
        to_goal = jnp.where(lead, into_frame(h[i], state.goal[i] - p[i]), 0.0)
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


def goal_errors(dynamics: AbstractDynamics, state: State) -> Float[Array, "agent error"]:
    """Per agent: goal - p_i in its own frame and its rates; all zero exactly on the target set."""

    def of(x, goal):
        to_goal = into_frame(dynamics.heading(x), goal - dynamics.position(x))
        return jnp.concatenate([to_goal, dynamics.rates(x)])

    return jax.vmap(of)(state.x, state.goal)
