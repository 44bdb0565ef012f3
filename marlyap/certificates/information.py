"""What a controller uses, found by changing what it should not see and watching its actions."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from marlyap.games.game import AbstractGame
from marlyap.simulation.rollout import Controller, Decentralised, rollout
from marlyap.types import Action, Key, State, by_agent


OWN = "each agent acts on its own observation"
NEIGHBOURS = "each agent acts on itself and its neighbours"
ROLLOUTS = 8
SIZES = (0.03, 0.3, 3.0)  # of the changes: small ones where a policy saturates, and large ones
CLOSE = 1e-5  # of an action in [-1, 1]; less is rounding


def information(game: AbstractGame, controller: Controller, key: Key) -> str:
    """What the agents act on, in words: `OWN`, `NEIGHBOURS`, or "NOT decentralised: ..." with why.

    In states along a few rollouts this changes, one after the other, the clock, every agent's goal,
    and the state of every agent, and compares the actions. No agent's action may change with the
    clock, with a goal that it is not told (a follower's own, or another agent's), or with an agent
    that it is not linked to. Of `Decentralised` it changes the rows of the observations instead:
    row i of the action may change with row i alone. What a task puts into its observations is for
    `check-task` to judge.

    What it does not find may still be there: a use of the clock after 3 horizons, or of memory.
    """
    k_roll, k_change = jax.random.split(key)
    states = _visited(game, controller, k_roll)
    if isinstance(controller, Decentralised):
        for i, j in _pairs(_rows(controller, states, k_change)):
            if i != j:
                return f"NOT decentralised: agent {i}'s action changes with agent {j}'s observation"
        return OWN
    clock = np.flatnonzero(_clock(game, controller, states))
    if len(clock):
        return f"NOT decentralised: agent {clock[0]}'s action changes with the time"
    for i, j in _pairs(_goals(game, controller, states, k_change)):
        if i != j:
            return f"NOT decentralised: agent {i}'s action changes with the target of agent {j}"
        if not game.leads[i]:
            return (
                f"NOT decentralised: agent {i}'s action changes with the target that it is not told"
            )
    for i, j in _pairs(_strangers(game, controller, states, k_change)):
        return (
            f"NOT decentralised: agent {i}'s action changes with agent {j}, which is not its "
            "neighbour"
        )
    return NEIGHBOURS


def _pairs(found: Any) -> list[tuple[int, int]]:
    return [(int(i), int(j)) for i, j in np.argwhere(np.asarray(found))]


@eqx.filter_jit
def _visited(game: AbstractGame, controller: Controller, key: Key) -> State:
    """States [visit] along some rollouts, their starts among them."""

    def one(key: Key) -> State:
        k_start, k_act = jax.random.split(key)
        seen = rollout(game, controller, game.reset(k_start), k_act).state
        times = np.unique(np.linspace(0, game.horizon, 5).astype(int))
        return jax.tree.map(lambda leaf: leaf[times], seen)

    seen = jax.vmap(one)(jax.random.split(key, ROLLOUTS))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), seen)


def _act(controller: Controller, state: State) -> Action:
    return controller(state, jax.random.key(0))


def _differ(a: Action, b: Action) -> Bool[Array, "agent"]:
    return jnp.any(jnp.abs(a - b) > CLOSE, axis=-1)


def _change(key: Key, like: Array) -> Array:
    """Three random changes of different sizes [3, *shape]."""
    sizes = jnp.asarray(SIZES).reshape(-1, *[1] * like.ndim)
    return sizes * jax.random.normal(key, (len(SIZES), *like.shape), like.dtype)


@eqx.filter_jit
def _clock(game: AbstractGame, controller: Controller, states: State) -> Bool[Array, "agent"]:
    """Whose action changes with t, in some state."""
    times = jnp.concatenate([jnp.arange(min(3 * game.horizon, 999) + 1), 10 ** jnp.arange(3, 7)])

    def one(state: State) -> Array:
        at = lambda t: _act(controller, eqx.tree_at(lambda s: s.t, state, t.astype(state.t.dtype)))
        # One time after the other: there are many, and a policy of many agents is large.
        return jnp.any(jax.lax.map(lambda t: _differ(at(t), at(times[0])), times), axis=0)

    return jnp.any(jax.vmap(one)(states), axis=0)


def _influence(
    states: State,
    key: Key,
    what: Callable[[State], Float[Array, "agent number"]],  # its rows are about agents
    affected: Callable[[State, Float[Array, "agent number"], Array], Bool[Array, "agent"]],
) -> Bool[Array, "agent agent"]:
    """[i, j]: agent i is `affected` by a change of row j of `what` a state holds, in some state.

    `affected(state, changed, j)` says for each agent whether its action differs.
    """

    def one(state: State, key: Key) -> Array:
        rows = what(state)
        changes = _change(key, rows)
        by = lambda j: lambda change: affected(state, rows.at[j].add(change[j]), j)
        each = lambda j: jnp.any(jax.vmap(by(j))(changes), axis=0)
        return jax.lax.map(each, jnp.arange(rows.shape[0])).T

    keys = jax.random.split(key, states.t.shape[0])
    return jnp.any(jax.vmap(one)(states, keys), axis=0)


@eqx.filter_jit
def _goals(
    game: AbstractGame, controller: Controller, states: State, key: Key
) -> Bool[Array, "agent agent"]:
    """[i, j]: agent i's action changes with row j of the scenario, in some state."""

    def affected(state: State, rows: Array, j: Array) -> Array:
        scenario = by_agent(state.scenario, game.agents)[1](rows)
        other = State(state.x, scenario, state.t, state.memory)
        return _differ(_act(controller, other), _act(controller, state))

    return _influence(states, key, lambda s: by_agent(s.scenario, game.agents)[0], affected)


@eqx.filter_jit
def _strangers(
    game: AbstractGame, controller: Controller, states: State, key: Key
) -> Bool[Array, "agent agent"]:
    """[i, j]: agent i's action changes with the state of agent j, to which it is not linked."""

    def affected(state: State, x: Array, j: Array) -> Array:
        other = State(by_agent(state.x, game.agents)[1](x), state.scenario, state.t, state.memory)
        linked = game.linked(state)
        alike = jnp.all(game.linked(other) == linked, axis=1)  # a disk may link others now
        stranger = ~linked[:, j] & (jnp.arange(game.agents) != j) & alike
        return _differ(_act(controller, other), _act(controller, state)) & stranger

    return _influence(states, key, lambda s: by_agent(s.x, game.agents)[0], affected)


@eqx.filter_jit
def _rows(controller: Decentralised, states: State, key: Key) -> Bool[Array, "agent agent"]:
    """[i, j]: row i of a policy's action changes with row j of the observations."""
    act = lambda obs: controller.policy(obs, jax.random.key(0))
    see = controller.game.observations
    affected = lambda state, obs, j: _differ(act(obs), act(see(state)))
    return _influence(states, key, see, affected)
