"""Training on a game outside JAX: steps are played here and there, and learnt from inside jit."""

import dataclasses
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from marlyap.compute import export_cache
from marlyap.errors import UserError
from marlyap.hosts.spec import AbstractHostGame
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.health import Health
from marlyap.learning.hosted import Hosted
from marlyap.learning.off_policy import Learner
from marlyap.learning.schedule import Schedule
from marlyap.learning.steps import Steps, Stored
from marlyap.learning.traced import with_arrays
from marlyap.learning.training import AbstractTrainer, Carry, Told
from marlyap.simulation.rollout import AbstractExplorer, Uniform
from marlyap.types import Key


LAST = 100  # episodes over which return and success are told
# Fewer steps than a game in JAX has, for these are slow; an update for every fourth.
HOSTED = Schedule(steps=100_000, environments=16, steps_per_update=4, select_every=16)


class Played(eqx.Module):
    """What has been played so far, kept with a checkpoint."""

    seed: UInt32[Array, ""]  # from which every episode's own seed follows
    episodes: Int[Array, "copy"]  # that each copy has begun
    returns: Float[Array, "last"]  # of the last episodes that ended, the mean over agents
    successes: Float[Array, "last"]  # 1 or 0 of each; nan where the game does not say
    ended: Int[Array, ""]  # episodes that ended, in all


