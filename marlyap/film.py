"""What a report shows: films, curves and numbers, as the plain values of `report.Page`."""

import shlex
import time
from collections.abc import Mapping, Sequence
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap import config, graph as graphs, groups, store
from marlyap.algorithms import ALGORITHMS, PRESETS
from marlyap.certificate import percent, start_of
from marlyap.errors import UserError
from marlyap.evaluation import episode, evaluate
from marlyap.game import AbstractGame
from marlyap.identity import plain, policy_hash
from marlyap.lyapunov_function import CostSum
from marlyap.rollout import Controller, rollout, until
from marlyap.run import Run
from marlyap.seeds import Purpose, stream
from marlyap.tasks import TASKS
from marlyap.trainer import schedule_for
from marlyap.types import Key, State, Trajectory


MEASURED = (
    "Measured, not proved: the interval is about {what} in this simulation, from starts drawn as "
    "in training. {more}"
)
MOST_FILMED = 4  # configurations, the first run of each
MOST_COMPARED = 12


def page(
    runs: Sequence[Run],
    episodes: int,
    seed: int,
    command: str = "",
    games: Sequence[AbstractGame] | None = None,
    called: str = "",
) -> dict[str, Any]:
    """Everything that `report.html` draws of these runs.

    `games` has the game that each is measured on, by default its own, and `called` is the name of
    that game where it is not the one that a run was trained on.
    """
    found = []
    for run, game in zip(runs, games or [run.game for run in runs], strict=True):
        result = evaluate(game, run.controller(game), episodes, seed)
        found.append(groups.of_run(run, result, seed, game, called))
    names, labels = groups.labels(found, brief=True)
    team_of = dict(zip(names, groups.grouped(found).values(), strict=True))
    of = {m.name: (run, label) for m, run, label in zip(found, runs, labels, strict=True)}
    teams = [{"label": n} | groups.summary(members) for n, members in team_of.items()]
    alone = len(runs) == 1
    whose = lambda m: "" if alone else of[m.name][1]
    certified = [certificates(of[m.name][0], m.game, whose(m)) for m in found]
    shown = [claim for c in certified for claim in c["certificates"]]
    leads = [members[0] for members in team_of.values()][:MOST_FILMED]
    filmed = [shot for m in leads for shot in films(of[m.name][0], m, whose(m))]
    pairs = [p | {k: of[p[k]][1] for k in "ab"} for p in groups.comparisons(found)]
    apart = groups.differing([members[0].configuration for members in team_of.values()])
    notes = [
        note
        for m, c in zip(found, certified, strict=True)
        for note in (*_missing(of[m.name][0]), *c["notes"])
    ]
    return {
        "title": _title(runs, found),
        "subtitle": _subtitle(found, teams),
        "generated": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "starts": seed,
        "groups": [t | {"text": _caveat(t, bool(shown))} for t in teams],
        "runs": [
            _row(of[m.name][0], m, of[m.name][1], name)
            for name, members in team_of.items()
            for m in members
        ],
        "films": [*filmed, *(shot for c in certified for shot in c["films"])],
        "comparisons": pairs[:MOST_COMPARED],
        "certificates": shown,
        "slices": [part for c in certified for part in c["slices"]],
        "notes": notes,
        "config": common([m.configuration for m in found]),
        "changed": sorted({name for run in runs for name in changed_fields(run)}),
        "differing": [
            {"name": name, "fields": fields}
            for name, fields in zip(team_of, apart, strict=True)
            if len(team_of) > 1
        ],
        "training": [_training(run, label) for run, label in of.values()],
        "versions": store.versions(),
        "command": command,
    }


def _title(runs: Sequence[Run], found: Sequence[groups.Measured]) -> str:
    if len(bases := {m.base for m in found}) == 1:
        return bases.pop()
    names = lambda part: sorted({run.labels[part] for run in runs})
    return f"{' and '.join(names('task'))}: {', '.join(names('algorithm'))}"


