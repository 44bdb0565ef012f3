"""Games of marlyap played step by step from outside: what the adapters of other libraries share.

All that a step tells crosses the border as one packed array; fetching each array by itself would
cost several times the step.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.runs import config
from marlyap.simulation.rollout import charged
from marlyap.types import Action, State


class Told(NamedTuple):
    """What a step tells, of one team, or of several with a leading axis."""

    obs: np.ndarray  # [agent obs] after the step; of a team that began anew, its first
    final: np.ndarray  # [agent obs] that the step led to
    reward: np.ndarray  # [agent]
    ended: Any  # whether the game has terminated
    cut: Any  # whether the time was up
    success: Any  # whether the game counts what the step led to as a success


class Layout(NamedTuple):
    """Sizes of a game's packed rows."""

    agents: int
    obs: int
    features: int

    def read(self, row: np.ndarray) -> tuple[np.ndarray, ...]:
        """Observations, features, rewards, ended, success of [*axes number]."""
        n, o, f = self.agents, self.obs, self.features
        ends = np.cumsum([n * o, n * f, n, 1])
        obs, features, reward, ended, success = np.split(row, ends, axis=-1)
        return obs.reshape(*row.shape[:-1], n, o), features, reward, ended[..., 0], success[..., 0]


class Team:
    """One team, stepped by one compiled program."""

    def __init__(self, name: str, game: AbstractGame):
        self.name, self.game = name, game
        start = eqx.filter_eval_shape(game.reset, jax.random.key(0))
        obs, features = eqx.filter_eval_shape(
            lambda s: (game.observations(s), game.features(s)), start
        )
        self.agents, self.du, self.obs = game.agents, game.du, obs.shape[1]
        self.size = game.agents * features.shape[1]
        self.layout = Layout(self.agents, self.obs, features.shape[1])
        self.begin = jax.jit(lambda seed: begun(game, seed))
        self.move = jax.jit(lambda state, action: moved(game, state, action))
        self.features = np.zeros(self.size, np.float32)
        self.now: State | None = None

    @classmethod
    def of(cls, task: AbstractGame | str, **fields: Any) -> "Team":
        """The team of a task by name or as an object, with fields set anew.

        Raises UserError for an unknown task or field.
        """
        game = config.load(task, AbstractGame) if isinstance(task, str) else task
        if unknown := fields.keys() - {f.name for f in dataclasses.fields(game)}:
            word = min(unknown)
            hint = config.suggest(word, config.fields(game))
            raise UserError(f"{word}: the task has no such field; {hint}")
        name = task if isinstance(task, str) else type(game).__name__.lower()
        return cls(name, dataclasses.replace(game, **fields))

    def reset(self, seed: int) -> np.ndarray:
        """Begin an episode; what the agents observe [agent obs]."""
        self.now, row = self.begin(np.uint32(seed))
        obs, self.features, *_ = self.layout.read(np.array(row))
        return obs

    def step(self, action: np.ndarray) -> Told:
        """One step, for actions [agent du] in [-1, 1]."""
        self.now, row = self.move(self.now, np.clip(action, -1.0, 1.0))
        obs, self.features, reward, ended, success = self.layout.read(np.array(row))
        return Told(obs, obs, reward, bool(ended), False, bool(success))


