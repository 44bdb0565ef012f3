"""The networked Markov game MG = <G, S, A, P, r, gamma> of section 2.1, for any physics.

S and A are products over agents, P is deterministic, and the discount gamma belongs to the
learning rule. Three abstract classes, each a kind of the one before:

    AbstractGame          anything that can be played: enough to train, evaluate and film
    AbstractRegulation    has a target set, where all errors are zero: certificates ask for it
    planar.AbstractPlanar robots in the plane, each with a goal
"""

import abc
import dataclasses
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from marlyap import graph as graphs
from marlyap.errors import UserError, whole_fields
from marlyap.games.physics import AbstractPlant
from marlyap.games.sensing import Sight
from marlyap.types import Action, Channel, Entry, Features, Key, Links, Obs, Scalar, Scene, State


AXES = ("ahead", "left", "up", "x", "y", "z")  # by which the names of a vector's entries differ


class AbstractGame(eqx.Module):
    """A task: where an episode starts, how it moves, what each agent sees, what it costs.

    Its fields are its parameters. Everything that evaluates, certifies, films or perturbs a game
    asks these methods and recomputes none of them.
    """

    agents: eqx.AbstractVar[int]
    graph: eqx.AbstractVar[str]
    dt: eqx.AbstractVar[float]  # s
    horizon: eqx.AbstractVar[int]  # steps; truncates, never terminates

    def __check_init__(self):
        whole_fields(self)
        n = self.agents
        if not 1 <= n <= 4096:
            raise UserError(f"agents: {n} is out of range; a team has 1 to 4096 agents.")
        if not 0 < self.dt <= 10:
            raise UserError(f"dt: {self.dt} s is out of range; take a step in (0, 10] seconds.")
        if not 1 <= self.horizon <= 100_000:
            raise UserError(f"horizon: {self.horizon} is out of range; take 1 to 100000 steps.")
        graphs.adjacency(self.graph, n)

    def __repr__(self) -> str:
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.init}
        return f"{type(self).__name__}({', '.join(f'{k}={v!r}' for k, v in values.items())})"

    # What a game has to say.

    @property
    @abc.abstractmethod
    def plant(self) -> AbstractPlant:
        """The one owner of the equations of motion: a field with a default, or a property."""

    @abc.abstractmethod
    def reset(self, key: Key) -> State:
        """The state an episode starts from, its scenario included."""

    @abc.abstractmethod
    def observe(self, state: State, links: Links) -> Obs:
        """o_i, row i made of agent i's own state and of those it is linked to (section 2.1).

        Take neighbours from `links`, never from `linked`: a wrapper that loses messages passes
        fewer links than the graph has. `sensing.beside` lays neighbours out.
        """

    @abc.abstractmethod
    def features(self, state: State) -> Features:
        """The global state s for the central critic, a row for each agent."""

    @abc.abstractmethod
    def costs(self, state: State, action: Action) -> Float[Array, "agent"]:
        """c_i(s, a) >= 0 and 0 on the target set; the team's cost c is their mean."""

    @abc.abstractmethod
    def distance(self, state: State) -> Float[Array, "agent"]:
        """How far each agent is from where it has to be, in `unit`; >= 0."""

    # What it may say.

    @property
    def edge(self) -> float:
        """The distance up to which an agent counts as arrived, in `unit`."""
        return 1.0

    @property
    def edge_cost(self) -> float:
        """What a step costs an agent at the edge of success: the scale of small costs.

        By default `edge`, as if the cost were the distance.
        """
        return self.edge

    @property
    def unit(self) -> str:
        """Of `distance` and `edge`; "tolerance" where distance counts in tolerances."""
        return "tolerance"

    def errors(self, state: State) -> Float[Array, "agent error"]:
        """Coordinates that are all zero exactly on the target set; none where there is none."""
        return jnp.zeros((self.agents, 0))

    @property
    def smooth(self) -> bool:
        """Whether costs are Lipschitz, as Assumption 1 has it; not where a grid makes them jump."""
        return True

    def rewards(self, state: State, action: Action) -> Float[Array, "agent"]:
        """r_i(s, a); the team's reward r is their mean."""
        return -self.costs(state, action)

    def terminated(self, state: State) -> Bool[Array, ""]:
        """Whether the game itself has ended here. The time limit `horizon` only truncates."""
        return jnp.asarray(False)

    def failed(self, state: State) -> Bool[Array, ""]:
        """Whether the team has failed for good: a collision, a collapse, out of bounds.

        A rollout freezes in such a state, and each further step costs every agent `failure_cost`.
        It is no success. It does not terminate, or ending early would pay.
        """
        return jnp.asarray(False)

    @property
    def failure_cost(self) -> float:
        """What each step after a failure costs every agent; more than any step before it."""
        return 0.0

    def violations(self, state: State) -> Bool[Array, "agent"]:
        """Which agents break a rule of the game in this state, such as a collision; here none.

        A violation neither ends an episode nor costs anything. It is counted beside success, and
        the certificate `safe` is about it.
        """
        return jnp.zeros(self.agents, bool)

    def hold(self, state: State) -> Action:
        """The actions that keep the team on the target set, once there; effort counts from them."""
        return jnp.zeros((self.agents, self.du))

    def scene(self, state: State) -> Scene | None:
        """Bodies in space; None for a game without a map, of which `signals` are drawn."""
        return None

    def signals(self, state: State) -> dict[str, Float[Array, "agent"]]:
        """Name with unit -> a number of each agent, to draw. Default: the plant's states."""
        named = enumerate(self.plant.states)
        return {f"{e.name} ({e.unit})": state.x[: self.agents, k] for k, e in named}

    def resized(self, agents: int) -> "AbstractGame":
        """The same game with another number of agents.

        Raises UserError for a number, or a game, that does not allow it.
        """
        return dataclasses.replace(self, agents=agents)  # pyright: ignore

    def strengthened(self, gain: float | Array) -> "AbstractGame":
        """The same game with inputs `gain` times as strong: the plant's limits are scaled."""
        limits = lambda game: game.plant.limits
        return eqx.tree_at(limits, self, tuple(gain * u for u in limits(self)))

    def farther(self, state: State, factor: float | Array) -> State:
        """A start that lies `factor` times as far out."""
        raise UserError(
            f"spread: the starts of {type(self).__name__} cannot be moved; leave out spread."
        )

    def pushed(self, state: State, size: float | Array, key: Key) -> State:
        """The state after a push: all rates of each agent jump by +-`size`, in their units."""
        raise UserError(
            f"push: the agents of {type(self).__name__} cannot be pushed; leave it out."
        )

    def retargeted(self, state: State, size: float | Array, key: Key) -> State:
        """The state with the target anywhere in [-size, size]^2 (m)."""
        raise UserError(f"jump: the target of {type(self).__name__} cannot jump; leave it out.")

    def lasting(self, horizon: int) -> "AbstractGame":
        """The same game with episodes of so many steps."""
        return dataclasses.replace(self, horizon=horizon)  # pyright: ignore

    def beneath(self, change: Callable[["AbstractGame"], "AbstractGame"]) -> "AbstractGame":
        """`change` of this game; of one behind a shield, the same shield before `change` of it.

        What disturbs a plant (noise, weak motors, delays) does so after the shield has decided.
        """
        return change(self)

    def underway(self, state: State) -> Float[Array, "delay agent du"]:
        """The actions that were asked for and have no effect yet, the next one first."""
        return jnp.zeros((0, self.agents, self.du))

    def aside(self, state: State, gone: Bool[np.ndarray, "agent"]) -> State:
        """The state with those that are `gone` out of everybody's way."""
        return state

    @property
    def leads(self) -> Bool[np.ndarray, "agent"]:
        """Which agents are told their own target; all, unless the game says otherwise."""
        return np.ones(self.agents, bool)

    @property
    def kinds(self) -> Int[np.ndarray, "agent"]:
        """Which kind each agent is of, from 0: agents of one kind may share weights."""
        return np.zeros(self.agents, int)

    def state_shapes(self, state: State) -> dict[str, tuple[Any, tuple[int, ...]]]:
        """Arrays of a state by name, each with the shape it must have."""
        return {"t": (state.t, ())}

    def observation_entries(self) -> tuple[Entry, ...]:
        """Name, unit and frame of every entry of an observation; empty where the task tells none.

        Neighbours come in ascending order of their number; an agent with fewer has empty places.
        """
        return ()

    def error_entries(self) -> tuple[Entry, ...]:
        """Name, unit and frame of every error."""
        return ()

    @property
    def nominal(self) -> "AbstractGame":
        """The same without what a wrapper lets go wrong: what a team is deployed in."""
        return self

    def sight(self) -> Sight | None:
        """How a robot makes its own observation; None where only the game can make it."""
        return None

    # What follows from that; final.

    def observations(self, state: State) -> Obs:
        """What every agent sees in this state, over the links that this game has there."""
        return self.observe(state, self.linked(state))

    def channels(self) -> tuple[Channel, ...]:
        """The entries of an observation, those side by side that differ in their axis as one.

        Their sizes add up to that of an observation; where a task tells no entries there is none.
        """
        found: list[Channel] = []
        for entry in self.observation_entries():
            stem, _, last = entry.name.rpartition(", ")
            alike = Channel(stem if last in AXES else entry.name, 1, entry.unit, entry.frame)
            if last in AXES and found and found[-1]._replace(size=1) == alike:
                found[-1] = found[-1]._replace(size=found[-1].size + 1)
            else:
                found.append(alike)
        return tuple(found)

    def step(self, state: State, action: Action) -> State:
        """s_{t+1} = f(s_t, a_t) for actions in [-1, 1] (Assumption 2)."""
        u, time = self.plant.inputs_of(action), state.t * self.dt
        x = self.plant.step(state.x, u, state.scenario, time, self.dt)
        return State(x=x, scenario=state.scenario, t=state.t + 1, memory=state.memory)

    def cost(self, state: State, action: Action) -> Scalar:
        """c(s, a), the mean over agents (Assumption 1)."""
        return jnp.mean(self.costs(state, action))

    def miss(self, state: State) -> Float[Array, "agent"]:
        """How far each agent is from where it has to be; 1 at the edge of success."""
        return self.distance(state) / self.edge

    def success(self, state: State) -> Bool[Array, ""]:
        """No agent is beyond the edge, and nothing failed: the one definition of success."""
        return jnp.all(self.distance(state) <= self.edge) & ~self.failed(state)

    def positions(self, state: State) -> Float[Array, "agent d"]:
        """Where the agents are (m).

        Raises UserError where the game has no map.
        """
        scene = self.scene(state)
        if scene is None:
            raise UserError(f"scene: {type(self).__name__} has no map; return a Scene to have one.")
        return scene.position[: self.agents]

    def crowded(self, state: State, gap: float) -> Bool[Array, "agent"]:
        """Which agents are closer than `gap` (m) to another one: a rule for `violations`."""
        p = self.positions(state)
        apart = jnp.linalg.norm(p[:, None] - p[None, :], axis=-1)
        return jnp.any((apart < gap) & ~jnp.eye(self.agents, dtype=bool), axis=1)

    def entries(self) -> dict[str, tuple[Entry, ...]]:
        """Name, unit and frame of every entry of an observation, a state, an action and an error.

        An action is in [-1, 1]; multiplied by the limit it has the unit that is told.
        """
        u = (
            Entry(f"{e.name} / {limit:g}", e.unit, e.frame)
            for e, limit in zip(self.plant.inputs, self.plant.limits, strict=True)
        )
        return {
            "observation": self.observation_entries(),
            "state": self.plant.states,
            "action": tuple(u),
            "error": self.error_entries(),
        }

    @property
    def du(self) -> int:
        """Inputs of one agent."""
        return len(self.plant.inputs)

    @property
    def informed(self) -> tuple[int, ...]:
        """The agents that are told their own target."""
        return tuple(int(i) for i in np.flatnonzero(self.leads))

    @property
    def adjacency(self) -> Bool[np.ndarray, "agent agent"]:
        """Which pairs may interact; for a proximity disk, all."""
        return _adjacency(self.graph, self.agents)

    @property
    def slots(self) -> Int[np.ndarray, "agent slot"]:
        """Each agent's neighbours that it observes, in ascending order, padded with -1."""
        return graphs.neighbours(self.adjacency, graphs.room(self.graph))

    def linked(self, state: State) -> Links:
        """Which pairs interact in this state: row i says whom agent i sees."""
        linked = jnp.asarray(self.adjacency)
        reach = graphs.disk_radius(self.graph)
        if reach is None:
            return linked
        p = self.positions(state)
        return linked & (jnp.linalg.norm(p[:, None] - p[None, :], axis=-1) <= reach)


