"""What of a trained team a bundle can say: the networks, how a robot sees, how it moves."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from marlyap import graph
from marlyap.deploy.plant import MOTIONS
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.nets.nets import Actors, Greedy


# Of each state: which entry is the heading, which the speed along it, which the velocity in the
# world; which the robot feels of its motion.
SENSES: dict[str, dict[str, Any]] = {
    "Unicycle": dict(heading=2, along=3, velocity=[], rates=[3, 4]),
    "LateUnicycle": dict(heading=2, along=3, velocity=[], rates=[3, 4, 5, 6]),
    "DoubleIntegrator": dict(heading=None, along=None, velocity=[2, 3], rates=[2, 3]),
    "SingleIntegrator": dict(heading=None, along=None, velocity=[], rates=[]),
}
MODULE = "marlyap.games.dynamics"  # where these motions come from
SLOWS = {"v": "a", "omega": "r", "vx": "ax", "vy": "ay"}  # the input that brakes a state


def actors(policy: Any) -> Actors:
    """The networks of a policy.

    Raises UserError, which names the policy, for one that a bundle cannot express.
    """
    kind, pi = type(policy).__name__, policy.pi if type(policy) is Greedy else None
    if type(pi) is not Actors:
        inner = kind if pi is None else f"{kind} of {type(pi).__name__}"
        raise UserError(
            f"export: a policy of kind {inner} is not one network for each agent, which bundles "
            "can express; train with masac, maddpg, decentralised-sac or apg, or write one."
        )
    if any(layer.norm is not None for layer in pi.net.layers):
        raise UserError("export: an actor with LayerNorm is unknown to bundles; train without.")
    return pi


def networks(pi: Actors, agents: int) -> tuple[dict[str, np.ndarray], list[str]]:
    """The weights by name, and the name of each agent's network. Only the mean's outputs stay."""
    match pi.shared:
        case True:
            which, pick = [0] * agents, lambda a, net: np.asarray(a)
        case False:
            which, pick = list(range(agents)), lambda a, net: np.asarray(a[net])
        case kinds:
            which, pick = list(kinds), lambda a, net: np.asarray(a[net])
    arrays, last = {}, len(pi.net.layers) - 1
    for net in sorted({*which}):
        for k, layer in enumerate(pi.net.layers):
            rows = slice(0, pi.du) if k == last else slice(None)
            arrays[f"net{net}.{k}.weight"] = pick(layer.weight, net)[rows]
            arrays[f"net{net}.{k}.bias"] = pick(layer.bias, net)[rows]
    return arrays, [f"net{net}" for net in which]


def sight(game: AbstractGame) -> dict[str, Any] | None:
    """How the robots make their observations; None where only the game can.

    None also for a game with motions that bundles do not know, or a step of its own.
    """
    found, kind = game.sight(), game.plant.moves.__name__
    own_step = type(game).step is not AbstractGame.step
    if found is None or own_step or kind not in MOTIONS or game.plant.moves.__module__ != MODULE:
        return None
    senses = SENSES[kind]
    return {
        "scale": found.scale,
        "headings": found.headings,
        "message": 6 if found.headings else 4,
        **senses,
        "reach": graph.disk_radius(game.graph),  # m; None: neighbours are heard wherever they are
    }


def brake(game: AbstractGame, robots: bool) -> list[list[float]]:
    """The fallback as a matrix [input, state]: what stops a robot within a period; zeros else."""
    states, inputs = [s.name for s in game.plant.states], [u.name for u in game.plant.inputs]
    gain = np.zeros((len(inputs), len(states)))
    for state, u in SLOWS.items():
        if robots and state in states and u in inputs:
            gain[inputs.index(u), states.index(state)] = -1 / game.dt
            if u in states:  # it is under way, and acts first
                gain[inputs.index(u), states.index(u)] = -1.0
    return gain.tolist()


def shifts(game: AbstractGame) -> list[list[list[float]]]:
    """Of each agent and slot, what is added to the gap to that neighbour (m)."""
    found = game.sight()
    places = np.zeros((game.agents, 2)) if found is None else np.asarray(found.places)
    return [
        [(places[i] - places[j]).tolist() if j >= 0 else [0.0, 0.0] for j in row]
        for i, row in enumerate(game.slots)
    ]


def messages(game: Any, x: np.ndarray) -> np.ndarray:
    """What every robot tells [episode, agent, 6], by the game's own dynamics."""
    d = game.dynamics
    tell = lambda x: jnp.concatenate([d.position(x), d.velocity(x), d.heading(x)])
    return np.asarray(jax.jit(jax.vmap(jax.vmap(tell)))(jnp.asarray(x)))
