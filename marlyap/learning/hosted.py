"""A game that is played outside JAX, as data: what run.json holds of it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.errors import UserError, check_range
from marlyap.hosts.opening import open_game
from marlyap.hosts.sources import parsed
from marlyap.hosts.spec import AbstractHostGame, Spec
from marlyap.nets.nets import Shape
from marlyap.simulation.rollout import Policy, act_alone


class HostPolicy(eqx.Module):
    """A policy for a game outside JAX, to be called wherever the agents are."""

    policy: Policy
    game: "Hosted"

    def __call__(self, obs: Float[np.ndarray, "agent obs"]) -> Float[Array, "agent du"]:
        """What all agents do, in [-1, 1]; rows of small agents are padded with zeros."""
        return self.policy(jnp.asarray(obs, jnp.float32), jax.random.key(0))

    def agent(self, agent: int, obs: Float[np.ndarray, "own"]) -> Float[Array, "du"]:
        """What one agent does at its own observation alone, in [-1, 1], without padding.

        Raises UserError for an agent that there is not, or a policy that sees what others observe.
        """
        row = jnp.zeros(max(self.game.observed)).at[: len(obs)].set(jnp.asarray(obs, jnp.float32))
        return act_alone(self.policy, self.game.agents, agent, row)[: self.game.decided[agent]]


class Hosted(eqx.Module):
    """The word that names it, what it is made with, and how it is played."""

    source: str  # as in pettingzoo:mpe2.simple_spread_v3
    arguments: tuple[str, ...] = ()  # for whoever makes the environment: name=value
    workers: int = 0  # processes that the copies are divided among; 0: they are in this one
    rollout: int = 16  # steps of every copy between two rounds of learning
    patience: float = 120.0  # seconds that a process may take for a step
    names: tuple[str, ...] = ()  # of the agents; these three are found when it is opened
    observed: tuple[int, ...] = ()  # numbers that each observes
    decided: tuple[int, ...] = ()  # numbers that each decides
    state: int = 0  # numbers of the global state; found when it is opened

    def __check_init__(self):
        check_range("workers", self.workers, 0, 1024)
        check_range("rollout", self.rollout, 1, 100_000)
        check_range("patience", self.patience, 0, 1e6, open=True)
        parsed(self.arguments)

    @property
    def agents(self) -> int:
        return len(self.names)

    @property
    def parts(self) -> int:
        """Numbers of an agent's row of the global state; the last row is padded."""
        return -(-self.state // max(self.agents, 1))

    @property
    def shape(self) -> Shape:
        """What an algorithm may know of it. The critic sees all observations, and the state."""
        obs, du = max(self.observed), max(self.decided)
        uneven = self.decided if len({*self.decided}) > 1 else ()
        return Shape(self.agents, obs, obs + self.parts, 0, du, self._kinds(), uneven)

    def _kinds(self) -> tuple[int, ...]:
        """Agents of equal sizes are of one kind."""
        sizes = list(zip(self.observed, self.decided, strict=True))
        order = list(dict.fromkeys(sizes))
        return tuple(order.index(size) for size in sizes)

    def rows(self, state: np.ndarray) -> np.ndarray:
        """Global states [*axes state] as a row for each agent [*axes agent part]."""
        wide = np.zeros((*state.shape[:-1], self.agents * self.parts), np.float32)
        wide[..., : self.state] = state
        return wide.reshape(*state.shape[:-1], self.agents, self.parts)

    def open(self, copies: int, **more: object) -> AbstractHostGame:
        """So many copies of it; `more` are further arguments for whoever makes it.

        Raises UserError where it cannot be made, or is not what it was.
        """
        arguments = parsed(self.arguments) | more
        game = open_game(self.source, copies, self.workers, arguments, self.patience)
        if self.names and (found := self._with(game.spec)) != self:
            game.close()
            raise UserError(
                f"task: {self.source} has agents {found.names} that observe {found.observed} and "
                f"decide {found.decided} numbers; this run was made with {self.names}, "
                f"{self.observed} and {self.decided}; use the versions that run.json names."
            )
        return game

    def filmed(self) -> AbstractHostGame:
        """One copy in this process that draws its frames. Raises UserError where it cannot."""
        here = dataclasses.replace(self, workers=0)
        try:
            return here.open(1, render_mode="rgb_array")
        except UserError as error:
            raise UserError(f"{str(error).rstrip('.')}, asked to draw (render_mode).") from error

    def opened(self) -> "Hosted":
        """The same with the sizes that it has."""
        bare = dataclasses.replace(self, names=(), observed=(), decided=(), state=0)
        game = dataclasses.replace(bare, workers=0).open(1)
        game.close()
        return self._with(game.spec)

    def _with(self, spec: Spec) -> "Hosted":
        return dataclasses.replace(
            self,
            names=spec.names,
            observed=tuple(side.obs for side in spec.sides),
            decided=tuple(side.du for side in spec.sides),
            state=spec.state,
        )

    def entries(self) -> dict[str, tuple]:
        """Nothing is known of what its numbers mean."""
        return {}
