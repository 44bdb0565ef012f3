"""The same game, disturbed: what a controller meets that it was not made for."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from marlyap import graph as graphs
from marlyap.dynamics import AbstractDynamics
from marlyap.errors import UserError
from marlyap.game import AbstractGame
from marlyap.seeds import branch
from marlyap.types import State


class Perturbed(AbstractGame):
    """`inner` with stronger or weaker inputs, noise, delay, lost messages, agents or edges.

    A controller made for `inner` drives it unchanged. Agents that are gone are seen by nobody and
    judged by nobody. What is drawn at random (noise, lost messages) follows from a seed that
    `reset` leaves in the state's memory, and the actions under way lie there too.
    """

    inner: AbstractGame
    gain: float | Array = 1.0  # the inputs have this many times their nominal effect
    noise: float | Array = 0.0  # standard deviation of what is added to each action in [-1, 1]
    delay: int = 0  # steps until an action has its effect; until then there is none
    drop: float | Array = 0.0  # probability that in a step an agent does not see a neighbour
    gone: tuple[int, ...] = ()  # agents that are missing
    cut: tuple[tuple[int, int], ...] = ()  # edges that are missing
    spread: float | Array = 1.0  # starts lie this many times as far out

    def __check_init__(self):
        if not 0 < self.gain < 100 or not 0 < self.spread < 100:
            raise UserError("perturbation: gain and spread must lie between 0 and 100.")
        if not 0 <= self.noise < 100 or not 0 <= self.drop <= 1 or not 0 <= self.delay <= 1000:
            raise UserError("perturbation: noise, delay and drop must not be negative, drop <= 1.")
        missing = {*self.gone, *(i for edge in self.cut for i in edge)}
        if not missing <= set(range(self.inner.agents)):
            raise UserError(f"perturbation: {sorted(missing)} names an agent that is not there.")

    # What the game inside says.
    agents = property(lambda self: self.inner.agents)  # pyright: ignore[reportAssignmentType]
    leaders = property(lambda self: self.inner.leaders)  # pyright: ignore[reportAssignmentType]
    graph = property(lambda self: self.inner.graph)  # pyright: ignore[reportAssignmentType]
    radius = property(lambda self: self.inner.radius)  # pyright: ignore[reportAssignmentType]
    dt = property(lambda self: self.inner.dt)  # pyright: ignore[reportAssignmentType]
    horizon = property(lambda self: self.inner.horizon)  # pyright: ignore[reportAssignmentType]

    @property
    def slots(self) -> Int[np.ndarray, "agent slot"]:
        """Those of the game inside: the shape of what agents see stays."""
        return self.inner.slots

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "inner":
            raise AttributeError(name)
        return getattr(self.inner, name)

    @property
    def dynamics(self) -> AbstractDynamics:
        nominal = self.inner.dynamics
        limits = tuple(self.gain * u for u in nominal.limits)
        return eqx.tree_at(lambda d: d.limits, nominal, limits) if _on(self.gain - 1) else nominal

    @property
    def present(self) -> Bool[np.ndarray, "agent"]:
        return ~np.isin(np.arange(self.agents), self.gone)

    @property
    def adjacency(self) -> Bool[np.ndarray, "agent agent"]:
        """The edges that are left."""
        linked = self.inner.adjacency & self.present[:, None] & self.present[None, :]
        for a, b in self.cut:
            linked[a, b] = linked[b, a] = False
        return linked

    def linked(self, state: State) -> Bool[Array, "agent agent"]:
        linked = self.inner.linked(state) & jnp.asarray(self.adjacency)
        if not _on(self.drop) or state.memory is None:
            return linked
        key = jax.random.fold_in(self._key(state, 1), state.t)
        return linked & ~jax.random.bernoulli(key, self.drop, linked.shape)

    def reset(self, key):
        start = self.inner.reset(key)
        if start.memory is not None:
            raise UserError("perturbation: this game keeps a memory of its own; perturb it inside.")
        x = start.x.at[:, :2].multiply(self.spread)
        seed = jax.random.key_data(branch(key, "perturb"))
        queue = jnp.zeros((self.delay, self.agents, self.dynamics.du))
        return State(x=x, goal=start.goal, t=start.t, memory={"seed": seed, "queue": queue})

    def observe(self, state):
        # The game inside reads its own method, with this game's `linked`.
        return type(self.inner).observe(self, state)  # pyright: ignore[reportArgumentType]

    def step(self, state, action):
        queue = jnp.concatenate([state.memory["queue"], action[None]])
        now, key = queue[0], jax.random.fold_in(self._key(state, 2), state.t)
        if _on(self.noise):
            now = now + self.noise * jax.random.normal(key, now.shape)
        after = type(self.inner).step(self, state, now)  # pyright: ignore[reportArgumentType]
        memory = state.memory | {"queue": queue[1:]}
        return State(x=after.x, goal=after.goal, t=after.t, memory=memory)

    def distance(self, state):
        return jnp.where(jnp.asarray(self.present), self.inner.distance(state), 0.0)

    def costs(self, state, action):
        return jnp.where(jnp.asarray(self.present), self.inner.costs(state, action), 0.0)

    def errors(self, state):
        return jnp.where(jnp.asarray(self.present)[:, None], self.inner.errors(state), 0.0)

    def _key(self, state: State, purpose: int) -> Array:
        return jax.random.fold_in(jax.random.wrap_key_data(state.memory["seed"]), purpose)


def traced(game: Perturbed) -> Perturbed:
    """The same with its numbers as arrays, so that jit compiles once for all of their values."""
    numbers = lambda g: (g.gain, g.noise, g.drop, g.spread)
    return eqx.tree_at(numbers, game, tuple(jnp.asarray(float(x)) for x in numbers(game)))


def _on(x: float | Array) -> bool:
    return not isinstance(x, (int, float)) or x != 0


def edge_to_cut(game: AbstractGame) -> tuple[int, int] | None:
    """The last edge without which the graph is still connected; else the last edge, if any."""
    linked = game.adjacency
    edges = [(int(a), int(b)) for a, b in np.argwhere(np.triu(linked))]
    for a, b in reversed(edges):
        without = linked.copy()
        without[a, b] = without[b, a] = False
        if (graphs.hops(without, (0,)) >= 0).all():
            return a, b
    return edges[-1] if edges else None


def follower_to_lose(game: AbstractGame) -> int | None:
    """The last agent that is no leader, if any."""
    others = [i for i in range(game.agents) if i not in game.leaders]
    return others[-1] if others else None
