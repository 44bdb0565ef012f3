"""The networked Markov game MG = <G, S, A, P, r, gamma> of section 2.1.

S and A are products over agents, P is deterministic, and the discount gamma belongs to the
learning rule.
"""

import abc
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from marlyap import graph as graphs
from marlyap.dynamics import AbstractDynamics
from marlyap.errors import UserError
from marlyap.sensing import Entry, body_frame, body_frame_entries, goal_errors, near
from marlyap.types import Action, Features, Key, Links, Obs, Scalar, State


class AbstractGame(eqx.Module):
    """A task says where an episode starts and what each agent sees.

    Its fields are its parameters. The dynamics, the graph and the judgement (cost, reward,
    success, violations) are given, and may be replaced. Everything that evaluates, certifies,
    films or perturbs a game asks these methods and recomputes none of them.
    """

    agents: eqx.AbstractVar[int]
    leaders: eqx.AbstractVar[tuple[int, ...]]
    graph: eqx.AbstractVar[str]
    radius: eqx.AbstractVar[float]
    dt: eqx.AbstractVar[float]
    horizon: eqx.AbstractVar[int]
    dynamics: eqx.AbstractVar[AbstractDynamics]

    def __check_init__(self):
        n = self.agents
        if not 1 <= n <= 4096:
            raise UserError(f"agents: {n} is out of range; a team has 1 to 4096 agents.")
        if not 0 < self.dt <= 10:
            raise UserError(f"dt: {self.dt} s is out of range; take a step in (0, 10] seconds.")
        if not 1 <= self.horizon <= 100_000:
            raise UserError(f"horizon: {self.horizon} is out of range; take 1 to 100000 steps.")
        if not 0 < self.radius < 1e6:
            raise UserError(f"radius: {self.radius} m must be a positive distance in metres.")
        if len(set(self.leaders)) != len(self.leaders):
            raise UserError(f"leaders: {self.leaders} names an agent twice.")
        if not self.leaders or not all(0 <= i < n for i in self.leaders):
            raise UserError(
                f"leaders: {self.leaders} must name at least one agent, each from 0 to {n - 1}."
            )
        graphs.adjacency(self.graph, n)

    @abc.abstractmethod
    def reset(self, key: Key) -> State:
        """The state an episode starts from."""

    @abc.abstractmethod
    def observe(self, state: State, links: Links) -> Obs:
        """o_i, row i made of agent i's own state and of those it is linked to (section 2.1).

        Take neighbours from `links`, never from `linked`: a wrapper that loses messages passes
        fewer links than the graph has.
        """

    def observations(self, state: State) -> Obs:
        """What every agent sees in this state, over the links that this game has there."""
        return self.observe(state, self.linked(state))

    def distance(self, state: State) -> Float[Array, "agent"]:
        """How far each agent is from where it has to be (m)."""
        return jnp.linalg.norm(self.positions(state) - state.goal, axis=1)

    def errors(self, state: State) -> Float[Array, "agent error"]:
        """Coordinates that are all zero exactly on the target set."""
        return goal_errors(self.dynamics, state)

    def features(self, state: State) -> Features:
        """The global state s up to a shift, for the central critic.

        Per agent its errors, the same magnified near the goal, and its heading.
        """
        errors = self.errors(state)
        heading = jax.vmap(self.dynamics.heading)(state.x)
        return jnp.concatenate([errors, near(errors[:, :2], self.radius), heading], axis=1)

    def costs(self, state: State, action: Action) -> Float[Array, "agent"]:
        """c_i(s, a) >= 0 and 0 on the target set; the team's cost c is their mean."""
        return self.distance(state)

    def rewards(self, state: State, action: Action) -> Float[Array, "agent"]:
        """r_i(s, a); the team's reward r is their mean."""
        return -self.costs(state, action)

    def terminated(self, state: State) -> Bool[Array, ""]:
        """Whether the game itself has ended here. The time limit `horizon` only truncates."""
        return jnp.asarray(False)

    def step(self, state: State, action: Action) -> State:
        """s_{t+1} = f(s_t, a_t) for actions in [-1, 1] (Assumption 2)."""
        x = jax.vmap(lambda x, a: self.dynamics.step(x, a, self.dt))(state.x, action)
        return State(x=x, goal=state.goal, t=state.t + 1, memory=state.memory)

    def cost(self, state: State, action: Action) -> Scalar:
        """c(s, a), the mean over agents (Assumption 1)."""
        return jnp.mean(self.costs(state, action))

    def success(self, state: State) -> Bool[Array, ""]:
        """Every agent is within `radius` of its goal: the one definition of success."""
        return jnp.all(self.distance(state) <= self.radius)

    def violations(self, state: State) -> Bool[Array, "agent"]:
        """Which agents break a rule of the game in this state, such as a collision; here none.

        A violation neither ends an episode nor costs anything. It is counted beside success, and
        the certificate `safe` is about it.
        """
        return jnp.zeros(self.agents, bool)

    def crowded(self, state: State, gap: float) -> Bool[Array, "agent"]:
        """Which agents are closer than `gap` (m) to another one: a rule for `violations`."""
        p = self.positions(state)
        apart = jnp.linalg.norm(p[:, None] - p[None, :], axis=-1)
        return jnp.any((apart < gap) & ~jnp.eye(self.agents, dtype=bool), axis=1)

    def motion(self, state: State) -> Float[Array, "agent"]:
        """How much each agent moves: the sum of its squared rates, such as v^2 + omega^2."""
        return jnp.sum(jax.vmap(self.dynamics.rates)(state.x) ** 2, axis=1)

    def strengthened(self, gain: float | Array) -> "AbstractGame":
        """The same game with inputs `gain` times as strong: its dynamics' limits are scaled.

        A game whose `step` takes its limits from elsewhere has to replace this too.
        """
        limits = lambda game: game.dynamics.limits
        return eqx.tree_at(limits, self, tuple(gain * u for u in limits(self)))

    def positions(self, state: State) -> Float[Array, "agent 2"]:
        """Where the agents are (m)."""
        return jax.vmap(self.dynamics.position)(state.x)

    def local_view(self, state: State, links: Links, headings: bool = False) -> Obs:
        """The usual o_i: everything near agent i in its own frame (`sensing.body_frame`)."""
        slots, leads = jnp.asarray(self.slots), jnp.asarray(self.leads)
        return body_frame(self.dynamics, state, slots, links, leads, self.radius, headings)

    def local_entries(self, headings: bool = False) -> tuple[Entry, ...]:
        """What the entries of `local_view` are: for `observation_entries`."""
        return body_frame_entries(self.dynamics, self.slots.shape[1], headings)

    def observation_entries(self) -> tuple[Entry, ...]:
        """Name, unit and frame of every entry of an observation; empty where the task tells none.

        Neighbours come in ascending order of their number; an agent with fewer has empty places.
        """
        return ()

    def entries(self) -> dict[str, tuple[Entry, ...]]:
        """Name, unit and frame of every entry of an observation, a state and an action.

        An action is in [-1, 1]; multiplied by the limit it has the unit that is told.
        """
        d = self.dynamics
        units = d.units or ("?",) * len(d.names)
        input_units = d.input_units or ("?",) * len(d.inputs)
        x = (Entry(name, unit, "world") for name, unit in zip(d.names, units, strict=True))
        u = (
            Entry(f"{name} / {limit:g}", unit, "own")
            for name, limit, unit in zip(d.inputs, d.limits, input_units, strict=True)
        )
        return {"observation": self.observation_entries(), "state": tuple(x), "action": tuple(u)}

    @property
    def adjacency(self) -> Bool[np.ndarray, "agent agent"]:
        """Which pairs may interact; for a proximity disk, all."""
        return _adjacency(self.graph, self.agents)

    @property
    def slots(self) -> Int[np.ndarray, "agent slot"]:
        """Each agent's neighbours that it observes, in ascending order, padded with -1."""
        return graphs.neighbours(self.adjacency, graphs.room(self.graph))

    @property
    def leads(self) -> Bool[np.ndarray, "agent"]:
        """Which agents know their goal."""
        return np.isin(np.arange(self.agents), self.leaders)

    def linked(self, state: State) -> Links:
        """Which pairs interact in this state: row i says whom agent i sees."""
        linked = jnp.asarray(self.adjacency)
        reach = graphs.disk_radius(self.graph)
        if reach is None:
            return linked
        p = self.positions(state)
        return linked & (jnp.linalg.norm(p[:, None] - p[None, :], axis=-1) <= reach)


@lru_cache(maxsize=64)
def _adjacency(graph: str, n: int) -> Bool[np.ndarray, "agent agent"]:
    return graphs.adjacency(graph, n)
