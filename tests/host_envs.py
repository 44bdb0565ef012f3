"""Environments with PettingZoo's parallel interface for the tests of games outside JAX.

Nothing here needs PettingZoo: an environment is what has these methods.
"""

import os
import time

import numpy as np


class Box:
    def __init__(self, low, high, size):
        self.low, self.high = np.full(size, low, np.float32), np.full(size, high, np.float32)
        self.shape = (size,)


class Discrete:
    n = 5


class Walk:
    """Two agents of different sizes walk; `b` leaves at its third step, and both end or are cut.

    What an agent observes is its place, its agent's number and noise of the episode's seed.
    """

    possible_agents = ("a", "b")
    sizes = {"a": (2, 1), "b": (4, 3)}
    bounds = {"a": (0.0, 4.0), "b": (-1.0, 1.0)}

    def __init__(self, steps=5, leaves=3, ends=False, fault="", at=4, render_mode=None):
        self.steps, self.leaves, self.ends, self.fault, self.at = steps, leaves, ends, fault, at
        self.mode, self.agents, self.given = render_mode, [], []

    def observation_space(self, agent):
        return Box(-np.inf, np.inf, self.sizes[agent][0])

    def action_space(self, agent):
        return Box(*self.bounds[agent], self.sizes[agent][1])

    def reset(self, seed=None, options=None):
        self.rng, self.t, self.agents = np.random.default_rng(seed), 0, list(self.possible_agents)
        self.place = self.rng.uniform(-1, 1, 2)
        return {a: self._see(a) for a in self.agents}, {a: {} for a in self.agents}

    def _see(self, agent):
        size = self.sizes[agent][0]
        return np.array([self.place[0], self.t, *np.ones(9)][:size], np.float32)

    def step(self, actions):
        assert set(actions) == set(self.agents)
        self.t += 1
        self.given.append(actions)
        there = list(self.agents)
        self.place[0] += 0.1 * float(actions["a"][0] - 2.0)
        gone = {a: a == "b" and self.t >= self.leaves for a in there}
        over = self.t >= self.steps
        obs = {a: self._see(a) for a in there}
        reward = {a: 1.0 if a == "a" else 10.0 for a in there}
        ended = {a: gone[a] or (over and self.ends) for a in there}
        cut = {a: over and not ended[a] for a in there}
        self.agents = [] if over else [a for a in there if not gone[a]]
        info = {a: {"is_success": bool(self.place[0] > 0)} for a in there}
        if self.t == self.at:
            return self._go_wrong(obs, reward, ended, cut, info)
        return obs, reward, ended, cut, info

    def _go_wrong(self, obs, reward, ended, cut, info):
        if self.fault == "raises":
            raise ValueError("my bug")
        if self.fault == "nan":
            obs["a"][1] = np.nan
        if self.fault == "reward":
            reward["a"] = float("inf")
        if self.fault == "shape":
            obs["a"] = np.zeros(7)
        if self.fault == "type":
            obs["a"] = "text"
        if self.fault == "missing":
            del obs["a"]
        if self.fault == "hangs":
            time.sleep(600)
        if self.fault == "dies":
            os._exit(3)
        return obs, reward, ended, cut, info

    def state(self):
        return np.array([self.place[0], self.place[1], self.t])

    def render(self):
        return np.full((8, 8, 3), 20 * self.t, np.uint8) if self.mode else None

    def close(self):
        self.agents = []


class Alike(Walk):
    """The same with two equal agents that stay, and no state."""

    sizes = {"a": (3, 2), "b": (3, 2)}
    bounds = {"a": (-1.0, 1.0), "b": (-1.0, 1.0)}

    def __init__(self, **more):
        super().__init__(leaves=99, **more)

    def state(self):
        raise NotImplementedError


class Few(Walk):
    def action_space(self, agent):
        return Discrete()


class Endless(Walk):
    bounds = {"a": (0.0, np.inf), "b": (-1.0, 1.0)}


def walk(**more):
    return Walk(**more)


def alike(**more):
    return Alike(**more)


def few(**more):
    return Few(**more)


def endless(**more):
    return Endless(**more)


def broken(**more):
    raise RuntimeError("no display")


def number():
    return 3


three = 3
