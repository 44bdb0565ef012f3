"""Analytic policy gradients: the model is known and smooth, so the game itself is differentiated.

    symbol             here                            meaning
    mu_phi             pi, by its mode                 deterministic decentralised policies
    l(c)               `sharp`                         c + sharpness c / (c + edge cost)
    w_t                `weights`                       grow as t^`growth`, and sum to 1
    J(phi)             J                               E_{s_0}[ sum_t w_t l(c_t) + l(c_H) ]
    Delta_t            `rise`                          max(0, c_{t+T} - (1 - decrease) c_t)

No critic, no memory and no exploration: each update plays fresh episodes with the mean actions and
takes the exact gradient of J through the dynamics and the observations (back-propagation through
time; Wiedemann et al. 2023 and Freeman et al. 2021 call it analytic policy gradients). The policies
see no more than those of MASAC, but the trainer must have the equations of motion.

With `weight` > 0 the policy is also held to the paper's decrease condition in its finite-step form:
with L(s_t) the sum of the next T costs, L(s_{t+1}) - L(s_t) = c_{t+T} - c_t, so Delta_t = 0 says
that L falls by `decrease` c_t at s_t. It is asked for where c_t exceeds the cost at the edge of
success (certificate C3 tests the same).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.compute.devices import shard
from marlyap.errors import check_range
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm, Info, Log, unwatched
from marlyap.learning.health import Health, first_negative
from marlyap.learning.optimiser import TrainState, polyak
from marlyap.learning.schedule import Schedule
from marlyap.nets.nets import Actors, Greedy
from marlyap.simulation.rollout import Decentralised, charged, first_fault, rollout
from marlyap.types import Key, Keys, Scalar


class Networks(eqx.Module):
    pi: TrainState[Actors]
    pi_mean: Actors  # running mean of pi: the policy that is deployed


class APG(AbstractAlgorithm):
    """Analytic policy gradients: learns by differentiating the game, so the model must be known."""

    # 1,500 updates on 128 episodes each: playing is cheap where no critic is to be learnt.
    default_schedule = Schedule(steps=7_680_000, environments=128, select_every=50)

    traced = ("rate_pi", "sharpness", "clip", "ema_rate", "weight", "decrease")

    rate_pi: float = 2e-3  # learning rate
    actor_width: int = 64  # units in each of two hidden layers
    shared: bool = False  # one set of actor weights for all agents of a kind
    growth: float = 2.0  # of the weight of a step's cost with time; 0 weighs all steps alike
    sharpness: float = 0.5  # extra cost of being beyond the edge of success, beside the cost
    clip: float = 1.0  # largest norm of a gradient
    ema_rate: float = 1e-2  # how fast the deployed policy follows the actor; 1 is the actor itself
    weight: float = 0.0  # of the decrease condition
    T: int = 20  # steps over which the cost has to fall
    decrease: float = 0.1  # share by which the cost has to fall over T steps

    def __check_init__(self):
        check_range("rate_pi", self.rate_pi, 0, 1)
        check_range("ema_rate", self.ema_rate, 0, 1, open=True)
        check_range("decrease", self.decrease, 0, 1)
        check_range("clip", self.clip, 0, 1e6, open=True)
        check_range("actor_width", self.actor_width, 1, 1_000_000)
        check_range("T", self.T, 1, 10_000)
        for name in ("growth", "sharpness", "weight"):
            check_range(name, getattr(self, name), 0, 1e6)

    def init(self, shape, key):
        pi = Actors(shape, self.actor_width, self.shared, key=key)
        return Networks(TrainState.of(pi), pi)

    def updates_per_iteration(self, play):
        return 1

    def begin(self, play, keys):
        """Nothing is played before the first iteration."""
        play.source.model()
        return self.init(play.source.shape, keys.learn), Health.sound()

    def iterate(self, learner, play, keys, decay, watch=unwatched):
        """One update on fresh episodes, whose gradient is taken through the game."""
        starts = shard(jax.random.split(keys.play, play.schedule.environments))
        learner, log, health = self.improve(learner, play.source.model(), starts, decay)
        seen = jax.tree.map(lambda x: x[None], watch(learner))
        return learner, Info(log, health, seen)

    def J(
        self, pi: Actors, game: AbstractGame, key: Key
    ) -> tuple[Scalar, tuple[Float[Array, "time agent"], Float[Array, "time agent"]]]:
        """J of one episode, and its costs and rewards."""
        k_start, k_act = jax.random.split(key)
        path = rollout(game, Decentralised(Greedy(pi), game), game.reset(k_start), k_act)
        last = jax.tree.map(lambda x: x[-1], path.state)
        ended = jnp.concatenate([jnp.zeros(1, bool), path.terminated])  # at s_0 ... s_H
        end = charged(game, last, game.hold(last))[0]
        cost = jnp.where(ended[:, None], 0.0, jnp.concatenate([path.cost, end[None]]))
        sharp = lambda c: jnp.mean(c + self.sharpness * c / (c + game.edge_cost), axis=-1)
        weights = jnp.arange(1, game.horizon + 1) ** self.growth
        J = jnp.sum(weights / jnp.sum(weights) * sharp(cost[:-1])) + sharp(cost[-1])
        J = J + self.weight * self.rise(jnp.mean(cost, axis=1), game)
        return J, (path.cost, path.reward)

    def rise(self, c: Float[Array, "time"], game: AbstractGame) -> Scalar:
        """The mean over t of Delta_t, where the team's cost c_t exceeds that at the edge."""
        T = min(self.T, c.shape[0] - 1)
        now, ahead = c[:-T], c[T:]
        delta = jax.nn.relu(ahead - (1 - self.decrease) * now)
        return jnp.mean(jnp.where(now >= game.edge_cost, delta, 0.0))

    def improve(
        self, networks: Networks, game: AbstractGame, keys: Keys, decay: Scalar
    ) -> tuple[Networks, Log, Health]:
        """phi <- phi - rate grad J, clipped to norm `clip`; entries not finite count as 0."""
        l = networks

        @eqx.filter_value_and_grad(has_aux=True)
        def expectation(pi):
            J, played = jax.vmap(lambda key: self.J(pi, game, key))(keys)
            return jnp.mean(J), played

        (loss, (cost, reward)), gradient = expectation(l.pi.value)
        finite = jax.tree.map(lambda g: jnp.where(jnp.isfinite(g), g, 0.0), gradient)
        norm = jnp.sqrt(sum(jnp.sum(g**2) for g in jax.tree.leaves(finite)))
        clipped = jax.tree.map(lambda g: g * jnp.minimum(1.0, self.clip / (norm + 1e-12)), finite)
        pi = l.pi.step(clipped, decay * self.rate_pi)
        log = {
            "J_pi": loss,
            "gradient": norm,
            "return": jnp.mean(jnp.sum(jnp.mean(reward, axis=2), axis=1)),
        }
        health = Health.sound()._replace(
            cost=first_fault(cost), reward=first_fault(reward), negative=first_negative(cost)
        )
        return Networks(pi, polyak(pi.value, l.pi_mean, self.ema_rate)), log, health

    def policy(self, networks):
        return Greedy(networks.pi_mean)

    def lyapunov(self, networks):
        return None
