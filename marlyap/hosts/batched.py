"""Games whose library steps all copies at once."""

import abc
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marlyap.hosts.spec import AbstractHostGame, Array, Bounds, Spec, Step, fault


class Moved(NamedTuple):
    """What all copies tell after a step, before those that have ended begin anew."""

    obs: Sequence[Array]  # of each agent [copy number]
    reward: Array  # [copy agent]
    terminated: Array  # [copy] bool
    truncated: Array  # [copy] bool


class AbstractBatched(AbstractHostGame):
    """A subclass says how all copies move; which ended, and what is wrong, is seen to here."""

    def __init__(self, spec: Spec):
        self.made, self.bounds = spec, Bounds(spec)
        self.time = np.zeros(self.copies, int)
        self.episodes = np.zeros(self.copies, int)

    @property
    def spec(self):
        return self.made

    @abc.abstractmethod
    def begin(self, seed: int, episodes: Sequence[int]) -> Sequence[Array]:
        """Every copy begins an episode; what each agent observes [copy number]."""

    @abc.abstractmethod
    def move(self, action: list[Array]) -> Moved:
        """One step; of each agent, what it decides in every copy [copy number]."""

    @abc.abstractmethod
    def again(self, copies: Array, episodes: Array) -> Sequence[Array]:
        """These copies begin anew; what all agents of all copies observe then."""

    def reset(self, seed, episodes):
        self.time[:], self.episodes[:] = 0, episodes
        return self._wide(self.begin(seed, episodes)), self._no_state()

    def step(self, action):
        self.time += 1
        moved = self.move(self.bounds(action))
        final = self._wide(moved.obs)
        reward = np.asarray(moved.reward, np.float32)
        self._finite(reward, "reward")
        ended = moved.terminated | moved.truncated
        obs = final
        if ended.any():
            self.time[ended], self.episodes[ended] = 0, self.episodes[ended] + 1
            obs = self._wide(self.again(np.flatnonzero(ended), self.episodes))
        over = np.repeat(moved.terminated[:, None], self.spec.agents, axis=1)
        there, unsaid = np.ones_like(over), np.full(self.copies, np.nan, np.float32)
        cut = moved.truncated & ~moved.terminated
        none = self._no_state()
        return Step(obs, none, reward, over, cut, there, final, none, unsaid)

    def close(self):
        pass

    def _no_state(self) -> Array:
        return np.zeros((self.copies, 0), np.float32)

    def _wide(self, obs: Sequence[Array]) -> Array:
        """[copy agent obs], padded."""
        wide = np.zeros((self.copies, self.spec.agents, self.spec.obs), np.float32)
        for k, side in enumerate(self.spec.sides):
            wide[:, k, : side.obs] = np.asarray(obs[k]).reshape(self.copies, -1)
        self._finite(wide, "observation")
        return wide

    def _finite(self, told: Array, what: str) -> None:
        """Raise Fault for the first number that is not."""
        bad = ~np.isfinite(told.reshape(self.copies, self.spec.agents, -1)).all(axis=2)
        if bad.any():
            copy, agent = map(int, np.argwhere(bad)[0])
            said = f"the {what} holds a number that is not finite"
            raise fault(copy, int(self.time[copy]), said, self.spec.names[agent])
