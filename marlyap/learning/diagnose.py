"""Where did numbers stop being finite? Asked afterwards, so that training pays nothing for it."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from marlyap.learning.training import AbstractTrainer, Carry
from marlyap.nets.nets import Actors


def diagnose(trainer: AbstractTrainer, carry: Carry, iteration: int) -> str | None:
    """Replay from `carry` until an iteration past which an array of the learner is not finite.

    Says which array, in which update, and of which agent where the actors have their own; None if
    all stays finite up to `iteration`. The carry that goes in is used up.
    """
    while int(carry.iteration) < iteration:
        now = int(carry.iteration) + 1
        carry, marks = _watched(trainer, carry)
        table = np.stack([np.asarray(mark) for mark in marks], axis=1)  # [update, array]
        if (table >= 0).any():
            update = int(np.argmax((table >= 0).any(axis=1)))
            column = int(np.argmax(table[update] >= 0))
            networks = trainer.algorithm.networks(carry.learner)
            path, leaf = _numbers(networks)[column]
            who = _agent(networks, trainer.agents, path, leaf, int(table[update, column]))
            return f"{_words(path)}{who} in update {update + 1} of iteration {now}"
    return None


@eqx.filter_jit(donate="all-except-first")
def _watched(trainer: AbstractTrainer, carry: Carry) -> tuple[Carry, list[Int[Array, "update"]]]:
    after, info = trainer.iterate(carry, first_faults)
    return after, info.seen


def _numbers(networks: PyTree) -> list[tuple[str, Array]]:
    """The arrays of the networks by their path: the optimisers' memories first, as gradients do."""
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(networks, eqx.is_inexact_array))
    named = [(jax.tree_util.keystr(path), leaf) for path, leaf in leaves]
    return sorted(named, key=lambda pair: ".mu" not in pair[0])


def first_faults(networks: PyTree) -> list[Int[Array, ""]]:
    """For every array the flat index of its first number that is not finite, or -1."""
    return [_first(leaf) for _, leaf in _numbers(networks)]


def _first(leaf: Array) -> Int[Array, ""]:
    bad = ~jnp.isfinite(leaf.ravel())
    return jnp.where(jnp.any(bad), jnp.argmax(bad), -1)


def _words(path: str) -> str:
    """What an array is, told from its path: Adam's first memory is that of the gradients."""
    kind = "the gradient of" if ".memory" in path else "the parameter"
    return f"{kind} {re.sub(r'[.]value|[.]memory|[.]mu|[.]nu', '', path).lstrip('.')}"


def _agent(networks: PyTree, agents: int, path: str, leaf: Array, index: int) -> str:
    """The agent, where the actors have a leading axis of agents."""
    parts = jax.tree.leaves(networks, is_leaf=lambda x: isinstance(x, Actors))
    own = any(isinstance(x, Actors) and x.shared is False for x in parts)  # None in the optimiser's
    if not path.startswith(".pi") or not own or leaf.ndim == 0 or len(leaf) != agents:
        return ""
    return f" of agent {index // (leaf.size // agents)}"
