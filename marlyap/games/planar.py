"""Robots in the plane, all with the same dynamics, each with a goal that only leaders are told."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from marlyap.errors import UserError, whole_fields
from marlyap.games.dynamics import AbstractDynamics, Independent
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.sensing import Sight, body_frame, body_frame_entries, into_frame, near
from marlyap.types import Entry, Links, Obs, Scene, State


class Goals(eqx.Module):
    """The scenario of a planar game."""

    goal: Float[Array, "agent 2"]  # where each agent has to be (m); constant in an episode


class AbstractPlanar(AbstractRegulation):
    """A planar task says where an episode starts, what each agent sees and what it costs.

    The dynamics, the graph and the judgement (distance, success, violations) are given, and may be
    replaced. Its scenario has to hold `goal`, as `Goals` does, unless it replaces `goals`.
    """

    leaders: eqx.AbstractVar[tuple[int, ...]]
    radius: eqx.AbstractVar[float]  # an agent has arrived when it is this close to its goal (m)
    dynamics: eqx.AbstractVar[AbstractDynamics]

    def __check_init__(self):
        whole_fields(self)
        if not 0 < self.radius < 1e6:
            raise UserError(f"radius: {self.radius} m must be a positive distance in metres.")
        check_leaders(self.leaders, self.agents)

    @property
    def plant(self) -> Independent:
        return Independent(self.dynamics)  # pyright: ignore

    @property
    def edge(self):
        return self.radius

    @property
    def unit(self):
        return "m"

    @property
    def leads(self) -> Bool[np.ndarray, "agent"]:
        """Which agents know their goal."""
        return np.isin(np.arange(self.agents), self.leaders)

    @property
    def tolerances(self) -> tuple[Tolerance, ...]:
        d = self.dynamics
        units = dict(zip(d.names, d.units, strict=False))
        gap = (Tolerance(f"goal - position, {way}", "m", self.radius, "own") for way in WAYS)
        return (*gap, *(Tolerance(name, units.get(name, "?"), frame="own") for name in d.felt))

    def goals(self, state: State) -> Float[Array, "agent 2"]:
        """Where each agent has to be in this state (m); may depend on scenario and t.

        Raises UserError if the scenario holds no `goal`.
        """
        if not hasattr(state.scenario, "goal"):
            raise UserError(
                f"scenario: {type(self).__name__} puts no goal into it; return scenario=Goals("
                "goal) from reset, or override goals(state)."
            )
        return state.scenario.goal

    def positions(self, state):
        return jax.vmap(self.dynamics.position)(state.x)

    def distance(self, state):
        """How far each agent is from its goal (m)."""
        return jnp.linalg.norm(self.positions(state) - self.goals(state), axis=1)

    def costs(self, state, action):
        return self.distance(state)

    def errors(self, state):
        """Per agent: goal - p_i in its own frame, and its rates."""

        def of(x, goal):
            to_goal = into_frame(self.dynamics.heading(x), goal - self.dynamics.position(x))
            return jnp.concatenate([to_goal, self.dynamics.rates(x)])

        return jax.vmap(of)(state.x, self.goals(state))

    def features(self, state):
        """Per agent its errors, the way to the goal magnified near it, and its heading."""
        errors = self.errors(state)
        heading = jax.vmap(self.dynamics.heading)(state.x)
        return jnp.concatenate([errors, near(errors[:, :2], self.radius), heading], axis=1)

    def at_target(self, state):
        """The same episode with every agent at rest on its goal, headings as they were."""
        angle = state.x[:, 2] if "psi" in self.dynamics.names else jnp.zeros(self.agents)
        x = jax.vmap(self.dynamics.rest)(self.goals(state), angle)
        return eqx.tree_at(lambda s: s.x, state, x)

    def motion(self, state: State) -> Float[Array, "agent"]:
        """How much each agent moves: the sum of its squared rates, such as v^2 + omega^2."""
        return jnp.sum(jax.vmap(self.dynamics.rates)(state.x) ** 2, axis=1)

    def strengthened(self, gain):
        limits = lambda game: game.dynamics.limits
        return eqx.tree_at(limits, self, tuple(gain * u for u in limits(self)))

    def farther(self, state, factor):
        """The start with positions `factor` times as far from the origin."""
        return eqx.tree_at(lambda s: s.x, state, state.x.at[:, :2].multiply(factor))

    def pushed(self, state, size, key):
        rates = jnp.array(self.dynamics.blocks[0])
        sign = jax.random.rademacher(key, (self.agents, len(rates)), state.x.dtype)
        return eqx.tree_at(lambda s: s.x, state, state.x.at[:, rates].add(size * sign))

    def retargeted(self, state, size, key):
        """The goals moved together, so that their mean is drawn anew."""
        middle = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0) * size
        goal = state.scenario.goal
        goal = goal + (middle - jnp.mean(goal, axis=0))[None]
        return eqx.tree_at(lambda s: s.scenario.goal, state, goal)

    @property
    def displacements(self) -> Float[np.ndarray, "agent 2"]:
        """Where each agent's goal lies from the common centre (m), as all of them know beforehand.

        Raises UserError where a follower cannot tell its place from that of its neighbour.
        """
        raise UserError(
            f"displacements: the followers of {type(self).__name__} cannot tell their places from "
            "their neighbours'; say how they lie in `displacements`."
        )

    def aside(self, state, gone):
        away = jnp.where(jnp.asarray(gone), 1e4 * (1 + jnp.arange(self.agents)), 0.0)
        return eqx.tree_at(lambda s: s.x, state, state.x.at[:, :2].add(away[:, None]))

    def scene(self, state):
        h = jax.vmap(self.dynamics.heading)(state.x)
        left = jnp.stack([-h[:, 1], h[:, 0]], axis=1)
        return Scene(
            position=self.positions(state),
            velocity=jax.vmap(self.dynamics.velocity)(state.x),
            frame=jnp.stack([h, left], axis=1) if "psi" in self.dynamics.names else None,
            goal=self.goals(state),
            spin=jax.vmap(self.dynamics.turning)(state.x),
        )

    def state_shapes(self, state):
        x = {"x": (state.x, (self.agents, self.dynamics.dx))}
        return super().state_shapes(state) | x | {"goals": (self.goals(state), (self.agents, 2))}

    def resized(self, agents):
        """The same team with more or fewer agents; leaders that are no longer there are dropped."""
        leaders = tuple(i for i in self.leaders if i < agents)
        return dataclasses.replace(self, agents=agents, leaders=leaders)  # pyright: ignore

    def local_view(self, state: State, links: Links, headings: bool = False) -> Obs:
        """The usual o_i: everything near agent i in its own frame (`sensing.body_frame`)."""
        slots, leads = jnp.asarray(self.slots), jnp.asarray(self.leads)
        goals = self.goals(state)
        return body_frame(self.dynamics, state.x, goals, slots, links, leads, self.radius, headings)

    def local_sight(self, headings: bool = False) -> Sight:
        """How a robot makes its row of `local_view` itself: for `sight`."""
        return Sight(self.radius, headings, np.zeros((self.agents, 2)))

    def local_entries(self, headings: bool = False) -> tuple[Entry, ...]:
        """What the entries of `local_view` are: for `observation_entries`."""
        return body_frame_entries(self.dynamics, self.slots.shape[1], headings)


def check_leaders(leaders: tuple[int, ...], agents: int) -> None:
    """Raise UserError unless leaders are named, each once and each an agent."""
    if len(set(leaders)) != len(leaders):
        raise UserError(f"leaders: {leaders} names an agent twice.")
    if not leaders or not all(0 <= i < max(agents, 1) for i in leaders):
        raise UserError(
            f"leaders: {leaders} must name at least one agent, each from 0 to {agents - 1}."
        )


WAYS = ("ahead", "left")
