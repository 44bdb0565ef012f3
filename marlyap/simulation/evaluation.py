"""How good is a controller? Fresh starts, deterministic policies, exact intervals."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.seeds import Purpose, stream
from marlyap.simulation.rollout import AbstractPlanner, Controller, all_finite, rollout, until
from marlyap.statistics import clopper_pearson, mcnemar
from marlyap.types import Key, Keys, Scalar, State, Trajectory


TIMES = (0.5, 1.0, 1.5, 2.0, 3.0)  # the edge of success, for the success curve
HELD = 5  # steps over which `held` looks back
REST = 0.1  # m/s and rad/s: an agent that moves and turns no faster is at rest
RESTS = "comes to rest"  # said of a team that does
ROOM = 10**8  # numbers of the rollouts that are in memory at once
BEYOND = 9  # horizons after the first over which an evaluation looks whether a team stays


class Outcome(eqx.Module):
    """What is kept of one episode. One in which any number is not finite has failed."""

    success: Bool[Array, ""]  # `game.success` at the horizon
    failed: Bool[Array, ""]  # `game.failed` at the horizon
    final: Scalar  # the worst agent's distance at the horizon (`unit`); NaN where not finite
    held: Bool[Array, ""]  # success in each of the last five steps
    stayed: Bool[Array, ""]  # success from the horizon to the end of the rollout, in every step
    speed: Scalar  # the fastest agent's speed past its goal at the horizon (m/s); 0 without a map
    spin: Scalar  # the fastest agent's rate of turn at the horizon (rad/s); 0 without frames
    back: Scalar  # of the later horizons' ends, the share with success; NaN where there is none
    ended: Scalar  # the fastest agent's speed at the end of the rollout (m/s); 0 without a map
    swing: Scalar  # largest - least worst distance in the rollout's last horizon (`unit`)
    lost: Bool[Array, ""]  # at the rollout's end beyond the edge and farther off than at the start
    settled: Scalar  # the time from which success lasts until the horizon (s); inf if it does not
    violated: Bool[Array, ""]  # an agent broke a rule at some step until the horizon
    total: Scalar  # return until the horizon: the undiscounted sum of the team's rewards
    cost: Scalar  # the team's cost until the horizon, mean over the steps, failures charged


def outcome(game: AbstractGame, trajectory: Trajectory) -> Outcome:
    """Judge one episode of at least `game.horizon` steps; what lies beyond shows if it stays."""
    seen = until(trajectory, game.horizon)
    before, last = (jax.tree.map(lambda x, k=k: x[k], seen.state) for k in (-2, -1))
    speed, spin = motion(game, before, last)
    end = jax.tree.map(lambda x: x[-1], trajectory.state)
    success = jax.vmap(game.success)(trajectory.state)
    inside = success[: game.horizon + 1]
    lasts = jnp.cumprod(inside[::-1])[::-1].astype(bool)
    sound, whole = all_finite(seen), all_finite(trajectory)
    last_two = (jax.tree.map(lambda x, k=k: x[k], trajectory.state) for k in (-2, -1))
    worst = jnp.max(jax.vmap(game.distance)(trajectory.state), axis=1)
    late = worst[-game.horizon :]
    swing = jnp.max(late) - jnp.min(late)
    return Outcome(
        success=inside[-1] & sound,
        failed=game.failed(last),
        final=jnp.where(sound, jnp.max(game.distance(last)), jnp.nan),
        held=jnp.all(inside[-HELD:]) & sound,
        stayed=jnp.all(success[game.horizon :]) & whole,
        back=jnp.mean(success[2 * game.horizon :: game.horizon].astype(float)),
        ended=jnp.where(whole, jnp.max(motion(game, *last_two)[0]), jnp.inf),
        swing=jnp.where(whole, swing, jnp.inf),
        lost=~whole | (worst[-1] > jnp.maximum(worst[0], game.edge)) | game.failed(end),
        speed=jnp.max(speed),
        spin=jnp.max(spin),
        settled=jnp.where(lasts[-1] & sound, jnp.argmax(lasts) * game.dt, jnp.inf),
        violated=jnp.any(jax.vmap(game.violations)(seen.state)),
        total=jnp.sum(jnp.mean(seen.reward, axis=1)),
        cost=jnp.mean(seen.cost),
    )


def motion(
    game: AbstractGame, before: State, now: State
) -> tuple[Float[Array, "agent"], Float[Array, "agent"]]:
    """How fast each agent moves past its goal (m/s) and turns (rad/s), by the game's scene.

    Of a velocity the larger of what the state says and how far the last step went: a state need not
    hold it, and a task may move its agents otherwise than their velocities say. An episode that has
    ended stands still. Zero where there is no map, or no frame.
    """
    old, new = game.scene(before), game.scene(now)
    still = jnp.zeros(game.agents)
    if old is None or new is None:
        return still, still
    n = game.agents
    gone = (new.position[:n] - old.position[:n]) / game.dt
    past = jnp.zeros_like(gone)
    if old.goal is not None and new.goal is not None:
        past = (new.goal - old.goal) / game.dt
    size = lambda v: jnp.linalg.norm(v, axis=1)
    speed = jnp.maximum(size(new.velocity[:n] - past), size(gone - past))
    spin = still if new.spin is None else jnp.abs(new.spin[:n])
    if old.frame is None or new.frame is None:
        return speed, spin
    chord = jnp.sqrt(jnp.sum((new.frame[:n] - old.frame[:n]) ** 2, axis=(1, 2)) / 8)
    return speed, jnp.maximum(spin, 2 * jnp.arcsin(jnp.minimum(chord, 1.0)) / game.dt)


def episode(game: AbstractGame, controller: Controller, key: Key, beyond: int = 0) -> Trajectory:
    """One episode from the start that `key` draws, and `beyond` steps more.

    Controllers with the same key share the start.
    """
    k_start, k_act = jax.random.split(key)
    return rollout(game, controller, game.reset(k_start), k_act, game.horizon + beyond)


@eqx.filter_jit
def outcomes(game: AbstractGame, controller: Controller, keys: Keys, beyond: int = 0) -> Outcome:
    """One outcome for every key."""
    return jax.vmap(lambda k: outcome(game, episode(game, controller, k, beyond)))(keys)


def _in_parts(game: AbstractGame, controller: Controller, keys: Keys, beyond: int) -> Outcome:
    """The outcomes, of as many episodes at once as there is room for: whole rollouts are kept."""
    state = eqx.filter_eval_shape(game.reset, jax.random.key(0))
    numbers = sum(leaf.size for leaf in jax.tree.leaves(state)) + game.agents
    n = max(1, ROOM // (numbers * (game.horizon + beyond)))
    some = [keys[k : k + n] for k in range(0, len(keys), n)]
    parts = [outcomes(game, controller, part, beyond) for part in some]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


@eqx.filter_jit
def _outcomes_of_each(game: AbstractGame, controllers: Controller, keys: Keys) -> Outcome:
    """The same with a controller for every key."""
    one = lambda controller, k: outcome(game, episode(game, controller, k))
    return eqx.filter_vmap(one)(controllers, keys)


def starts(game: AbstractGame, keys: Keys) -> State:
    """Where the episodes of these keys begin."""
    return jax.vmap(lambda k: game.reset(jax.random.split(k)[0]))(keys)


class Evaluation(eqx.Module):
    """The outcomes of many episodes of one controller, as NumPy arrays of length `episodes`."""

    successes: Bool[np.ndarray, "episode"]  # at the horizon
    failed: Bool[np.ndarray, "episode"]  # at the horizon
    final: Float[np.ndarray, "episode"]  # worst distance at the horizon (`unit`)
    held: Bool[np.ndarray, "episode"]  # success in the last five steps
    stayed: Bool[np.ndarray, "episode"]  # success from the horizon until `beyond` steps after it
    speed: Float[np.ndarray, "episode"]  # largest at the horizon (m/s)
    spin: Float[np.ndarray, "episode"]  # largest rate of turn at the horizon (rad/s)
    back: Float[np.ndarray, "episode"]  # of the ends of later horizons, the share with success
    ended: Float[np.ndarray, "episode"]  # largest speed when `beyond` ends (m/s)
    swing: Float[np.ndarray, "episode"]  # of the worst distance in the last horizon (`unit`)
    lost: Bool[np.ndarray, "episode"]  # then beyond the edge and farther off than at the start
    settled: Float[np.ndarray, "episode"]  # s; inf where it does not
    violated: Bool[np.ndarray, "episode"]  # a rule was broken until the horizon
    total: Float[np.ndarray, "episode"]  # return
    cost: Float[np.ndarray, "episode"]  # of the team, mean over the steps, failures charged
    edge: float  # the distance up to which an agent counts as arrived (`unit`)
    unit: str
    mapped: bool  # whether the game has a map: speeds and spins mean something
    beyond: int  # steps after the horizon over which `stayed` looks

    @property
    def radii(self) -> tuple[float, ...]:
        """The edges of the success curve (`unit`): half to three times that of the game."""
        return tuple(round(self.edge * k, 12) for k in TIMES)

    @property
    def success_rate(self) -> float:
        return float(np.mean(self.successes))

    @property
    def at_rest(self) -> Bool[np.ndarray, "episode"]:
        """Successes at whose horizon no agent moves or turns faster than `REST`."""
        return self.successes & (self.speed <= REST) & (self.spin <= REST)

    def summary(self, confidence: float = 0.95) -> dict[str, Any]:
        """Plain numbers: rates with exact intervals, distances (m), times (s), speeds."""
        within = [{"radius": r} | share(self.final <= r, confidence) for r in self.radii]
        found = (
            share(self.successes, confidence)
            | {"confidence": confidence, "radius": self.edge, "unit": self.unit, "radii": within}
            | {"failed": share(self.failed, confidence)}
            | {"held": share(self.held, confidence)}
            | {"stayed": share(self.stayed, confidence), "beyond_steps": self.beyond}
            | {"lost": share(self.lost, confidence)}
            | {"back": float(np.mean(self.back)) if np.isfinite(self.back).all() else None}
            | {"end_speed": quantiles(self.ended), "swing": quantiles(self.swing)}
            | {"violations": share(self.violated, confidence)}
            | {"final_distance": quantiles(self.final), "settling_time": quantiles(self.settled)}
            | {"return_mean": float(np.mean(self.total)), "cost_mean": float(np.mean(self.cost))}
            | {"rests": self.rests()}
        )
        moving = {"final_speed": quantiles(self.speed), "final_spin": quantiles(self.spin)}
        rest = {"at_rest": share(self.at_rest, confidence)} | moving
        return found | (rest if self.mapped else {})

    def rests(self) -> str:
        """What the agents do once they have arrived, in words; empty where none has, or no map."""
        moving = self.successes & ~self.at_rest
        if not self.mapped or not self.successes.any():
            return ""
        if np.mean(moving[self.successes]) < 0.5:
            return RESTS
        speed, spin = np.median(self.speed[moving]), np.median(self.spin[moving])
        what = "circles inside the ball" if spin > REST else "keeps moving inside the ball"
        what = "turns on the spot" if speed <= REST else what
        return f"{what} (median {speed:.2g} m/s, {spin:.2g} rad/s)"


def evaluate(
    game: AbstractGame,
    controller: Controller | AbstractPlanner,
    episodes: int = 500,
    seed: int = 0,
    purpose: Purpose = "evaluate",
    beyond: int | None = None,
) -> Evaluation:
    """Drive the game from `episodes` held-out starts; the same seed gives the same starts.

    `beyond` is for how many steps after the horizon it is watched whether the team stays; the
    default is nine horizons, and 0 for a planner, whose plan ends at the horizon.

    Raises UserError if `episodes` or `beyond` is out of range, or the controller does not return
    one action for each agent.
    """
    if not 1 <= episodes <= 10_000_000:
        raise UserError(f"episodes: {episodes} is out of range; take 1 to 10000000.")
    keys = jax.random.split(stream(seed, purpose), episodes)
    if isinstance(controller, AbstractPlanner):
        beyond = 0
        out = _outcomes_of_each(game, controller.plan(starts(game, keys)), keys)
    else:
        drives(game, controller)
        beyond = BEYOND * game.horizon if beyond is None else beyond
        if not 0 <= beyond <= 1_000_000:
            raise UserError(f"beyond: {beyond} steps is out of range; take 0 to 1000000.")
        out = _in_parts(game, controller, keys, beyond)
    found = {k: np.asarray(v) for k, v in vars(out).items() if k != "success"}
    kind = {"edge": game.edge, "unit": game.unit, "mapped": mapped(game)}
    return Evaluation(np.asarray(out.success), **found, **kind, beyond=beyond)


def mapped(game: AbstractGame) -> bool:
    """Whether the game has a map."""
    return eqx.filter_eval_shape(lambda: game.scene(game.reset(jax.random.key(0)))) is not None


def drives(game: AbstractGame, controller: Controller) -> None:
    """Raise UserError unless the controller returns an action [agents, inputs] for this game."""
    act = lambda key: controller(game.reset(key), key)
    shape = jax.numpy.shape(eqx.filter_eval_shape(act, jax.random.key(0)))
    wanted = game.agents, game.du
    if shape != wanted:
        raise UserError(
            f"controller: it returns an action of shape {list(shape)}, and {type(game).__name__} "
            f"needs {list(wanted)}, one row for each agent."
        )


def pooled(evaluations: Sequence[Evaluation]) -> Evaluation:
    """The outcomes of several controllers in one game taken together.

    Its intervals are about these very controllers. About the algorithm that trained them, or
    another training seed, they say nothing.
    """
    whole = lambda name: isinstance(getattr(evaluations[0], name), np.ndarray)
    names = [name for name in vars(evaluations[0]) if whole(name)]
    join = lambda name: np.concatenate([getattr(e, name) for e in evaluations])
    return dataclasses.replace(evaluations[0], **{name: join(name) for name in names})


def compare(a: Evaluation, b: Evaluation) -> dict[str, Any]:
    """McNemar's exact test on the same starts."""
    only_a, only_b, p = mcnemar(a.successes, b.successes)
    return {"only_a": int(only_a), "only_b": int(only_b), "p_value": float(p)}


def share(hits: Bool[np.ndarray, "episode"], confidence: float) -> dict[str, Any]:
    """How many of the episodes, with the exact Clopper-Pearson interval."""
    k, n = int(np.sum(hits)), len(hits)
    low, high = clopper_pearson(k, n, confidence)
    rate = {"episodes": n, "successes": k, "success_rate": k / n}
    return rate | {"interval": [float(low), float(high)]}


def quantiles(values: Array | np.ndarray) -> dict[str, float | None]:
    """Median, 95 % and largest; None where it is not finite."""
    ordered = np.sort(np.where(np.isnan(values), np.inf, values))
    pick = lambda q: float(ordered[min(int(np.ceil(q * len(ordered))), len(ordered)) - 1])
    return {str(q): (v if np.isfinite(v := pick(q)) else None) for q in (0.5, 0.95, 1.0)}
