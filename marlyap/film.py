"""What a report shows: films, curves and numbers, as the plain values of `report.Page`."""

import time
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from marlyap import config
from marlyap.errors import UserError
from marlyap.evaluation import Evaluation, episode, evaluate, pooled
from marlyap.game import AbstractGame
from marlyap.rollout import Controller
from marlyap.run import Run, versions
from marlyap.seeds import stream
from marlyap.types import Key, Trajectory


CERTIFIED = (
    "Measured, not proved: the interval is about the share of starts drawn as in training that "
    "succeed, with this policy in this simulation. Stability is not certified by it."
)


def page(runs: Sequence[Run], episodes: int, seed: int, command: str = "") -> dict[str, Any]:
    """Everything that `report.html` draws of these runs."""
    results = [evaluate(run.game, run.controller(), episodes, seed) for run in runs]
    whole = pooled(results).summary()
    names = sorted({run.names["algorithm"] for run in runs})
    tasks = sorted({run.names["task"] for run in runs})
    game = runs[0].game
    count = f"{len(runs)} training seed{'s' * (len(runs) > 1)}"
    return {
        "title": f"{' and '.join(tasks)}: {' and '.join(names)}",
        "subtitle": f"{game.agents} robots, {len(game.leaders)} of them told the target; {count}",
        "generated": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "summary": {
            "success_rate": whole["success_rate"],
            "interval": whole["interval"],
            "episodes": whole["episodes"],
            "successes": whole["successes"],
            "seeds": len(runs),
            "radius": whole["radius"],
            "text": CERTIFIED,
        },
        "runs": [_row(run, result) for run, result in zip(runs, results, strict=True)],
        "films": films(runs[0], results[0], seed),
        "config": {part: config.record(value) for part, value in vars(runs[0].trainer).items()},
        "versions": versions(),
        "command": command,
        "wall_time_s": sum(
            float(line.get("seconds", 0)) for run in runs for line in run.history()[-1:]
        ),
    }


def _row(run: Run, result: Evaluation) -> dict[str, Any]:
    summary = result.summary()
    within = [r | {"rate": r["success_rate"]} for r in summary["radii"]]
    log = [
        {"steps": line["steps"], "success": line.get("success"), "return": line.get("return")}
        for line in run.history()
    ]
    return summary | {
        "name": run.directory.name,
        "label": run.title,
        "algorithm": run.names["algorithm"],
        "seed": run.seed,
        "radii": within,
        "log": log,
    }


def films(run: Run, result: Evaluation, seed: int) -> list[dict[str, Any]]:
    """The best, the median and the worst of the evaluation's episodes, by final distance."""
    order = np.argsort(np.where(np.isfinite(result.final), result.final, np.inf))
    picks = {"best": order[0], "median": order[len(order) // 2], "worst": order[-1]}
    return [one(run, int(k), seed, label, len(order)) for label, k in picks.items()]


def one(run: Run, index: int, seed: int, label: str = "", episodes: int = 500) -> dict[str, Any]:
    """One evaluation episode as a film, with L along it where there is one.

    Raises UserError if the episode is not among the evaluation's.
    """
    if not 0 <= index < episodes:
        raise UserError(
            f"episode: {index} is out of range; the evaluation has 0 to {episodes - 1}."
        )
    policy, L = run.handed_out()
    keys = jax.random.split(stream(seed, "evaluate"), episodes)
    controller = run.controller()
    path = _episode(run.game, controller, keys[index])
    values = None if L is None else _lyapunov(run.game, controller, L, path)
    return strip(run.game, path, values) | {
        "label": label or f"start {index}",
        "start": index,
        "run": run.title,
    }


@eqx.filter_jit
def _episode(game: AbstractGame, controller: Controller, key: Key) -> Trajectory:
    return episode(game, controller, key)


@eqx.filter_jit
def _lyapunov(game: AbstractGame, controller: Controller, L: Any, path: Trajectory) -> jax.Array:
    """L(s_t, mu(s_t)) along an episode."""
    value = lambda s: L(game.features(s), controller(s, jax.random.key(0)))
    return jax.vmap(value)(path.state)


def strip(game: AbstractGame, path: Trajectory, lyapunov: jax.Array | None) -> dict[str, Any]:
    """A trajectory as the plain values that are drawn."""
    dynamics, state = game.dynamics, path.state
    headings = np.asarray(state.x[:, :, 2]).tolist() if "psi" in dynamics.names else None
    linked = np.asarray(jax.vmap(game.linked)(state))
    distance = np.asarray(jax.vmap(game.distance)(state)).max(axis=1)
    edges = [[[int(i), int(j)] for i, j in np.argwhere(np.triu(a))] for a in linked]
    cost = np.asarray(path.cost).mean(axis=1)
    return {
        "dt": game.dt,
        "radius": game.radius,
        "target": np.asarray(state.goal[0]).tolist(),
        "positions": np.asarray(jax.vmap(game.positions)(state)).tolist(),
        "headings": headings,
        "leaders": [bool(x) for x in game.leads],
        "edges": edges[0] if all(e == edges[0] for e in edges) else edges,
        "distance": distance.tolist(),
        "lyapunov": None if lyapunov is None else np.asarray(lyapunov).tolist(),
        "cost": [*cost.tolist(), float(distance[-1])] if len(cost) else [],
        "success": bool(distance[-1] <= game.radius),
    }
