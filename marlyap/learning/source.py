"""Where episodes come from. A new source is a subclass of `AbstractSource`."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax

from marlyap.compute.devices import shard
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.learning.replay import Episode
from marlyap.learning.schedule import Schedule
from marlyap.nets.nets import Shape
from marlyap.simulation.rollout import AbstractExplorer, Decentralised, cost_to_go, rollout
from marlyap.types import Key


class CostWindow(NamedTuple):
    """Which sum of costs an episode holds at each of its steps, for L_target."""

    steps: int = 1  # T: the sum of the next T costs, and the cost T steps ahead
    beyond: bool = False  # play T steps past the end; otherwise the last cost is repeated there


class AbstractSource(eqx.Module):
    """Plays episodes for whoever learns from them."""

    @property
    @abc.abstractmethod
    def shape(self) -> Shape:
        """How many agents there are, and how many numbers each observes and decides."""

    @property
    @abc.abstractmethod
    def horizon(self) -> int:
        """Steps of an episode."""

    @abc.abstractmethod
    def play(
        self, policy: AbstractExplorer, key: Key, episodes: int, window: CostWindow
    ) -> Episode:
        """So many fresh episodes; every leaf has a leading axis `episode`."""

    def model(self) -> AbstractGame:
        """The game, for what differentiates it. Raises UserError where it is not in JAX."""
        raise UserError(
            "algorithm: it differentiates the game, which this source of episodes does not have; "
            "use one that learns from episodes, such as masac."
        )


class Simulated(AbstractSource):
    """A game in JAX: its episodes are played side by side, inside jit."""

    game: AbstractGame

    @property
    def shape(self):
        return shape(self.game)

    @property
    def horizon(self):
        return self.game.horizon

    def model(self):
        return self.game

    def play(self, policy, key, episodes, window):
        game, T = self.game, window.steps
        controller = Decentralised(policy, game)

        def one(key):
            k_start, k_act = jax.random.split(key)
            steps = game.horizon + window.beyond * T
            long = rollout(game, controller, game.reset(k_start), k_act, steps)
            state = jax.tree.map(lambda x: x[: game.horizon + 1], long.state)
            to_go, ahead = cost_to_go(long.cost, T, game.horizon)
            obs = jax.vmap(game.observations)(state)
            action = long.action[: game.horizon]
            return Episode(
                obs=obs,
                features=jax.vmap(game.features)(state),
                action=action,
                log_prob=jax.vmap(policy.log_prob)(obs[:-1], action),
                reward=long.reward[: game.horizon],
                cost=long.cost[: game.horizon],
                cost_to_go=to_go,
                cost_ahead=ahead,
                terminated=long.terminated[: game.horizon],
            )

        return jax.vmap(one)(shard(jax.random.split(key, episodes)))


class Play(eqx.Module):
    """What an algorithm is given to learn from: a source of episodes, and how many it may play."""

    source: AbstractSource
    schedule: Schedule

    def __call__(
        self, policy: AbstractExplorer, key: Key, episodes: int, window: CostWindow | None = None
    ) -> Episode:
        """So many fresh episodes; every leaf has a leading axis `episode`."""
        return self.source.play(policy, key, episodes, window or CostWindow())

    @property
    def steps_per_iteration(self) -> int:
        return self.schedule.environments * self.source.horizon

    @property
    def iterations(self) -> int:
        return -(-self.schedule.steps // self.steps_per_iteration)


def shape(game: AbstractGame) -> Shape:
    """What the algorithm may know of the game."""
    state = eqx.filter_eval_shape(game.reset, jax.random.key(0))
    see = lambda s: (game.observations(s), game.features(s), game.errors(s))
    obs, features, errors = eqx.filter_eval_shape(see, state)
    kinds = tuple(int(k) for k in game.kinds)
    return Shape(game.agents, obs.shape[1], features.shape[1], errors.shape[1], game.du, kinds)
