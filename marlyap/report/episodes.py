"""An episode as a film, and costs along episodes. `film` alone asks a game what a state is."""

from typing import Any, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from marlyap.certificates.certificate import start_of
from marlyap.certificates.lyapunov import CostSum
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame, AbstractRegulation
from marlyap.report.data import Film, Frames
from marlyap.runs import groups
from marlyap.runs.run import Run
from marlyap.seeds import Purpose, stream
from marlyap.simulation.evaluation import episode
from marlyap.simulation.rollout import Controller, rollout, until
from marlyap.types import Key, Keys, State, Trajectory


METRES = "m"  # the unit of every scene
MOST_CURVES = 100  # episodes whose costs are drawn


def one(
    run: Run,
    index: int,
    seed: int,
    label: str = "",
    episodes: int = 500,
    game: AbstractGame | None = None,
    whose: str = "",
) -> Film:
    """One evaluation episode as a film, with L along it where there is one.

    Raises UserError if the episode is not among the evaluation's.
    """
    there = run.game if game is None else game
    _, L = run.deployed()
    controller = run.controller(game)
    path = _episode(there, controller, _start(index, seed, episodes))
    fits = L is not None and groups.same_game(there, run.game)  # L is of the trained game's states
    values = _lyapunov(there, controller, L, path)[:-1] if fits else None
    said = {"label": label or f"start {index}", "start": str(index), "run": whose}
    return film(there, path, values, "L", **said)


def driven(
    game: AbstractGame, controller: Controller, index: int, seed: int, episodes: int = 500
) -> Film:
    """One evaluation episode of a hand-written controller as a film.

    Raises UserError if the episode is not among the evaluation's.
    """
    path = _episode(game, controller, _start(index, seed, episodes))
    return film(game, path, label=f"start {index}", start=str(index))


def _start(index: int, seed: int, episodes: int) -> Key:
    """The key of an evaluation's start. Raises UserError if there is none of this number."""
    if not 0 <= index < episodes:
        raise UserError(
            f"episode: {index} is out of range; the evaluation has 0 to {episodes - 1}."
        )
    return jax.random.split(stream(seed, "evaluate"), episodes)[index]


def worst_case(
    game: AbstractRegulation,
    controller: Controller,
    V: CostSum | None,
    seed: int,
    purpose: str,
    number: int,
    **said: Any,
) -> Film:
    """Two horizons from a start of a certificate, with V along them where it is a cost sum."""
    start = start_of(game, seed, cast(Purpose, purpose), number)
    path, values = _replay(game, controller, V, start)
    return film(game, path, values, "V", start=str(number), **said)


def film(
    game: AbstractGame,
    path: Trajectory,
    lyapunov: Any | None = None,
    function: str = "L",
    **said: Any,
) -> Film:
    """All but the last state of a trajectory as it is drawn, with a function or the cost along it.

    `said` are further fields of the film: label, start, run.
    """
    state = jax.tree.map(lambda leaf: leaf[:-1], path.state)
    scene = jax.vmap(game.scene)(state)
    place = (lambda name: None) if scene is None else (lambda name: _array(getattr(scene, name)))
    positions, frame, goals = place("position"), place("frame"), place("goal")
    flat = positions is not None and positions.shape[2] > 1  # a road is read by its signals too
    linked = np.triu(np.asarray(jax.vmap(game.linked)(state)))
    links = tuple(tuple((int(i), int(j)) for i, j in np.argwhere(now)) for now in linked)
    frames = Frames(
        times=np.arange(len(linked)) * game.dt,
        positions=positions,
        headings=None if frame is None or not flat else _headings(frame),
        goals=goals,
        signals={}
        if flat
        else {k: np.asarray(v) for k, v in jax.vmap(game.signals)(state).items()},
        leaders=tuple(bool(x) and not game.leads.all() for x in game.leads),
        rods=() if scene is None else scene.rods,
        links=links[:1] if all(now == links[0] for now in links) else links,
        edge=game.edge if game.unit == METRES else None,
        unit=METRES,
    )
    cost = np.asarray(path.cost).mean(axis=1)
    return Film(
        frames=frames,
        distance=np.asarray(jax.vmap(game.distance)(state)).max(axis=1),
        edge=game.edge,
        unit=game.unit,
        cost=None if lyapunov is None else cost,
        level=cost if lyapunov is None else np.asarray(lyapunov),
        level_name="cost" if lyapunov is None else function,
        rises=lyapunov is not None,
        success=bool(game.success(jax.tree.map(lambda leaf: leaf[-1], state))),
        **said,
    )


def _array(values: Any) -> np.ndarray | None:
    return None if values is None else np.asarray(values)


def _headings(frame: np.ndarray) -> np.ndarray:
    """The direction ahead of each body, the first of its axes, seen from above."""
    ahead = frame[..., 0, :2]
    size = np.linalg.norm(ahead, axis=-1, keepdims=True)
    return np.divide(ahead, size, out=np.full_like(ahead, np.nan), where=size > 1e-9)


def costs(
    game: AbstractGame, controller: Controller, seed: int, episodes: int
) -> Float[np.ndarray, "episode time"]:
    """What each step of the first evaluation episodes costs the team."""
    keys = jax.random.split(stream(seed, "evaluate"), episodes)[:MOST_CURVES]
    return np.asarray(_costs(game, controller, keys))


@eqx.filter_jit
def _costs(game: AbstractGame, controller: Controller, keys: Keys) -> jax.Array:
    return jax.vmap(lambda k: episode(game, controller, k).cost.mean(axis=1))(keys)


@eqx.filter_jit
def _episode(game: AbstractGame, controller: Controller, key: Key) -> Trajectory:
    """An episode and one step more, whose cost is that of the last state."""
    return episode(game, controller, key, 1)


@eqx.filter_jit
def _lyapunov(game: AbstractGame, controller: Controller, L: Any, path: Trajectory) -> jax.Array:
    """L(s_t, mu(s_t)) along an episode."""
    value = lambda s: L(game.features(s), controller(s, jax.random.key(0)))
    return jax.vmap(value)(path.state)


@eqx.filter_jit
def _replay(
    game: AbstractRegulation, controller: Controller, V: CostSum | None, start: State
) -> tuple[Trajectory, jax.Array | None]:
    """Two horizons from a start and a step more, and V along the two."""
    beyond = 1 if V is None else max(1, V.beyond)
    path = rollout(game, controller, start, jax.random.key(0), 2 * game.horizon + beyond)
    seen = until(path, 2 * game.horizon + 1)
    return seen, None if V is None else V.along(game, path, 2 * game.horizon + 1)