class Tolerance(NamedTuple):
    """One error: its name, its unit, and how large it may be at a success."""

    name: str
    unit: str
    most: float = float("inf")  # inf: not judged
    frame: str = ""


class AbstractRegulation(AbstractGame):
    """A game with a target set, {errors = 0}: what certificates and Lyapunov terms ask for."""

    @property
    @abc.abstractmethod
    def tolerances(self) -> tuple[Tolerance, ...]:
        """Name, unit and tolerance of each error."""

    @abc.abstractmethod
    def errors(self, state: State) -> Float[Array, "agent error"]:
        """Coordinates that are all zero exactly on the target set, in the units of `tolerances`."""

    @abc.abstractmethod
    def at_target(self, state: State) -> State:
        """The same episode with everything on the target set."""

    def distance(self, state: State) -> Float[Array, "agent"]:
        """The largest of an agent's errors, each in units of its tolerance."""
        most = jnp.array([e.most for e in self.tolerances])
        return jnp.max(jnp.abs(self.errors(state)) / most[None], axis=1)

    def features(self, state: State) -> Features:
        """The errors, and those that are judged once more, magnified: e / (|e| + tolerance)."""
        errors = self.errors(state)
        judged = np.flatnonzero(np.isfinite([e.most for e in self.tolerances]))
        most = jnp.array([self.tolerances[k].most for k in judged])
        some = errors[:, judged]
        return jnp.concatenate([errors, some / (jnp.abs(some) + most[None])], axis=1)

    def farther(self, state: State, factor: float | Array) -> State:
        """The start with its distances from the target set multiplied by `factor`."""
        away = lambda there, x: there + factor * (x - there)
        x = jax.tree.map(away, self.at_target(state).x, state.x)
        return eqx.tree_at(lambda s: s.x, state, x)

    def error_entries(self):
        return tuple(Entry(e.name, e.unit, e.frame) for e in self.tolerances)


def regulated(game: AbstractGame) -> AbstractRegulation:
    """The game, where it has a target set.

    Raises UserError where it has none.
    """
    if not isinstance(game, AbstractRegulation):
        raise UserError(
            f"task: {type(game).__name__} has no target set in closed form, which certificates "
            "need; derive it from AbstractRegulation and say what its errors are."
        )
    return game


@lru_cache(maxsize=64)
def _adjacency(graph: str, n: int) -> Bool[np.ndarray, "agent agent"]:
    return graphs.adjacency(graph, n)
