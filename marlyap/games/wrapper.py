"""A game around another game: whatever is not changed is asked of the one inside."""

import abc
import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Int

from marlyap.games.dynamics import AbstractDynamics
from marlyap.games.game import AbstractGame, AbstractRegulation
from marlyap.games.physics import AbstractPlant
from marlyap.types import State


class AbstractWrapper(AbstractRegulation):
    """`inner` with something added. A policy made for `inner` fits, and sees what it saw.

    Every method of `inner` is asked, with the state as `inner` knows it, so that whatever a task
    replaces is what is played. What is added is remembered in the state's memory, beside the memory
    of `inner`.
    """

    inner: eqx.AbstractVar[AbstractRegulation]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "inner":
            raise AttributeError(name)
        return getattr(self.inner, name)

    @abc.abstractmethod
    def outside(self, inside: State, state: State) -> State:
        """A state of the game inside, with what this one remembers in `state`."""

    def inside(self, state: State) -> State:
        """The state as the game inside knows it."""
        memory = state.memory["inner"]
        return State(x=state.x, scenario=state.scenario, t=state.t, memory=memory)

    @property
    def slots(self) -> Int[np.ndarray, "agent slot"]:
        """Those of the game inside: the shape of what agents see stays."""
        return self.inner.slots

    @property
    def plant(self) -> AbstractPlant:
        return self.inner.plant

    @property
    def dynamics(self) -> AbstractDynamics:
        """Of a planar game."""
        return self.inner.dynamics  # pyright: ignore

    @property
    def adjacency(self) -> Bool[np.ndarray, "agent agent"]:
        return self.inner.adjacency

    @property
    def failure_cost(self):
        return self.inner.failure_cost

    @property
    def edge(self):
        return self.inner.edge

    @property
    def edge_cost(self):
        return self.inner.edge_cost

    @property
    def unit(self):
        return self.inner.unit

    @property
    def smooth(self):
        return self.inner.smooth

    @property
    def tolerances(self):
        return self.inner.tolerances

    @property
    def leads(self):
        return self.inner.leads

    @property
    def kinds(self):
        return self.inner.kinds

    def strengthened(self, gain):
        return dataclasses.replace(self, inner=self.inner.strengthened(gain))

    def resized(self, agents):
        return dataclasses.replace(self, inner=self.inner.resized(agents))

    def lasting(self, horizon):
        return dataclasses.replace(self, inner=self.inner.lasting(horizon))

    @property
    def nominal(self):
        return self.inner.nominal

    def sight(self):
        return self.inner.sight()

    def observation_entries(self):
        return self.inner.observation_entries()

    def error_entries(self):
        return self.inner.error_entries()

    def linked(self, state):
        return self.inner.linked(self.inside(state))

    def underway(self, state):
        return self.inner.underway(self.inside(state))

    def observe(self, state, links):
        return self.inner.observe(self.inside(state), links)

    def features(self, state):
        return self.inner.features(self.inside(state))

    def terminated(self, state):
        return self.inner.terminated(self.inside(state))

    def failed(self, state):
        return self.inner.failed(self.inside(state))

    def hold(self, state):
        return self.inner.hold(self.inside(state))

    def costs(self, state, action):
        return self.inner.costs(self.inside(state), action)

    def rewards(self, state, action):
        return self.inner.rewards(self.inside(state), action)

    def distance(self, state):
        return self.inner.distance(self.inside(state))

    def errors(self, state):
        return self.inner.errors(self.inside(state))

    def success(self, state):
        return self.inner.success(self.inside(state))

    def violations(self, state):
        return self.inner.violations(self.inside(state))

    def at_target(self, state):
        return self.outside(self.inner.at_target(self.inside(state)), state)

    def farther(self, state, factor):
        return self.outside(self.inner.farther(self.inside(state), factor), state)

    def pushed(self, state, size, key):
        return self.outside(self.inner.pushed(self.inside(state), size, key), state)

    def retargeted(self, state, size, key):
        return self.outside(self.inner.retargeted(self.inside(state), size, key), state)

    def aside(self, state, gone):
        return self.outside(self.inner.aside(self.inside(state), gone), state)

    def scene(self, state):
        return self.inner.scene(self.inside(state))

    def signals(self, state):
        return self.inner.signals(self.inside(state))

    def positions(self, state):
        return self.inner.positions(self.inside(state))


def plain_game(game: AbstractGame) -> AbstractGame:
    """The game inside all that wraps it."""
    return plain_game(game.inner) if isinstance(game, AbstractWrapper) else game
