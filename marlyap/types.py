"""The pytrees that cross the seams, each for one sample; a batch is made by `jax.vmap`.

Axis names used throughout: `agent`, `time`, `dx` (state of one agent), `du` (input of one
agent), `obs` (what one agent sees), `feature` (what the central critic sees of one agent),
`body` (what is drawn in space, agents first), `d` (dimensions of that space).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree


Key = PRNGKeyArray
Keys = jaxtyping.Key[Array, "episode"]
Scalar = Float[Array, ""]
Action = Float[Array, "agent du"]
Obs = Float[Array, "agent obs"]
Links = Bool[Array, "agent agent"]
Features = Float[Array, "agent feature"]
Rows = Callable[[Float[Array, "agent number"]], PyTree]


class Entry(NamedTuple):
    """One number of an observation, a state, an action or an error: enough to rebuild it."""

    name: str
    unit: str = "1"  # 1 where it has none
    frame: str = ""  # own: the agent's own axes; world; empty where no axis is meant


class Channel(NamedTuple):
    """Neighbouring entries of an observation that belong together, such as the two of a place."""

    name: str
    size: int
    unit: str
    frame: str


class State(eqx.Module):
    """Everything a game knows at one instant; an episode can be replayed from its first state.

    `x` and `scenario` are the game's own pytrees. What is about agents has the agent axis first.
    """

    x: PyTree  # what the plant moves, in the units of `plant.states`
    scenario: PyTree  # drawn by `reset`, constant in an episode: goals, loads, parameters, a key
    t: Int[Array, ""]  # steps since the start
    memory: PyTree = None  # what else is carried from step to step: inputs under way, past values


class Scene(eqx.Module):
    """Bodies in space, agents first: for films, proximity graphs, speeds and distances."""

    position: Float[Array, "body d"]  # m; d is 1 (a road), 2 or 3
    velocity: Float[Array, "body d"]  # m/s
    frame: Float[Array, "body d d"] | None = None  # rows: the body's own axes
    goal: Float[Array, "agent d"] | None = None  # m; None where no place has to be reached
    spin: Float[Array, "body"] | None = None  # rad/s; None where the state does not hold it
    # Pairs of bodies that a rod joins; the second is drawn in the colour of the first.
    rods: tuple[tuple[int, int], ...] = eqx.field(default=(), static=True)


class Transition(eqx.Module):
    """One tuple of the replay memory D: Algorithm 1's (s, a, r, s'), and what L needs.

    `reward` sums n steps and `next_*` lies n steps ahead when the algorithm asks for n-step
    returns; `discount` is gamma**n, and 0 once the game has terminated (a time limit does not
    terminate it).
    """

    obs: Obs
    features: Features
    action: Action
    log_prob: Float[Array, "agent"]  # of the action, under the policy that took it
    reward: Float[Array, "agent"]  # the team's reward is the mean
    cost: Float[Array, "agent"]  # c(s_t, a_t); the team's cost is the mean
    next_obs: Obs
    next_features: Features
    discount: Float[Array, "*agent_or_none"]  # of each agent where they may leave one by one
    cost_to_go: Float[Array, "agent"]  # L_target, the sum of the next T costs
    cost_ahead: Float[Array, "agent"]  # c_{t+T}
    noise: Float[Array, "agent 2 du"]  # standard normal, for the actions drawn at s and at s'


class Trajectory(eqx.Module):
    """What a game produced while a controller drove it, time-major."""

    action: Float[Array, "time agent du"]
    reward: Float[Array, "time agent"]
    cost: Float[Array, "time agent"]
    state: State  # leaves have a leading axis time + 1
    terminated: Bool[Array, "time"]  # the game ended at or before the end of this step
    failed: Bool[Array, "time"]  # the game failed at or before the end of this step


def by_agent(tree: PyTree, agents: int) -> tuple[Float[Array, "agent number"], Rows]:
    """The floats in the tree that are about agents, a row for each, and the way back.

    About agents is every array of floats whose first axis is as long as the team.
    """
    leaves, structure = jax.tree.flatten(tree)
    about = [
        k for k, x in enumerate(leaves) if eqx.is_inexact_array(x) and x.shape[:1] == (agents,)
    ]
    flat = [leaves[k].reshape(agents, -1) for k in about]
    ends = np.cumsum([x.shape[1] for x in flat])[:-1]

    def put(rows: Float[Array, "agent number"]) -> PyTree:
        new = list(leaves)
        for k, part in zip(about, jnp.split(rows, ends, axis=1) if about else [], strict=True):
            new[k] = part.reshape(leaves[k].shape)
        return jax.tree.unflatten(structure, new)

    return jnp.concatenate(flat, axis=1) if flat else jnp.zeros((agents, 0)), put