class HostTrainer(AbstractTrainer):
    """One training run of an off-policy algorithm on a game outside JAX.

    An iteration plays `game.rollout` steps of `schedule.environments` copies, then updates. The
    policy that is deployed is the one of the highest mean return over the last 100 episodes.
    """

    game: Hosted
    algorithm: AbstractAlgorithm
    schedule: Schedule
    side_by_side: ClassVar[bool] = False

    def __check_init__(self):
        self.algorithm.fits(self.game.agents)
        self.algorithm.from_steps()

    @property
    def shape(self):
        return self.game.shape

    @property
    def copies(self) -> int:
        return self.schedule.environments

    @property
    def steps_per_iteration(self):
        return self.copies * self.game.rollout

    @property
    def updates_per_iteration(self):
        return self.schedule.updates(self.steps_per_iteration)

    @property
    def warmup(self) -> int:
        """Rounds of `rollout` steps that are played before learning begins."""
        return -(-self.schedule.warmup // self.steps_per_iteration)

    def begin(self, key):
        """Fresh networks and an empty memory; nothing has been played."""
        a, n = self.algorithm, self.copies
        k_learn, k_play, key = jax.random.split(key, 3)
        needed = (self.warmup + self.iterations) * self.game.rollout
        rows = min(needed, max(self.schedule.capacity // n, self.game.rollout))
        networks = a.init(self.shape, k_learn)
        memory = Steps.empty(_stored(self.blank()), rows)
        none = jnp.full(LAST, jnp.nan)
        seed = jax.random.bits(k_play, (), jnp.uint32)
        played = Played(seed, jnp.zeros(n, int), none, none, jnp.asarray(0))
        lowest = jnp.asarray(jnp.finfo(jnp.float32).min)
        carry = Carry(
            Learner(networks, memory), key, jnp.asarray(0), a.policy(networks), lowest, played
        )
        return carry, Health.sound()

    def model(self):
        raise UserError(
            f"task: {self.game.source} is played outside JAX; this needs a game of marlyap's, and "
            "only train, evaluate, report and watch take others."
        )

    def resumed(self):
        return (
            "learner, memory and random keys are those of the checkpoint; the environments cannot "
            "be saved, so all copies begin new episodes.",
        )

    def advance(self, carry, stop=lambda: False):
        done, afresh = int(carry.iteration), int(carry.iteration) > 0
        with self.game.open(self.copies) as game:
            table = Table(self, game, carry.played)
            if not afresh:
                carry = self._warm(carry, table)
            learn, learns = None, self.algorithm.from_steps()
            while done < self.iterations and not stop():
                done += 1
                key, k_play, k_learn = jax.random.split(carry.key, 3)
                explorer = learns.explore(learns.networks(carry.learner))
                new = table.play(explorer, k_play)
                given = _placed((carry.learner, new, carry.iteration, k_learn))
                learn = learn or self._compiled(given)
                with warnings.catch_warnings():  # `new` is given away too, and finds no use
                    warnings.filterwarnings("ignore", message="Some donated buffers")
                    learner, info = learn(given)
                best, score = carry.best, carry.score
                carry = Carry(learner, key, jnp.asarray(done), best, score, table.played())
                last = done == self.iterations
                if done % self.schedule.select_every == 0 or last:
                    carry = self._select(carry)
                log = table.log() | info["log"] | ({"fresh_episodes": 1.0} if afresh else {})
                afresh = False
                log = {k: np.atleast_1d(np.asarray(v)) for k, v in log.items()}
                health = {k: jnp.atleast_1d(v) for k, v in info["health"].items()}
                yield done, carry, Told(log, Health(**health))

    def _compiled(self, given: "Given") -> Callable[["Given"], tuple[Learner, dict[str, Any]]]:
        game = dataclasses.replace(self.game, workers=0)  # not to compile for each number of them
        maker = with_arrays(dataclasses.replace(self, game=game))
        return export_cache.compiled(_learn, maker, given, lambda: given[0], donate=True)

    def _warm(self, carry: Carry, table: "Table") -> Carry:
        """Remember random steps before learning begins."""
        key, k_play = jax.random.split(carry.key)
        add = eqx.filter_jit(lambda memory, new: memory.add(new), donate="all")
        memory = carry.learner.memory
        for k in jax.random.split(k_play, max(self.warmup, 1))[: self.warmup]:
            memory = add(memory, table.play(Uniform(self.shape.du), k))
        where = lambda c: (c.learner.memory, c.key, c.played)
        return eqx.tree_at(where, carry, (memory, key, table.played()))

    def _select(self, carry: Carry) -> Carry:
        """Keep the policy if the last episodes that were trained on are the best so far."""
        assert carry.played is not None
        score = np.nanmean(carry.played.returns) if int(carry.played.ended) else None
        if score is None or score < carry.score:
            return carry
        policy = self.algorithm.policy(self.algorithm.networks(carry.learner))
        policy = jax.tree.map(lambda x: jnp.copy(x) if eqx.is_array(x) else x, policy)
        where = lambda c: (c.best, c.score)
        return eqx.tree_at(where, carry, (policy, jnp.asarray(score, jnp.float32)))

    def blank(self, *time: int) -> dict[str, np.ndarray]:
        """The arrays of a `Stored` of all copies, all zeros; `time` are leading axes."""
        shape, axes = self.shape, (*time, self.copies)
        each = (*axes, shape.agents)
        sizes = {"obs": shape.obs, "state": self.game.parts, "action": shape.du}
        sizes |= {"next_obs": shape.obs, "next_state": self.game.parts}
        room = {name: np.zeros((*each, size), np.float32) for name, size in sizes.items()}
        room |= {name: np.zeros(each, np.float32) for name in ("log_prob", "reward")}
        return room | {"alive": np.zeros(each, bool), "ended": np.zeros(axes, bool)}


class Table:
    """Copies of a game under way, and what they have told so far."""

    def __init__(self, trainer: HostTrainer, game: AbstractHostGame, played: Played):
        self.trainer, self.game, self.hosted = trainer, game, trainer.game
        self.seed = int(played.seed)
        self.episodes = np.array(played.episodes)
        self.returns, self.successes = np.array(played.returns), np.array(played.successes)
        self.ended = int(played.ended)
        self.obs, self.state = game.reset(self.seed, self.episodes.tolist())
        self.episodes += 1
        self.sums = np.zeros(trainer.copies)
        self.act = Actor(trainer)

    def play(self, explorer: AbstractExplorer, key: Any) -> Stored:
        """`rollout` steps of every copy, with leading axes [time, copy]."""
        new = self.trainer.blank(self.hosted.rollout)
        act, rows = self.act.by(explorer, key), self.hosted.rows
        for t in range(self.hosted.rollout):
            action, log_prob = act(self.obs, t)
            step = self.game.step(action)
            told = {"obs": self.obs, "state": rows(self.state), "action": action}
            told |= {"log_prob": log_prob, "reward": step.reward, "ended": step.ended}
            told |= {"next_obs": step.final_obs, "next_state": rows(step.final_state)}
            for name, value in (told | {"alive": step.active & ~step.terminated}).items():
                new[name][t] = value
            self.obs, self.state = step.obs, step.state
            self._count(step.reward, step.ended, step.success)
        return _stored(new)

    def _count(self, reward: np.ndarray, ended: np.ndarray, success: np.ndarray) -> None:
        """Returns and successes of the episodes that ended."""
        self.sums += reward.mean(axis=1)
        for c in np.flatnonzero(ended):
            at = self.ended % LAST
            self.returns[at], self.successes[at] = self.sums[c], success[c]
            self.ended += 1
            self.sums[c] = 0.0
        self.episodes += ended

    def played(self) -> Played:
        """All that is kept with a checkpoint."""
        return Played(
            jnp.asarray(self.seed, jnp.uint32),
            jnp.asarray(self.episodes),
            jnp.asarray(self.returns),
            jnp.asarray(self.successes),
            jnp.asarray(self.ended),
        )

    def log(self) -> dict[str, float]:
        """Over the last episodes; before the first has ended, the return of those under way."""
        told = {"return": float(np.mean(self.sums)), "episodes": float(self.ended)}
        if self.ended:
            told["return"] = float(np.nanmean(self.returns))
        if np.isfinite(self.successes).any():
            told["success"] = float(np.nanmean(self.successes))
        return told


def _stored(arrays: Mapping[str, np.ndarray]) -> Stored:
    return Stored(**{name: jnp.asarray(x) for name, x in arrays.items()})


class Actor:
    """Asks a policy for the actions of all copies: one compiled program for each kind of policy."""

    def __init__(self, trainer: HostTrainer):
        self.mask = _mask(trainer)
        self.programs: dict[type, Callable[..., Any]] = {}

    def by(self, explorer: AbstractExplorer, key: Any) -> Callable[..., Any]:
        """act(obs [copy agent obs], t) -> actions [copy agent du] and their log-probabilities."""
        leaves, static = eqx.partition(explorer, eqx.is_array)
        program = self.programs.setdefault(type(explorer), jax.jit(self._program(static)))

        def act(obs: np.ndarray, t: int) -> tuple[np.ndarray, np.ndarray]:
            return jax.device_get(program(leaves, obs, key, t))

        return act

    def _program(self, static: Any) -> Callable[..., Any]:
        def act(leaves, obs, key, t):
            explorer = eqx.combine(leaves, static)
            keys = jax.random.split(jax.random.fold_in(key, t), obs.shape[0])
            action = jax.vmap(explorer)(obs, keys)
            log_prob = jax.vmap(explorer.log_prob)(obs, action)
            return jax.vmap(lambda a: a * self.mask)(action), log_prob

        return act


def _mask(trainer: HostTrainer) -> np.ndarray:
    """1 where an agent's action counts."""
    shape = trainer.shape
    sizes = shape.inputs or (shape.du,) * shape.agents
    return np.array([[k < n for k in range(shape.du)] for n in sizes], np.float32)


Given = tuple[Learner, Stored, Int[Array, ""], Key]  # learner, what was played, iteration, key


def _learn(trainer: HostTrainer, given: Given) -> tuple[Learner, dict[str, Any]]:
    """Remember what was played and update; one program."""
    learner, new, iteration, key = given
    algorithm = trainer.algorithm.from_steps()
    memory = learner.memory.add(new)
    updates, decay = trainer.updates_per_iteration, trainer.decay(iteration)
    networks, log, _ = algorithm.improve(learner.networks, memory, updates, key, decay)
    health = Health.sound().with_networks(networks)
    return Learner(networks, memory), {"log": log, "health": health._asdict()}


def _placed(given: Given) -> Given:
    """On the device for good, wherever it was made: else XLA would compile for each way anew."""
    put = lambda x: jax.device_put(x, jax.devices()[0]) if eqx.is_array(x) else x
    return jax.tree.map(put, given)


def played_by(
    game: AbstractHostGame, act: Callable[[np.ndarray], np.ndarray], seed: int, episodes: int
) -> Iterator[tuple[np.ndarray, float]]:
    """So many episodes of a policy: of each the return [agent] and the success (nan: not said).

    Copy c plays its episodes 0, 1, ... under this seed, as many as all others.
    """
    obs, _ = game.reset(seed, [0] * game.copies)
    sums = np.zeros(obs.shape[:2])
    left = np.full(len(obs), -(-episodes // len(obs)))
    told = 0
    while told < episodes:
        step = game.step(act(obs))
        sums += step.reward
        for c in np.flatnonzero(step.ended):
            if left[c] > 0 and told < episodes:
                yield sums[c].copy(), float(step.success[c])
                told += 1
            left[c] -= 1
            sums[c] = 0.0
        obs = step.obs
