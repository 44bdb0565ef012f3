"""Copies of an environment that knows of one episode at a time, side by side in this process."""

import abc
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from marlyap.errors import UserError, first_line
from marlyap.hosts.spec import (
    AbstractHostGame,
    Array,
    Bounds,
    Fault,
    Layout,
    Spec,
    Step,
    episode_seed,
    fault,
)


NOT_FINITE = "the {} holds a number that is not finite"


class View(NamedTuple):
    """What one copy tells after a step; each list has one entry an agent."""

    obs: Sequence[Any]  # arrays; None of an agent that is not there
    reward: Sequence[float]
    terminated: Sequence[bool]
    over: bool  # whether the episode is over
    cut: bool  # whether it was cut, and what would follow counts
    active: Sequence[bool]  # who was there when the step began
    success: float = float("nan")


class AbstractEnvironment(abc.ABC):
    """One copy of an environment."""

    @property
    @abc.abstractmethod
    def spec(self) -> Spec:
        """Its sizes."""

    @abc.abstractmethod
    def reset(self, seed: int) -> Sequence[Any]:
        """Begin an episode; returns the observation of each agent."""

    @abc.abstractmethod
    def step(self, action: Sequence[Array]) -> View:
        """One step; `action` is what each agent decides, within its bounds."""

    def state(self) -> Any:
        """The global state now; only asked where the sizes have one."""
        return np.zeros(0)

    def frame(self) -> Any:
        """What it looks like now, or None."""
        return None

    @abc.abstractmethod
    def close(self) -> None:
        """End it."""


class SideBySide(AbstractHostGame):
    """Copies in this process, one stepped after the other. They are numbered from `first`."""

    def __init__(self, make: Callable[[], AbstractEnvironment], copies: int, first: int = 0):
        self.games = [make() for _ in range(copies)]
        self.numbers, self.names = range(first, first + copies), self.spec.names
        self.layout, self.bounds = Layout(self.spec), Bounds(self.spec)
        self.rows = np.zeros((copies, self.layout.size), np.float32)
        self.seed, self.episode, self.time = 0, [0] * copies, [0] * copies

    @property
    def spec(self):
        return self.games[0].spec

    @property
    def copies(self):
        return len(self.numbers)

    def reset(self, seed, episodes):
        for _ in self.begin(seed, episodes):
            pass
        told = self.layout.read(self.rows)
        return told.obs.copy(), told.state.copy()

    def begin(self, seed: int, episodes: Sequence[int]) -> Iterator[Array]:
        """As `reset`, one copy after the other; yields the row of each."""
        self.seed, self.episode = seed, [int(k) for k in episodes]
        for i in range(len(self.games)):
            self._restart(i)
            yield self.rows[i]

    def step(self, action) -> Step:
        for _ in self.each(action):
            pass
        return self.layout.read(self.rows.copy())

    def each(self, action: Array) -> Iterator[Array]:
        """As `step`, one copy after the other; yields the row of each."""
        inputs = [x.copy() for x in self.bounds(action)]  # an environment may write into them
        for i in range(len(self.games)):
            self._step(i, [x[i] for x in inputs])
            yield self.rows[i]

    def frame(self):
        drawn = self.games[0].frame()
        return None if drawn is None else np.asarray(drawn, np.uint8)

    def close(self):
        for game in self.games:
            game.close()

    # ---- one copy ----

    def _restart(self, i: int) -> None:
        """Begin an episode: `obs` and `state` of the row."""
        self.time[i] = 0
        seed = episode_seed(self.seed, self.numbers[i], self.episode[i])
        obs = self._asked(i, lambda: self.games[i].reset(seed))
        self._observe(i, obs, 0, [True] * self.spec.agents)

    def _step(self, i: int, inputs: Sequence[Array]) -> None:
        self.time[i] += 1
        view = self._asked(i, lambda: self.games[i].step(inputs))
        reward, terminated, cut, active, success = (self.layout.parts[k] for k in (2, 3, 4, 5, 8))
        row = self.rows[i]
        self._observe(i, view.obs, 6, [there and o is not None for there, o in self._seen(view)])
        row[reward] = self._rewards(i, view)
        row[terminated], row[active] = view.terminated, view.active
        row[cut], row[success] = view.cut, view.success if view.over else np.nan
        if view.over:
            self.episode[i] += 1
            self._restart(i)
        else:
            row[self.layout.parts[0]] = row[self.layout.parts[6]]
            row[self.layout.parts[1]] = row[self.layout.parts[7]]

    def _seen(self, view: View) -> Iterator[tuple[bool, Any]]:
        return zip(view.active, view.obs, strict=True)

    def _asked(self, i: int, ask: Callable[[], Any]) -> Any:
        """What the copy answers; what it raises becomes a sentence."""
        try:
            return ask()
        except (Fault, KeyboardInterrupt):
            raise
        except _Agent as error:
            raise self._fault(i, error.what, error.agent) from error
        except UserError as error:
            raise self._fault(i, str(error).rstrip(".")) from error
        except Exception as error:  # whatever a user's environment may raise
            raise self._fault(i, f"it raised {first_line(error)}") from error

    def _observe(self, i: int, obs: Sequence[Any], part: int, there: Sequence[bool]) -> None:
        """Observations and state into the row, from part number `part` on."""
        row, spec = self.rows[i], self.layout.spec
        wide = row[self.layout.parts[part]].reshape(spec.agents, spec.obs)
        wide[:] = 0.0
        for k, side in enumerate(spec.sides):
            if there[k]:
                wide[k, : side.obs] = self._numbers(i, obs[k], side.obs, "observation", side.name)
        if not np.isfinite(wide).all():
            k = int(np.argmin(np.isfinite(wide).all(axis=1)))
            raise self._fault(i, NOT_FINITE.format("observation"), spec.names[k])
        if spec.state:
            state = self._numbers(i, self._asked(i, self.games[i].state), spec.state, "state", "")
            if not np.isfinite(state).all():
                raise self._fault(i, NOT_FINITE.format("state"))
            row[self.layout.parts[part + 1]] = state

    def _rewards(self, i: int, view: View) -> list[float]:
        found = []
        for name, reward in zip(self.names, view.reward, strict=True):
            number = float(self._numbers(i, reward, 1, "reward", name)[0])
            if not math.isfinite(number):
                raise self._fault(i, NOT_FINITE.format("reward"), name)
            found.append(number)
        return found

    def _numbers(self, i: int, value: Any, size: int, what: str, agent: str) -> Array:
        """The value as so many numbers."""
        try:
            numbers = np.asarray(value, np.float32).ravel()
        except (TypeError, ValueError):
            kind = type(value).__name__
            raise self._fault(i, f"the {what} is a {kind} and not numbers", agent) from None
        if numbers.size != size:
            shape = np.shape(value)
            raise self._fault(i, f"the {what} has shape {shape} and not {size} numbers", agent)
        return numbers

    def _fault(self, i: int, what: str, agent: str = "") -> Fault:
        return fault(self.numbers[i], self.time[i], what, agent)


class _Agent(Exception):
    """What an adapter found wrong with what one agent was told."""

    def __init__(self, agent: str, what: str):
        super().__init__(what)
        self.agent, self.what = agent, what


def missing(agent: str, what: str) -> Exception:
    """To be raised by an adapter where an agent was not told something."""
    return _Agent(agent, f"there is no {what}")
