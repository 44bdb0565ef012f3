"""Environments of JaxMARL: all copies are stepped by one compiled program.

JaxMARL tells one merged end of an episode, from which a cut at the time limit is told by the step
count (`max_steps` of the environment), and begins anew by itself, which is undone by `step_env`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from marlyap.hosts.adapters import made, side
from marlyap.hosts.batched import AbstractBatched, Moved
from marlyap.hosts.spec import Array, Spec, episode_seed


class JaxMarl(AbstractBatched):
    """An environment with continuous actions."""

    def __init__(self, library: Any, source: str, copies: int, arguments: Mapping[str, Any]):
        import jax

        self.jax, self.count = jax, copies
        given = {k: v for k, v in arguments.items() if k != "render_mode"}
        if "MPE_" in source:
            given = {"action_type": "Continuous"} | given
        make = lambda **more: library.make(source.partition(":")[2], **more)
        self.env: Any = made(source, make, given)
        names = self.env.agents
        spaces = [(a, self.env.observation_space(a), self.env.action_space(a)) for a in names]
        self.most = getattr(self.env, "max_steps", None)
        self.reset_all = jax.jit(jax.vmap(self.env.reset))
        self.step_all = jax.jit(jax.vmap(self.env.step_env))
        pick = lambda new, a, b: jax.numpy.where(new.reshape(-1, *[1] * (a.ndim - 1)), a, b)
        self.mix = jax.jit(lambda new, a, b: jax.tree.map(lambda x, y: pick(new, x, y), a, b))
        self.seed, self.state, self.draws = 0, None, 0
        super().__init__(Spec(source, tuple(side(*one) for one in spaces), 0))

    @property
    def copies(self):
        return self.count

    def begin(self, seed, episodes):
        self.seed, self.draws = seed, 0
        obs, self.state = self.reset_all(self._keys(episodes))
        return self._rows(obs)

    def move(self, action):
        given = dict(zip(self.env.agents, action, strict=True))
        self.draws += 1
        key = self.jax.random.fold_in(self.jax.random.key(self.seed), self.draws)
        keys = self.jax.random.split(key, self.count)
        obs, self.state, reward, done, _ = self.step_all(keys, self.state, given)
        over = np.asarray(done["__all__"])
        late = self.time >= self.most if self.most else np.zeros_like(over)
        rewards = np.stack([np.asarray(reward[a]) for a in self.env.agents], axis=1)
        self.last = obs
        return Moved(self._rows(obs), rewards, over & ~late, over & late)

    def again(self, copies, episodes):
        obs, state = self.reset_all(self._keys(episodes))
        new = np.isin(np.arange(self.count), copies)
        self.state = self.mix(new, state, self.state)
        return self._rows(self.mix(new, obs, self.last))

    def _keys(self, episodes: Any) -> Any:
        each = [episode_seed(self.seed, c, int(k)) for c, k in enumerate(episodes)]
        return self.jax.vmap(self.jax.random.key)(np.array(each, np.uint32))

    def _rows(self, obs: Any) -> list[Array]:
        return [np.asarray(obs[a], np.float32) for a in self.env.agents]
