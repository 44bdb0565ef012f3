"""The replay memory D: a ring of episodes, itself a pytree.

Whole episodes are kept because next_obs of one step is obs of the following one (half the
memory), and because n-step returns need the steps that follow.
"""

import abc
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from marlyap.types import Key, Scalar, Transition


class Episode(eqx.Module):
    """What is remembered of one episode."""

    action: Float[Array, "time agent du"]
    obs: Float[Array, "time+1 agent obs"]
    features: Float[Array, "time+1 agent feature"]
    log_prob: Float[Array, "time agent"]
    reward: Float[Array, "time agent"]
    cost: Float[Array, "time agent"]
    cost_to_go: Float[Array, "time agent"]
    cost_ahead: Float[Array, "time agent"]
    terminated: Bool[Array, "time"]

    @property
    def steps(self) -> int:
        """Of all episodes together, where there is a leading axis `episode`."""
        return math.prod(self.terminated.shape)


class AbstractMemory(eqx.Module):
    """What may be drawn from: whole episodes, or single steps."""

    @abc.abstractmethod
    def add(self, new: Any) -> Any:
        """With what was just played; the oldest is overwritten."""

    @abc.abstractmethod
    def sample(self, key: Key, batch: int, gamma: Scalar | float, n: int = 1) -> Transition:
        """`batch` transitions with n-step rewards, each step equally likely."""

    @abc.abstractmethod
    def resized(self, like: Any) -> Any:
        """The newest of it in as many rows as `like` has, which holds arrays or their shapes."""


class Replay(AbstractMemory):
    """The last `rows` episodes."""

    episodes: Episode  # every leaf has a leading axis `rows`
    head: Int[Array, ""]  # where the next episode goes
    size: Int[Array, ""]  # how many rows are filled

    @classmethod
    def empty(cls, example: Episode, rows: int) -> "Replay":
        """Room for `rows` episodes shaped like `example`."""
        zeros = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape), x.dtype), example)
        return cls(zeros, jnp.asarray(0), jnp.asarray(0))

    @property
    def rows(self) -> int:
        return self.episodes.reward.shape[0]

    @property
    def time(self) -> int:
        return self.episodes.reward.shape[1]

    def add(self, new: Episode) -> "Replay":
        """D <- D + new (leading axis: episodes); the oldest are overwritten."""
        count = new.reward.shape[0]
        at = (self.head + jnp.arange(count)) % self.rows
        episodes = jax.tree.map(lambda d, x: d.at[at].set(x), self.episodes, new)
        size = jnp.minimum(self.size + count, self.rows)
        return Replay(episodes, (self.head + count) % self.rows, size)

    def sample(self, key: Key, batch: int, gamma: Scalar | float, n: int = 1) -> Transition:
        """B ~ D: `batch` transitions with n-step rewards, each step equally likely."""
        k_where, k_noise = jax.random.split(key)
        most = jnp.stack([self.size, jnp.asarray(self.time)]).astype(jnp.uint32)[:, None]
        row, t = (jax.random.bits(k_where, (2, batch)) % most).astype(int)  # uneven by size / 2^32
        # Drawn with the batch last: with one as short as `du`, XLA would use 2 of 16 lanes.
        agents, du = self.episodes.action.shape[2:]
        noise = jnp.moveaxis(jax.random.normal(k_noise, (agents, 2, du, batch)), -1, 0)
        take = lambda row, t, noise: self.transition(row, t, noise, gamma, n)
        return jax.vmap(take)(row, t, noise)

    def resized(self, like: "Replay") -> "Replay":
        return Replay(*regrown(self.episodes, like.episodes, self.head, self.size))

    def transition(
        self,
        row: Int[Array, ""],
        t: Int[Array, ""],
        noise: Float[Array, "agent 2 du"],
        gamma: Scalar | float,
        n: int = 1,
    ) -> Transition:
        """The step t of one episode; fewer than n steps are summed where the episode is cut.

        The cut at the time limit does not zero `discount`; termination does.
        """
        e = self.episodes
        k = jnp.arange(n)
        steps = jnp.minimum(n, self.time - t)
        at = jnp.minimum(t + k, self.time - 1)
        ended = e.terminated[row, at] & (k < steps)
        alive = jnp.cumprod(1.0 - ended)  # after step k
        weight = jnp.where(k < steps, gamma**k, 0.0) * jnp.concatenate([jnp.ones(1), alive[:-1]])
        return Transition(
            obs=e.obs[row, t],
            features=e.features[row, t],
            action=e.action[row, t],
            log_prob=e.log_prob[row, t],
            reward=weight @ e.reward[row, at],
            cost=e.cost[row, t],
            next_obs=e.obs[row, t + steps],
            next_features=e.features[row, t + steps],
            discount=gamma**steps * alive[-1],
            cost_to_go=e.cost_to_go[row, t],
            cost_ahead=e.cost_ahead[row, t],
            noise=noise,
        )


def regrown(
    kept: PyTree, like: PyTree, head: Int[Array, ""], size: Int[Array, ""]
) -> tuple[PyTree, Int[Array, ""], Int[Array, ""]]:
    """The newest rows of a ring, in order, in a ring of another length; its head and size."""
    old, new = (jax.tree.leaves(tree)[0].shape[0] for tree in (kept, like))
    count = min(int(size), new)
    order = (int(head) - count + jnp.arange(count)) % old
    put = lambda x: jnp.zeros((new, *x.shape[1:]), x.dtype).at[:count].set(x[order])
    return jax.tree.map(put, kept), jnp.asarray(count % new), jnp.asarray(count)