class Teams:
    """Several teams in one compiled program; each begins anew when its episode is over."""

    def __init__(self, team: Team, count: int, max_cycles: int | None = None):
        self.team, self.count, game = team, count, team.game
        self.most = max_cycles or game.horizon
        self.begin = jax.jit(jax.vmap(lambda seed: begun(game, seed)))
        self.move = jax.jit(self._program(game))
        self.now: Any = None

    def _program(self, game: AbstractGame) -> Callable[..., Any]:
        def one(state, age, action, seed):
            state, row = moved(game, state, action)
            over = (row[-2] > 0) | (age + 1 >= self.most)
            fresh, first = begun(game, seed)
            pick = lambda new, old: jax.lax.select(jnp.broadcast_to(over, old.shape), new, old)
            state = jax.tree.map(pick, fresh, state)
            return state, jnp.where(over, 0, age + 1), jnp.stack([row, pick(first, row)])

        return jax.vmap(one)

    def reset(self, seed: int) -> np.ndarray:
        """Every team begins; what the agents observe [team agent obs]."""
        self.draws = np.random.default_rng(seed)
        self.ages = np.zeros(self.count, np.int32)
        self.now, rows = self.begin(self._seeds())
        return self.team.layout.read(np.array(rows))[0]

    def step(self, action: np.ndarray) -> Told:
        """One step of every team, for actions [team agent du] in [-1, 1]."""
        given = np.clip(action, -1.0, 1.0), self._seeds()
        self.now, ages, rows = self.move(self.now, self.ages, *given)
        self.ages, rows = np.array(ages), np.array(rows)
        final, _, reward, ended, success = self.team.layout.read(rows[:, 0])
        obs = self.team.layout.read(rows[:, 1])[0]
        over = self.ages == 0
        ended = ended > 0
        return Told(obs, final, reward, ended, over & ~ended, success > 0)

    def _seeds(self) -> np.ndarray:
        return self.draws.integers(2**31, size=self.count, dtype=np.uint32)


def begun(game: AbstractGame, seed: Array) -> tuple[State, Float[Array, "number"]]:
    """The start of an episode, and its packed row."""
    state = game.reset(jax.random.key(seed))
    return state, packed(game, state, jnp.zeros(game.agents))


def moved(game: AbstractGame, state: State, action: Action) -> tuple[State, Float[Array, "number"]]:
    """One step as a rollout has it: a team that has failed stands still and pays for it."""
    _, reward = charged(game, state, action)
    after = game.step(state, action)
    stuck = game.failed(state)
    hold = lambda old, new: jax.lax.select(jnp.broadcast_to(stuck, old.shape), old, new)
    after = jax.tree.map(hold, state, after)
    return after, packed(game, after, reward)


def packed(game: AbstractGame, state: State, reward: Float[Array, "agent"]) -> Array:
    """All that is told of a step in a row."""
    flags = jnp.stack([game.terminated(state), game.success(state)]).astype(jnp.float32)
    seen = game.observations(state).ravel(), game.features(state).ravel()
    return jnp.concatenate([*seen, reward, flags])


# ---- pictures ----

SIDE = 240  # pixels
COLOURS = np.array(
    [(31, 119, 180), (214, 39, 40), (44, 160, 44), (148, 103, 189), (255, 127, 14), (23, 190, 207)],
    np.uint8,
)


def frame_of(team: Team) -> np.ndarray:
    """What the team looks like now, uint8 [height width 3]: places, or distances where none are."""
    canvas = np.full((SIDE, SIDE, 3), 255, np.uint8)
    if team.now is None:
        return canvas
    scene = team.game.scene(team.now)
    if scene is None:
        share = np.clip(np.asarray(team.game.miss(team.now)) / 4, 0.0, 1.0)
        for k, width in enumerate(np.array_split(np.arange(SIDE), len(share))):
            canvas[SIDE - 1 - int(share[k] * (SIDE - 2)) :, width] = COLOURS[k % len(COLOURS)]
        return canvas
    places = np.asarray(scene.position, float)
    goals = places[:0] if scene.goal is None else np.asarray(scene.goal, float)
    flat = lambda x: np.pad(x[:, :2], ((0, 0), (0, max(0, 2 - x.shape[1]))))
    places, goals = flat(places), flat(goals)
    every = np.concatenate([places, goals])
    middle = (every.max(axis=0) + every.min(axis=0)) / 2
    reach = max(1.2 * np.abs(every - middle).max(), 1.0)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(1, -1, SIDE)), axis=-1)
    for k, p in enumerate(places):
        apart = np.linalg.norm(grid - (p - middle) / reach, axis=-1)
        canvas[apart < 0.05] = COLOURS[k % len(COLOURS)]
    for k, p in enumerate(goals):  # rings, so that they do not pass for agents
        apart = np.linalg.norm(grid - (p - middle) / reach, axis=-1)
        canvas[(apart > 0.06) & (apart < 0.08)] = COLOURS[k % len(COLOURS)]
    return canvas
