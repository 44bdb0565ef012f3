"""The outer loop of Algorithms 1 and 2: play, remember, learn; compiled an iteration at a time."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from marlyap.algorithm import AbstractAlgorithm, AbstractModelBased, AbstractOffPolicy
from marlyap.devices import gathered, spread
from marlyap.errors import whole_fields, within
from marlyap.evaluation import outcomes
from marlyap.game import AbstractGame
from marlyap.nets import Shape
from marlyap.replay import Episode, Replay
from marlyap.rollout import (
    AbstractExplorer,
    Decentralised,
    Policy,
    Uniform,
    cost_to_go,
    first_fault,
    rollout,
)
from marlyap.seeds import stream
from marlyap.types import Key, Scalar


AHEAD = 8  # batches that are drawn together, at most


class Schedule(eqx.Module):
    """How much is played and learnt. An iteration plays `environments` episodes, then updates."""

    steps: int = 204_800  # environment steps in all
    environments: int = 64  # episodes played side by side in an iteration
    steps_per_update: int = 8  # environment steps for one gradient step
    warmup: int = 2_560  # environment steps of uniformly random actions before learning
    capacity: int = 1_024_000  # environment steps that the replay memory holds
    decay: float = 0.1  # learning rates are multiplied by this ...
    decay_episodes: int | None = None  # ... every so many episodes (None: over the whole run)
    judge_every: int = 8  # iterations between looks at the policy
    judge_episodes: int = 500  # starts on which the best policy so far is chosen

    def __check_init__(self):
        whole_fields(self)
        for name, low, high in (
            ("steps", 1, 10**12),
            ("environments", 1, 10**6),
            ("steps_per_update", 1, 10**9),
            ("warmup", 0, 10**9),
            ("capacity", 1, 10**9),
            ("judge_every", 1, 10**9),
            ("judge_episodes", 1, 10**6),
        ):
            within(name, getattr(self, name), low, high)
        within("decay", self.decay, 0, 1, open=True)
        if self.decay_episodes is not None:
            within("decay_episodes", self.decay_episodes, 1, 10**12)


class Carry(eqx.Module):
    """All that training is at one instant; saved whole, so that a resumed run is the same run."""

    learner: PyTree
    memory: Replay
    key: Key
    iteration: Int[Array, ""]
    best: Policy  # of those evaluated, the one with the highest score
    score: Scalar


def first_negative(cost: Float[Array, "episode time agent"]) -> Int[Array, ""]:
    """step * agents + agent of the first cost below 0, beyond rounding; -1 where there is none."""
    return first_fault(jnp.where(cost < -1e-6, jnp.nan, 0.0))


def shape(game: AbstractGame) -> Shape:
    """What the algorithm may know of the game."""
    state = eqx.filter_eval_shape(game.reset, jax.random.key(0))
    see = lambda s: (game.observations(s), game.features(s), game.errors(s))
    obs, features, errors = eqx.filter_eval_shape(see, state)
    return Shape(game.agents, obs.shape[1], features.shape[1], errors.shape[1], game.du)


class Trainer(eqx.Module):
    """One training run as two pure functions, `begin` and `iterate`."""

    game: AbstractGame
    algorithm: AbstractAlgorithm
    schedule: Schedule

    def __check_init__(self):
        self.algorithm.fits(self.game.agents)

    @property
    def steps_per_iteration(self) -> int:
        return self.schedule.environments * self.game.horizon

    @property
    def iterations(self) -> int:
        return -(-self.schedule.steps // self.steps_per_iteration)

    @property
    def updates_per_iteration(self) -> int:
        if isinstance(self.algorithm, AbstractModelBased):
            return 1
        return max(1, self.steps_per_iteration // self.schedule.steps_per_update)

    def begin(self, key: Key) -> Carry:
        """A fresh learner, and a memory with the warm-up in it."""
        k_init, k_warm, key = jax.random.split(key, 3)
        s, random = self.schedule, Uniform(self.game.du)
        learner = self.algorithm.init(shape(self.game), k_init)
        remembers = isinstance(self.algorithm, AbstractOffPolicy)
        episodes = max(1, -(-s.warmup // self.game.horizon)) if remembers else 1
        warm = self.play(random, k_warm, episodes)
        needed = episodes + self.iterations * s.environments if remembers else 1
        rows = min(needed, max(s.capacity // self.game.horizon, episodes, s.environments))
        memory = Replay.empty(jax.tree.map(lambda x: x[0], warm), rows).add(warm)
        best = self.algorithm.exploit(learner)
        return Carry(learner, memory, key, jnp.asarray(0), best, jnp.zeros(()))

    def iterate(self, carry: Carry) -> tuple[Carry, dict[str, Scalar]]:
        """Play, remember, learn; the dict is for the log."""
        return self.watched(carry, lambda learner: None)[:2]

    def watched(
        self, carry: Carry, watch: Callable[[PyTree], PyTree]
    ) -> tuple[Carry, dict[str, Scalar], PyTree]:
        """`iterate`, and what `watch` says of the learner after each update."""
        key, k_play, k_learn = jax.random.split(carry.key, 3)
        decay, memory, a = self.decay(carry.iteration), carry.memory, self.algorithm
        if isinstance(a, AbstractModelBased):
            keys = spread(jax.random.split(k_play, self.schedule.environments))
            learner, info = a.improve(carry.learner, self.game, keys, decay)
            seen = jax.tree.map(lambda x: x[None], watch(learner))
        else:
            assert isinstance(a, AbstractOffPolicy)
            new = gathered(self.play(a.explore(carry.learner), k_play, self.schedule.environments))
            memory = memory.add(new)
            learner, info, seen = self.learn(carry.learner, memory, k_learn, decay, watch)
            info["return"] = jnp.mean(jnp.sum(jnp.mean(new.reward, axis=2), axis=1))
            for name in ("obs", "features", "action", "reward", "cost"):
                info[f"bad_{name}"] = first_fault(getattr(new, name))
            info["bad_sign"] = first_negative(new.cost)
        numbers = jax.tree.leaves(eqx.filter(learner, eqx.is_inexact_array))
        # how many are not finite, less 1: negative where all is well, as above
        bad = jnp.stack([jnp.sum(~jnp.isfinite(x)) for x in numbers])
        info["bad_learner"] = jnp.sum(bad) - 1
        done = carry.iteration + 1
        return Carry(learner, memory, key, done, carry.best, carry.score), info, seen

    def learn(
        self,
        learner: PyTree,
        memory: Replay,
        key: Key,
        decay: Scalar,
        watch: Callable[[PyTree], PyTree],
    ) -> tuple[PyTree, dict[str, Scalar], PyTree]:
        """An iteration's updates, each on a fresh batch from the memory."""
        a = self.algorithm
        assert isinstance(a, AbstractOffPolicy)
        dynamic, static = eqx.partition(learner, eqx.is_array)

        def one(dynamic, batch):
            learner, info = a.update(eqx.combine(dynamic, static), batch, decay)
            return eqx.filter(learner, eqx.is_array), (info, watch(learner))

        def several(dynamic, keys):
            # Batches are drawn ahead of the loop that uses them. In the same loop XLA would draw
            # each number again wherever it is used, and not by vectors.
            draw = lambda key: memory.sample(key, a.batch, a.gamma, a.n_step)
            return jax.lax.scan(one, dynamic, jax.vmap(draw)(keys))

        ahead = math.gcd(self.updates_per_iteration, AHEAD)
        keys = jax.random.split(key, (self.updates_per_iteration // ahead, ahead))
        dynamic, (info, seen) = jax.lax.scan(several, dynamic, keys)
        seen = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), seen)
        return eqx.combine(dynamic, static), jax.tree.map(jnp.mean, info), seen

    def judge(self, carry: Carry) -> tuple[Carry, dict[str, Scalar]]:
        """Look at the policy from starts kept for this alone, and keep it if it is the best.

        Its score is the success rate, plus a tenth of that at half the radius. Ties are broken by
        how far and how fast the agents end, which count for less than one start in all.
        """
        policy = self.algorithm.exploit(carry.learner)
        keys = spread(jax.random.split(stream(0, "select"), self.schedule.judge_episodes))
        seen = outcomes(self.game, Decentralised(policy, self.game), keys)
        rate = lambda hits: jnp.mean(hits.astype(float))
        near = rate(seen.success & (seen.final <= self.game.edge / 2))
        less = lambda x, unit: jnp.mean(jnp.nan_to_num(1 / (1 + x / unit)))
        tie = less(seen.final, self.game.edge) + less(seen.speed + seen.spin, 1.0)
        score = rate(seen.success) + 0.1 * near + 0.02 * tie / self.schedule.judge_episodes
        better = score >= carry.score
        keep = lambda new, old: jnp.where(better, new, old) if eqx.is_array(new) else new
        best = jax.tree.map(keep, policy, carry.best)
        score = jnp.maximum(score, carry.score)
        carry = Carry(carry.learner, carry.memory, carry.key, carry.iteration, best, score)
        look = {"success": rate(seen.success), "distance": jnp.mean(seen.final)}
        return carry, look | {"speed": jnp.mean(seen.speed), "spin": jnp.mean(seen.spin)}

    def play(self, policy: AbstractExplorer, key: Key, episodes: int) -> Episode:
        """`episodes` fresh episodes, as the memory keeps them."""
        game = self.game
        T, further = getattr(self.algorithm, "foresight", (1, False))
        controller = Decentralised(policy, game)

        def one(key):
            k_start, k_act = jax.random.split(key)
            long = rollout(game, controller, game.reset(k_start), k_act, game.horizon + further * T)
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

        return jax.vmap(one)(spread(jax.random.split(key, episodes)))

    def decay(self, iteration: Int[Array, ""]) -> Scalar:
        """What the learning rates are multiplied by."""
        s = self.schedule
        span = s.decay_episodes or self.iterations * s.environments
        return s.decay ** (iteration * s.environments / span)


SCHEDULES = {
    "tuned": Schedule(),
    # Section 4: one environment, one update a step, rates falling to 7.5 % every 2000 episodes.
    "paper": Schedule(
        steps=100_000,
        environments=1,
        steps_per_update=1,
        warmup=1_000,
        decay=0.075,
        decay_episodes=2_000,
        judge_every=50,
    ),
    # 1,500 updates on 128 episodes each: playing is cheap where no critic is to be learnt.
    "model-based": Schedule(steps=7_680_000, environments=128, judge_every=50),
}


def schedule_for(algorithm: AbstractAlgorithm, preset: str = "tuned") -> Schedule:
    """The schedule of that name, or the one for rules that differentiate the game."""
    return SCHEDULES["model-based" if isinstance(algorithm, AbstractModelBased) else preset]
