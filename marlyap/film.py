"""What a report shows: films, curves and numbers, as the plain values of `report.Page`."""

import time
from collections.abc import Sequence
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap import config, graph as graphs, store
from marlyap.certificate import start_of
from marlyap.errors import UserError
from marlyap.evaluation import Evaluation, episode, evaluate, pooled
from marlyap.game import AbstractGame
from marlyap.identity import policy_hash
from marlyap.lyapunov_function import CostSum, at_target
from marlyap.rollout import Controller, rollout, until
from marlyap.run import Run
from marlyap.seeds import Purpose, stream
from marlyap.types import Key, State, Trajectory


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
    certified = certificates(runs[0])
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
        "films": [*films(runs[0], results[0], seed), *certified["films"]],
        "certificates": certified["certificates"],
        "slices": certified["slices"],
        "config": {part: config.record(value) for part, value in vars(runs[0].trainer).items()},
        "versions": store.versions(),
        "command": command,
        "wall_time_s": sum(
            float(line.get("seconds", 0)) for run in runs for line in run.history()[-1:]
        ),
    }


def progress(run: Run) -> tuple[int, int]:
    """Environment steps done, by the log where the checkpoints are gone, and steps in all."""
    steps = [line["steps"] for line in history(run)[0] if isinstance(line.get("steps"), int)]
    whole = run.trainer.iterations * run.trainer.steps_per_iteration
    return max([run.steps_done, *steps[-1:]]), whole


def history(run: Run) -> tuple[list[dict[str, Any]], str]:
    """The log of a run as far as it can be read, and in words what it lacks."""
    try:
        lines = run.history()
    except UserError as error:
        return [], f"log.jsonl cannot be read ({error})"
    if not lines:
        return [], "log.jsonl is missing, empty or cut off"
    policy = run.directory / "policy"
    logged, known = lines[-1].get("iteration", 0), 0
    if policy.is_dir():
        known = store.read(policy, "policy")[1].get("iteration", 0)
    if logged < known:
        return lines, f"log.jsonl ends at iteration {logged} of {known}"
    return lines, ""


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
    values = None if L is None else _lyapunov(run.game, controller, L, path)[:-1]
    return strip(run.game, path, values) | {
        "label": label or f"start {index}",
        "start": index,
        "run": run.title,
    }


@eqx.filter_jit
def _episode(game: AbstractGame, controller: Controller, key: Key) -> Trajectory:
    """An episode and one step more, whose cost is that of the last state."""
    return episode(game, controller, key, 1)


@eqx.filter_jit
def _lyapunov(game: AbstractGame, controller: Controller, L: Any, path: Trajectory) -> jax.Array:
    """L(s_t, mu(s_t)) along an episode."""
    value = lambda s: L(game.features(s), controller(s, jax.random.key(0)))
    return jax.vmap(value)(path.state)


def strip(game: AbstractGame, path: Trajectory, lyapunov: jax.Array | None) -> dict[str, Any]:
    """All but the last state of a trajectory, as the plain values that are drawn."""
    dynamics, state = game.dynamics, jax.tree.map(lambda leaf: leaf[:-1], path.state)
    headings = np.asarray(state.x[:, :, 2]).tolist() if "psi" in dynamics.names else None
    linked = np.asarray(jax.vmap(game.linked)(state))
    distance = np.asarray(jax.vmap(game.distance)(state)).max(axis=1)
    edges = [[[int(i), int(j)] for i, j in np.argwhere(np.triu(a))] for a in linked]
    cost, goals = np.asarray(path.cost).mean(axis=1), np.asarray(state.goal[0])
    return {
        "dt": game.dt,
        "radius": game.radius,
        "target": (goals[0] if (goals == goals[0]).all() else goals).tolist(),
        "positions": np.asarray(jax.vmap(game.positions)(state)).tolist(),
        "headings": headings,
        "leaders": [bool(x) for x in game.leads],
        "edges": edges[0] if all(e == edges[0] for e in edges) else edges,
        "distance": distance.tolist(),
        "lyapunov": None if lyapunov is None else np.asarray(lyapunov).tolist(),
        "cost": cost.tolist(),
        "success": bool(game.success(jax.tree.map(lambda leaf: leaf[-1], state))),
    }