def _subtitle(found: Sequence[groups.Measured], teams: Sequence[Mapping[str, Any]]) -> str:
    count = lambda n, what: f"{n} {what}{'s' * (n != 1)}"
    sizes = {(m.game.agents, len(m.game.informed)) for m in found}
    parts = [f"{count(a, 'agent')}, {count(b, 'leader')}" for a, b in sizes] * (len(sizes) == 1)
    parts.append(count(len(found), "run"))
    parts += [count(len(teams), "configuration")] * (len(teams) > 1)
    return "; ".join(parts)


def _caveat(team: Mapping[str, Any], certified: bool) -> str:
    """What the interval is about, and what is certified beside it."""
    one = team["about"] == "this policy"
    what = "the share of starts from which this policy succeeds"
    if not one:
        what = "the expected success rate of a policy that is trained with a new seed,"
    more = "What is certified, and on what evidence, stands below."
    return MEASURED.format(
        what=what, more=more if certified else "Stability is not certified by it."
    )


def _missing(run: Run) -> list[str]:
    """What a report of this run has to do without."""
    why, (done, whole) = history(run)[1], progress(run)
    place = run.directory
    lacks = [f"{place}: learning curves are missing or cut short: {why}."] if why else []
    if done < whole:
        lacks.append(f"{place}: training is unfinished ({done} of {whole} steps).")
    return [*run.warnings, *lacks]


