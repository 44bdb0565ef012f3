"""Scenarios of VMAS, which steps all copies at once in PyTorch.

VMAS draws from one stream for all copies, so episodes follow from the seed and from how many copies
there are, not from a seed of their own.
"""

import importlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from marlyap.hosts.adapters import made, side
from marlyap.hosts.batched import AbstractBatched, Moved
from marlyap.hosts.spec import Array, Spec, episode_seed


class Vmas(AbstractBatched):
    """A scenario with continuous actions, cut after 100 steps unless `max_steps` says otherwise."""

    def __init__(self, library: Any, source: str, copies: int, arguments: Mapping[str, Any]):

        self.tensor, self.count = importlib.import_module("torch").as_tensor, copies
        usual = {"max_steps": 100, "device": "cpu", "continuous_actions": True}
        given = usual | {k: v for k, v in arguments.items() if k != "render_mode"}
        make = lambda **more: library.make_env(
            source.partition(":")[2], num_envs=copies, terminated_truncated=True, **more
        )
        self.env: Any = made(source, make, given)
        spaces = zip(
            self.env.agents, self.env.observation_space, self.env.action_space, strict=True
        )
        sides = tuple(side(agent.name, seen, decided) for agent, seen, decided in spaces)
        super().__init__(Spec(source, sides, 0))

    @property
    def copies(self):
        return self.count

    def begin(self, seed, episodes):
        # All copies draw from one stream: the first copy's episode stands for all.
        return self._array(self.env.reset(seed=episode_seed(seed, 0, episodes[0])))

    def move(self, action):
        given = [self.tensor(one.copy()) for one in action]
        obs, reward, terminated, truncated, _ = self.env.step(given)
        rewards = np.stack([r.numpy() for r in reward], axis=1)
        return Moved(self._array(obs), rewards, terminated.numpy(), truncated.numpy())

    def again(self, copies, episodes):
        for c in copies:
            self.env.reset_at(int(c))
        return self._array(self.env.get_from_scenario(True, False, False, False)[0])

    def frame(self):
        return self.env.render(mode="rgb_array", visualize_when_rgb=False)

    def _array(self, obs: Any) -> list[Array]:
        return [o.numpy().astype(np.float32) for o in obs]
