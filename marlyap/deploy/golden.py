"""Golden pairs: inputs of every robot with the commands that the trained policy gives in JAX.

Absent neighbours, a missing goal, numbers that are not finite and a state that is too old are among
them, with the fallback that is due.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap.deploy import express
from marlyap.games.game import AbstractGame
from marlyap.simulation.rollout import Decentralised
from marlyap.types import State


PAIRS = 192  # for each robot, a fourth of them with a fault
FAULTS = 48
ANY = 1.5  # how far states may lie from those that were played, in their spread

Arrays = dict[str, np.ndarray]


@eqx.filter_jit
def _decided(
    game: AbstractGame, controller: Decentralised, states: State, links: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Observations and commands in their units, over these links."""

    def one(state, links):
        obs = game.observe(state, links)
        return obs, game.plant.inputs_of(controller.policy(obs, jax.random.key(0)))

    return jax.vmap(one)(states, links)


def drawn(
    game: AbstractGame, controller: Decentralised, states: State, seed: int
) -> dict[str, Any]:
    """These states [episode], links that are missing at random, what is seen and done there.

    Robots in the plane are moved at random from there, since a bundle has to be right anywhere.
    """
    rng, count = np.random.default_rng(seed), states.t.shape[0]
    if express.sight(game) is not None:
        x = np.asarray(states.x)
        far = ANY * np.maximum(x.std(axis=(0, 1)), 0.5) * rng.standard_normal(x.shape)
        moved = np.where(rng.random((count, 1, 1)) < 0.5, x, x + far).astype(np.float32)
        states = eqx.tree_at(lambda s: s.x, states, jnp.asarray(moved))
    links = rng.random((count, game.agents, game.agents)) < 0.75
    links[::3] = True
    links &= np.asarray(jax.vmap(game.linked)(states))
    obs, command = _decided(game, controller, states, jnp.asarray(links))
    return {"states": states, "links": links, "obs": obs, "command": np.asarray(command)}


def inputs(game: AbstractGame, found: dict[str, Any], i: int) -> Arrays:
    """What robot i is given in these states: see `Role.command`."""
    count = len(found["links"])
    given = {"age": np.zeros(count, np.float32), "command": found["command"][:, i]}
    given["fallback"] = np.zeros(count, np.uint8)
    sight = express.sight(game)
    if sight is None:
        return given | {"own": np.array(found["obs"][:, i])}
    x = np.array(found["states"].x)
    told = express.messages(game, x)[..., : sight["message"]]
    slots = np.asarray(game.slots[i])
    present = (slots >= 0)[None] & found["links"][:, i][:, slots]
    goals = jax.vmap(game.goals)(found["states"])  # pyright: ignore[reportAttributeAccessIssue]
    given |= {"own": x[:, i], "goal": np.array(goals)[:, i], "neighbours": told[:, slots]}
    leads = bool(game.leads[i])
    given |= {"present": present.astype(np.uint8), "told": np.full(count, leads, np.uint8)}
    return given


def spoilt(given: Arrays, contract: dict[str, Any], leads: bool) -> Arrays:
    """The same with faults in the last FAULTS pairs, and the fallback that is due there."""
    given, first = {k: np.array(v) for k, v in given.items()}, len(given["own"]) - FAULTS
    wrong, dx = (np.nan, np.inf, -np.inf), given["own"].shape[1]
    robots, late = contract["sight"] is not None, 1.5 * contract["timing"]["max_own_age"]
    for k in range(first, len(given["own"])):
        n, value = k - first, wrong[k % 3]
        due = True
        if n < 20:
            given["own"][k, n % dx] = value
        elif n < 28:
            given["age"][k] = (late, np.nan, np.inf)[k % 3]
        elif robots and n < 36 and leads:
            given["told"][k] = n % 2
            given["goal"][k, n // 2 % 2] = value
        elif robots and given["present"].shape[1]:
            absent = np.flatnonzero(given["present"][k] == 0)
            slot = absent[0] if n % 2 and len(absent) else n % given["present"].shape[1]
            due = bool(given["present"][k, slot])  # what is absent may hold anything
            given["neighbours"][k, slot, n % given["neighbours"].shape[2]] = value
        else:
            due = False
        given["fallback"][k] = due
        if due:
            given["command"][k] = _brake(contract, given["own"][k]) if robots else 0.0
    return given


def _brake(contract: dict[str, Any], own: np.ndarray) -> np.ndarray:
    """The fallback of one robot, number by number."""
    limits = [c["limit"] for c in contract["action"]["channels"]]
    known = [float(v) if np.isfinite(v) else 0.0 for v in own]
    asked = [
        sum(g * v for g, v in zip(row, known, strict=True)) for row in contract["fallback"]["gain"]
    ]
    return np.array([max(-m, min(m, u)) for u, m in zip(asked, limits, strict=True)], np.float32)


def pairs(
    game: AbstractGame, controller: Decentralised, contract: dict[str, Any], states: State
) -> Arrays:
    """All golden pairs, as `agent_0.own` and so on, from the first PAIRS of these states."""
    found = drawn(game, controller, jax.tree.map(lambda leaf: leaf[:PAIRS], states), seed=1)
    arrays = {}
    for i, role in enumerate(contract["roles"]):
        given = spoilt(inputs(game, found, i), contract, bool(role.get("leads")))
        arrays |= {f"{role['name']}.{k}": v for k, v in given.items()}
    return arrays
