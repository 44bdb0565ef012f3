"""The replay memory of games that are played outside JAX: a ring of single steps of several copies.

What follows a step is kept with it, for an episode of such a game may end or be cut anywhere.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from marlyap.learning.replay import AbstractMemory, regrown
from marlyap.types import Key, Scalar, Transition


class Stored(eqx.Module):
    """One step of one copy; further axes come before these."""

    obs: Float[Array, "*axes agent obs"]
    state: Float[Array, "*axes agent part"]  # the global state, cut into a row for each agent
    action: Float[Array, "*axes agent du"]
    log_prob: Float[Array, "*axes agent"]
    reward: Float[Array, "*axes agent"]
    next_obs: Float[Array, "*axes agent obs"]
    next_state: Float[Array, "*axes agent part"]
    alive: Bool[Array, "*axes agent"]  # whether anything follows for this agent
    ended: Bool[Array, "*axes"]  # the episode ended or was cut with this step


class Steps(AbstractMemory):
    """The last `rows` steps of every copy."""

    kept: Stored  # every leaf has leading axes [row, copy]
    head: Int[Array, ""]  # where the next step goes
    size: Int[Array, ""]  # how many rows are filled

    @classmethod
    def empty(cls, example: Stored, rows: int) -> "Steps":
        """Room for `rows` steps of copies (leading axis) shaped like `example`."""
        zeros = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape), x.dtype), example)
        return cls(zeros, jnp.asarray(0), jnp.asarray(0))

    @property
    def rows(self) -> int:
        return self.kept.ended.shape[0]

    def add(self, new: Stored) -> "Steps":
        """With new steps (leading axes [time, copy]); the oldest are overwritten."""
        count = new.ended.shape[0]
        at = (self.head + jnp.arange(count)) % self.rows
        kept = jax.tree.map(lambda d, x: d.at[at].set(x), self.kept, new)
        size = jnp.minimum(self.size + count, self.rows)
        return Steps(kept, (self.head + count) % self.rows, size)

    def sample(self, key: Key, batch: int, gamma: Scalar | float, n: int = 1) -> Transition:
        """`batch` transitions with n-step rewards, each step of each copy equally likely."""
        k_where, k_noise = jax.random.split(key)
        copies = self.kept.ended.shape[1]
        most = jnp.stack([self.size, jnp.asarray(copies)]).astype(jnp.uint32)[:, None]
        age, copy = (jax.random.bits(k_where, (2, batch)) % most).astype(int)
        agents, du = self.kept.action.shape[2:]
        noise = jnp.moveaxis(jax.random.normal(k_noise, (agents, 2, du, batch)), -1, 0)
        take = lambda age, copy, noise: self.transition(age, copy, noise, gamma, n)
        return jax.vmap(take)(age, copy, noise)

    def resized(self, like: "Steps") -> "Steps":
        return Steps(*regrown(self.kept, like.kept, self.head, self.size))

    def transition(
        self,
        age: Int[Array, ""],
        copy: Int[Array, ""],
        noise: Float[Array, "agent 2 du"],
        gamma: Scalar | float,
        n: int = 1,
    ) -> Transition:
        """The step `age` of one copy, 0 being the oldest; fewer than n are summed at an end.

        `discount` is each agent's own: 0 once it has ended or left, not where the episode was cut.
        """
        k, step = self.kept, jnp.arange(n)
        row = (self.head - self.size + jnp.minimum(age + step, self.size - 1)) % self.rows
        ended = k.ended[row, copy] | (age + step >= self.size - 1)
        last = jnp.argmax(ended | (step == n - 1))  # the last step that is summed
        alive = jnp.cumprod(k.alive[row, copy].astype(jnp.float32), axis=0)  # after step k
        before = jnp.concatenate([jnp.ones_like(alive[:1]), alive[:-1]])
        weight = jnp.where(step <= last, gamma**step, 0.0)[:, None] * before
        first, final = row[0], row[last]
        join = lambda obs, state: jnp.concatenate([obs, state], axis=1)
        nothing = jnp.zeros_like(k.reward[first, copy])
        return Transition(
            obs=k.obs[first, copy],
            features=join(k.obs[first, copy], k.state[first, copy]),
            action=k.action[first, copy],
            log_prob=k.log_prob[first, copy],
            reward=jnp.sum(weight * k.reward[row, copy], axis=0),
            cost=nothing,
            next_obs=k.next_obs[final, copy],
            next_features=join(k.next_obs[final, copy], k.next_state[final, copy]),
            discount=gamma ** (last + 1.0) * alive[last],
            cost_to_go=nothing,
            cost_ahead=nothing,
            noise=noise,
        )