def common(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The fields that are equal in all records, nested as they are."""
    first, rest = records[0], records[1:]
    kept = {}
    for name, value in first.items():
        others = [r[name] for r in rest if name in r]
        if len(others) < len(rest):
            continue
        if isinstance(value, Mapping) and all(isinstance(o, Mapping) for o in others):
            if inner := common([value, *others]):
                kept[name] = inner
        elif all(o == value for o in others):
            kept[name] = value
    return kept


def changed_fields(run: Run) -> dict[str, str]:
    """Fields of a run, by dotted name, that are not what their class has by default."""
    t, found = run.trainer, {}
    for part, value in {"task": t.game, "algorithm": t.algorithm, "schedule": t.schedule}.items():
        found |= changed_from(value, _usual(value), part)
    return found


def changed_from(thing: Any, usual: Any, path: str) -> dict[str, str]:
    """Fields of an object, by dotted name, that are not what they usually are."""
    found: dict[str, str] = {}
    for name, value in config.fields(thing).items():
        normal = config.fields(usual).get(name) if usual is not None else None
        if isinstance(value, eqx.Module):
            if type(value) is not type(normal):
                found[f"{path}.{name}"] = config.show(value)
                normal = _usual(value)
            found |= changed_from(value, normal, f"{path}.{name}")
        elif usual is None or value != normal:
            found[f"{path}.{name}"] = config.show(value)
    return found


def _command(run: Run) -> str:
    """The command that trains this run; empty where its parts cannot be named."""
    name = run.names
    if name["task"] not in TASKS or name["algorithm"] not in ALGORITHMS:
        return ""  # code of the user's own, or an object made in Python
    rule = PRESETS.get(name["preset"] or "tuned", PRESETS["tuned"])(ALGORITHMS[name["algorithm"]])
    plan = schedule_for(rule, name["preset"] or "tuned")
    words = ["marlyap", "train", name["task"], name["algorithm"], "--seeds", str(run.seed)]
    words += ["--preset", name["preset"]] * (name["preset"] not in ("", "tuned"))
    t = run.trainer
    usual = {"task": TASKS[name["task"]], "algorithm": rule, "schedule": plan}
    for part, value in {"task": t.game, "algorithm": t.algorithm, "schedule": t.schedule}.items():
        for field, shown in changed_from(value, usual[part], part).items():
            words += [f"--{field}", shown]
    return shlex.join(words)


def _usual(thing: Any) -> Any:
    """The object that its class makes of nothing; None where that cannot be."""
    try:
        return type(thing)()
    except (TypeError, UserError):
        return None


def _training(run: Run, label: str) -> dict[str, Any]:
    """When and with what a run was made, and the command that makes it again."""
    about = store.read_json(run.directory / "run.json")
    versions = about.get("versions") if isinstance(about.get("versions"), dict) else {}
    seconds = [line.get("seconds") for line in history(run)[0][-1:]]
    return {
        "name": label,
        "command": _command(run),
        "made": str(about.get("created") or ""),
        "seed": run.seed,
        "seconds": seconds[0] if seconds else None,
        "policy": policy_hash(run.controller())[:12],
        "versions": {str(k): str(v) for k, v in versions.items()},
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


def _row(run: Run, measured: groups.Measured, label: str, group: str) -> dict[str, Any]:
    log = [
        {"steps": line["steps"], "success": line.get("success"), "return": line.get("return")}
        for line in history(run)[0]
        if "steps" in line
    ]
    about = {"name": measured.name, "label": label, "group": group, "seed": run.seed, "log": log}
    return measured.evaluation.summary() | about


def films(run: Run, measured: groups.Measured, label: str = "") -> list[dict[str, Any]]:
    """The best, the median and the worst of the evaluation's episodes, by final distance."""
    final = measured.evaluation.final
    order = np.argsort(np.where(np.isfinite(final), final, np.inf))
    picks = {"best": order[0], "median": order[len(order) // 2], "worst": order[-1]}
    one_of = lambda k, name: one(run, int(k), measured.starts, name, len(order), measured.game)
    return [one_of(k, name) | {"run": label} for name, k in picks.items()]


def one(
    run: Run,
    index: int,
    seed: int,
    label: str = "",
    episodes: int = 500,
    game: Any | None = None,
) -> dict[str, Any]:
    """One evaluation episode as a film, with L along it where there is one.

    Raises UserError if the episode is not among the evaluation's.
    """
    if not 0 <= index < episodes:
        raise UserError(
            f"episode: {index} is out of range; the evaluation has 0 to {episodes - 1}."
        )
    there = run.game if game is None else game
    _, L = run.deployed()
    keys = jax.random.split(stream(seed, "evaluate"), episodes)
    controller = run.controller(game)
    path = _episode(there, controller, keys[index])
    fits = L is not None and groups.same_game(there, run.game)  # L is of the trained game's states
    values = _lyapunov(there, controller, L, path)[:-1] if fits else None
    return strip(there, path, values) | {"label": label or f"start {index}", "start": index}


@eqx.filter_jit
def _episode(game: Any, controller: Controller, key: Key) -> Trajectory:
    """An episode and one step more, whose cost is that of the last state."""
    return episode(game, controller, key, 1)


@eqx.filter_jit
def _lyapunov(game: Any, controller: Controller, L: Any, path: Trajectory) -> jax.Array:
    """L(s_t, mu(s_t)) along an episode."""
    value = lambda s: L(game.features(s), controller(s, jax.random.key(0)))
    return jax.vmap(value)(path.state)


def strip(game: Any, path: Trajectory, lyapunov: jax.Array | None) -> dict[str, Any]:
    """All but the last state of a trajectory, as the plain values that are drawn."""
    dynamics, state = game.dynamics, jax.tree.map(lambda leaf: leaf[:-1], path.state)
    headings = np.asarray(state.x[:, :, 2]).tolist() if "psi" in dynamics.names else None
    linked = np.asarray(jax.vmap(game.linked)(state))
    distance = np.asarray(jax.vmap(game.distance)(state)).max(axis=1)
    edges = [[[int(i), int(j)] for i, j in np.argwhere(np.triu(a))] for a in linked]
    cost, goals = np.asarray(path.cost).mean(axis=1), np.asarray(state.scenario.goal[0])
    return {
        "dt": game.dt,
        "radius": game.edge,
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


def certificates(run: Run, game: Any, label: str) -> dict[str, list[Any]]:
    """What `certify` left beside a run: its claims, its worst cases as films, its V along slices.

    A certificate of another policy or another game than these is left out, and a note says so. So
    is V that is not a cost sum.
    """
    shown: dict[str, list[Any]] = {"certificates": [], "films": [], "slices": [], "notes": []}
    place, controller = run.directory / "certificate", run.controller(game)
    if not place.is_dir():
        return shown
    try:
        _, meta = store.read(place, "certificate")
    except UserError as error:
        shown["notes"].append(f"{run.directory}: its certificate is left out: {error}")
        return shown
    other = "policy" * (meta["policy"] != policy_hash(run.controller()))
    if other or meta["game"] != plain(game):
        shown["notes"].append(
            f"{run.directory}: its certificate is left out, because it is of another "
            f"{other or 'game'}."
        )
        return shown
    V = None
    if meta["V"]["kind"] == "CostSum":
        V = CostSum(controller=controller, T=meta["V"]["T"], ball=meta["V"]["ball"])
    worst: dict[tuple[str, int], list[str]] = {}
    for name, verdict in meta["verdicts"].items():
        known = {k.replace("_", " "): v for k, v in verdict["scope"].items() if v is not None}
        scope = ", ".join(f"{k}: {v}" for k, v in known.items())
        row = {k: verdict[k] for k in ("claim", "evidence", "holds", "bound", "confidence")}
        row |= {"asked": verdict["figures"].get("share_asked"), "run": label}
        if row["asked"] is not None and row["bound"] is not None:
            row["shown"] = percent(row["bound"])
        shown["certificates"].append(row | {"name": name, "scope": scope})
        case = verdict["worst"] or {}
        if {"purpose", "episode"} <= {*case} and "change" not in case:
            worst.setdefault((case["purpose"], case["episode"]), []).append(name)
    for (purpose, number), names in worst.items():
        start = start_of(game, meta["seed"], cast(Purpose, purpose), number)
        path, values = _replay(game, controller, V, start)
        where = {"label": f"worst for {', '.join(names)}", "start": number, "run": label}
        shown["films"].append(strip(game, path, values) | where | {"function": "V"})
    if V is not None:
        level = meta["verdicts"].get("basin", {}).get("figures", {}).get("level")
        shown["slices"] = [
            slice_of(game, V, agent, level) | {"run": label} for agent in _extremes(game)
        ]
    return shown


@eqx.filter_jit
def _replay(
    game: Any, controller: Controller, V: CostSum | None, start: State
) -> tuple[Trajectory, jax.Array | None]:
    """Two horizons from a start and a step more, and V along the two."""
    beyond = 1 if V is None else max(1, V.beyond)
    path = rollout(game, controller, start, jax.random.key(0), 2 * game.horizon + beyond)
    seen = until(path, 2 * game.horizon + 1)
    return seen, None if V is None else V.along(game, path, 2 * game.horizon + 1)


def _extremes(game: Any) -> list[int]:
    """A leader, and the agent that is farthest from all leaders."""
    hops = graphs.hops(game.adjacency, game.informed)
    return sorted({int(np.argmin(hops)), int(np.argmax(hops))})


def slice_of(
    game: Any, V: CostSum, agent: int, level: float | None, side: int = 41
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
        "radius": game.edge,
        "headings": "psi" in game.dynamics.names,
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
def _plane(game: Any, V: CostSum, agent: Any, grid: Any) -> jax.Array:
    """V [y, x] with one agent at (x, y) from its goal, facing along x."""
    rest = game.at_target(game.reset(jax.random.key(0)))
    if "psi" in game.dynamics.names:
        rest = eqx.tree_at(lambda s: s.x, rest, rest.x.at[:, 2].set(0.0))

    def at(x, y):
        moved = rest.x.at[agent, :2].add(jnp.stack([x, y]))
        return V.value(game, eqx.tree_at(lambda s: s.x, rest, moved))

    row = lambda y: jax.vmap(lambda x: at(x, y))(jnp.asarray(grid))
    return jax.lax.map(row, jnp.asarray(grid))
