"""One rollout serves training, evaluation, certificates and pictures."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.types import Action, Key, Obs, State, Trajectory


Controller = Callable[[State, Key], Action]  # may see everything
Policy = Callable[[Obs, Key], Action]  # row i of the action comes from row i of obs alone


class AbstractExplorer(eqx.Module):
    """A policy that collects data, and says how likely its actions were."""

    @abc.abstractmethod
    def __call__(self, obs: Obs, key: Key) -> Action:
        """Row i of the action comes from row i of obs alone."""

    @abc.abstractmethod
    def log_prob(self, obs: Obs, action: Action) -> Float[Array, "agent"]:
        """log pi_i(a_i | o_i)."""


class Uniform(AbstractExplorer):
    """Uniformly random actions in [-1, 1], for the warm-up."""

    du: int

    def __call__(self, obs, key):
        return jax.random.uniform(key, (obs.shape[0], self.du), minval=-1.0, maxval=1.0)

    def log_prob(self, obs, action):
        return jnp.full(obs.shape[0], -self.du * jnp.log(2.0))


class Decentralised(eqx.Module):
    """A policy as a controller: it is shown each agent's own observation and nothing else.

    A module, not a closure, so that jit sees the weights as arguments and compiles once.
    """

    policy: Policy
    game: AbstractGame

    def __call__(self, state: State, key: Key) -> Action:
        return self.policy(self.game.observations(state), key)

    def agent(self, agent: int, obs: Float[Array, "obs"]) -> Float[Array, "du"]:
        """What one agent does at its own observation alone, in [-1, 1].

        Raises UserError for an agent that there is not, or a policy that sees what others observe.
        """
        return act_alone(self.policy, self.game.agents, agent, obs)


def act_alone(
    policy: Policy, agents: int, agent: int, obs: Float[Array, "obs"]
) -> Float[Array, "du"]:
    """The agent's row of a deployed policy's action; the other rows are made up.

    Raises UserError for an agent that there is not, or where the other rows matter.
    """
    if not 0 <= agent < agents:
        raise UserError(f"agent: there is no agent {agent}; take 0 to {agents - 1}.")
    key = jax.random.key(0)  # a deployed policy draws nothing
    among = lambda other: jnp.full((agents, *obs.shape), other, obs.dtype).at[agent].set(obs)
    one, two = (policy(among(other), key)[agent] for other in (0.0, 1.0))
    if not np.allclose(one, two, atol=1e-6):
        raise UserError(
            "policy: what this agent does depends on what others observe; give the observations of "
            "all agents."
        )
    return one


class AbstractPlanner(eqx.Module):
    """Decides the whole episode when it sees the start; cannot run inside jit."""

    @abc.abstractmethod
    def plan(self, states: State) -> Controller:
        """A controller for each start (leaves of both have a leading axis `episode`)."""


def rollout(
    game: AbstractGame, controller: Controller, start: State, key: Key, steps: int | None = None
) -> Trajectory:
    """Drive the game from `start` for `steps` steps (default: its horizon).

    Once the game has terminated or failed its state stands still.
    """

    def tick(state, key):
        action = controller(state, key)
        moved = game.step(state, action)
        ended = game.terminated(state) | game.failed(state)
        after = jax.tree.map(lambda old, new: _where(ended, old, new), state, moved)
        cost, reward = charged(game, state, action)
        return after, (after, action, reward, cost, game.terminated(after), game.failed(after))

    keys = jax.random.split(key, steps or game.horizon)
    _, (after, action, reward, cost, terminated, failed) = jax.lax.scan(tick, start, keys)
    states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, after)
    return Trajectory(action, reward, cost, states, terminated, failed)


def charged(
    game: AbstractGame, state: State, action: Action
) -> tuple[Float[Array, "agent"], Float[Array, "agent"]]:
    """What a step from this state costs and earns each agent: after a failure, `failure_cost`."""
    failed, price = game.failed(state), game.failure_cost
    cost = jnp.where(failed, price, game.costs(state, action))
    return cost, jnp.where(failed, -price, game.rewards(state, action))


def _where(ended: Bool[Array, ""], old: Array, new: Array) -> Array:
    """`old` once ended; random keys too, of which jnp.where takes none."""
    return jax.lax.select(jnp.broadcast_to(ended, old.shape), old, new)


def cost_to_go(
    cost: Float[Array, "long agent"], T: int, time: int
) -> tuple[Float[Array, "time agent"], Float[Array, "time agent"]]:
    """L_target(t) = sum_{k<T} c_{t+k} and c_{t+T}, for the first `time` steps.

    Costs past the end of `cost` are taken to stay what they were last; dropping them would
    teach L to fall with the clock. Roll the game T steps further to have the true ones.
    """
    missing = max(0, time + T - cost.shape[0])
    padded = jnp.concatenate([cost, jnp.repeat(cost[-1:], missing, axis=0)])
    window = jnp.arange(time)[:, None] + jnp.arange(T)[None, :]
    return jnp.sum(padded[window], axis=1), padded[T : time + T]


def first_fault(x: Float[Array, "episode time agent *rest"]) -> Int[Array, ""]:
    """step * agents + agent of the first number that is not finite; -1 where all are."""
    bad = jnp.any(~jnp.isfinite(x), axis=(0, *range(3, x.ndim)))
    return jnp.where(jnp.any(bad), jnp.argmax(bad), -1)


def all_finite(tree: PyTree) -> Bool[Array, ""]:
    """Whether every number in the tree is finite."""
    numbers = [x for x in jax.tree.leaves(tree) if eqx.is_inexact_array(x)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in numbers]))


def until(trajectory: Trajectory, steps: int) -> Trajectory:
    """The rollout as if it had stopped after `steps` steps."""
    cut = lambda tree, end: jax.tree.map(lambda leaf: leaf[:end], tree)
    parts = {k: cut(v, steps) for k, v in vars(trajectory).items() if k != "state"}
    return Trajectory(state=cut(trajectory.state, steps + 1), **parts)