def certificates(run: Run) -> dict[str, list[dict[str, Any]]]:
    """What `certify` left beside a run: its claims, its worst cases as films, its V along slices.

    A certificate of another policy than the run's is left out, and so is V that is not a cost sum.
    """
    shown: dict[str, list[dict[str, Any]]] = {"certificates": [], "films": [], "slices": []}
    place, controller = run.directory / "certificate", run.controller()
    if not place.is_dir():
        return shown
    _, meta = store.read(place, "certificate")
    if meta["policy"] != policy_hash(controller):
        return shown
    V = None
    if meta["V"]["kind"] == "CostSum":
        V = CostSum(controller=controller, T=meta["V"]["T"], ball=meta["V"]["ball"])
    worst: dict[tuple[str, int], list[str]] = {}
    for name, verdict in meta["verdicts"].items():
        known = {k.replace("_", " "): v for k, v in verdict["scope"].items() if v is not None}
        scope = ", ".join(f"{k}: {v}" for k, v in known.items())
        row = {k: verdict[k] for k in ("claim", "evidence", "holds", "bound", "confidence")}
        shown["certificates"].append(row | {"name": name, "scope": scope})
        if {"purpose", "episode"} <= {*(verdict["worst"] or ())} and "change" not in verdict[
            "worst"
        ]:
            found = verdict["worst"]["purpose"], verdict["worst"]["episode"]
            worst.setdefault(found, []).append(name)
    for (purpose, number), names in worst.items():
        start = start_of(run.game, meta["seed"], cast(Purpose, purpose), number)
        path, values = _replay(run.game, controller, V, start)
        where = {"label": f"worst for {', '.join(names)}", "start": number, "run": run.title}
        shown["films"].append(strip(run.game, path, values) | where)
    if V is not None:
        level = meta["verdicts"].get("basin", {}).get("figures", {}).get("level")
        shown["slices"] = [slice_of(run.game, V, agent, level) for agent in _extremes(run.game)]
    return shown


@eqx.filter_jit
def _replay(
    game: AbstractGame, controller: Controller, V: CostSum | None, start: State
) -> tuple[Trajectory, jax.Array | None]:
    """Two horizons from a start and a step more, and V along the two."""
    beyond = 1 if V is None else max(1, V.beyond)
    path = rollout(game, controller, start, jax.random.key(0), 2 * game.horizon + beyond)
    seen = until(path, 2 * game.horizon + 1)
    return seen, None if V is None else V.along(game, path, 2 * game.horizon + 1)


def _extremes(game: AbstractGame) -> list[int]:
    """A leader, and the agent that is farthest from all leaders."""
    hops = graphs.hops(game.adjacency, game.leaders)
    return sorted({int(np.argmin(hops)), int(np.argmax(hops))})


def slice_of(
    game: AbstractGame, V: CostSum, agent: int, level: float | None, side: int = 41
) -> dict[str, Any]:
    """Contours of V where one agent rests beside the goal (m) and all others on it."""
    import contourpy

    reach = 1.5
    grid = np.linspace(-reach, reach, side)
    values = np.asarray(_plane(game, V, np.asarray(agent), grid))
    levels = [float(v) for v in np.quantile(values, [0.03, 0.1, 0.25, 0.5, 0.75, 0.95])]
    known = level is not None and np.min(values) < level < np.max(values)
    lines = contourpy.contour_generator(grid, grid, values)
    return {
        "label": f"agent {agent}, {'a leader' if game.leads[agent] else 'a follower'}",
        "reach": reach,
        "radius": game.radius,
        "contours": [
            {
                "level": v,
                "lines": [np.asarray(line).round(3).tolist() for line in lines.lines(v)],
                "certified": v == level,
            }
            for v in [*levels, *([level] if known else [])]
        ],
    }


@eqx.filter_jit
def _plane(game: AbstractGame, V: CostSum, agent: Any, grid: Any) -> jax.Array:
    """V [y, x] with one agent at (x, y) from its goal, facing along x."""
    rest = at_target(game, game.reset(jax.random.key(0)))
    if "psi" in game.dynamics.names:
        rest = eqx.tree_at(lambda s: s.x, rest, rest.x.at[:, 2].set(0.0))

    def at(x, y):
        moved = rest.x.at[agent, :2].add(jnp.stack([x, y]))
        return V.value(game, eqx.tree_at(lambda s: s.x, rest, moved))

    row = lambda y: jax.vmap(lambda x: at(x, y))(jnp.asarray(grid))
    return jax.lax.map(row, jnp.asarray(grid))
