"""What a report says of runs: their evaluations, films, certificates and how they were made."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from marlyap.certificates.certificate import percent
from marlyap.certificates.lyapunov import CostSum
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame, regulated
from marlyap.report.changes import changed_fields, command_of, common
from marlyap.report.charts import along
from marlyap.report.data import (
    Claim,
    Comparison,
    Difference,
    Film,
    Group,
    LogRow,
    Page,
    Share,
    Slice,
    Trained,
    Training,
    Within,
)
from marlyap.report.episodes import costs, worst_case
from marlyap.report.filming import Lead, filmed
from marlyap.report.slices import slices
from marlyap.runs import groups
from marlyap.runs.config import record
from marlyap.runs.run import Run
from marlyap.simulation.evaluation import evaluate
from marlyap.storage import store
from marlyap.storage.hashing import as_json, policy_hash


MEASURED = (
    "Measured, not proved: the interval is about {what} in this simulation, from starts drawn as "
    "in training. {more}"
)
MOST_FILMED = 4  # configurations, the first run of each
MOST_COMPARED = 12


def gather(
    runs: Sequence[Run],
    episodes: int,
    seed: int,
    command: str = "",
    games: Sequence[AbstractGame] | None = None,
    called: str = "",
    beside: str = "",
) -> Page:
    """Everything that a report shows of these runs.

    `games` has the game that each is measured on, by default its own, and `called` is the name of
    that game where it is not the one that a run was trained on. `beside` names the hand-written
    controller that is filmed beside them (`filming.filmed`).
    """
    found = []
    for run, game in zip(runs, games or [run.game for run in runs], strict=True):
        result = evaluate(game, run.controller(game), episodes, seed)
        found.append(groups.of_run(run, result, seed, game, called))
    names, labels = groups.labels(found, brief=True)
    team_of = dict(zip(names, groups.grouped(found).values(), strict=True))
    of = {m.name: (run, label) for m, run, label in zip(found, runs, labels, strict=True)}
    alone = len(runs) == 1
    whose = lambda m: "" if alone else of[m.name][1]
    certified = [certificates(of[m.name][0], m.game, whose(m)) for m in found]
    shown = [claim for c in certified for claim in c.claims]
    places = game_names([(*of[m.name], m) for m in found], called)
    strips = {
        m.name: costs(m.game, of[m.name][0].controller(m.game), seed, episodes) for m in found
    }
    told = lambda those: _more(those, places[those[0].name], strips)
    teams = [_group(name, those, bool(shown), told(those)) for name, those in team_of.items()]
    firsts = [those[0] for those in team_of.values()][:MOST_FILMED]
    named = lambda m: of[m.name][0].labels["algorithm"] if alone else of[m.name][1]
    leads = [Lead(of[m.name][0], m, named(m)) for m in firsts]
    apart = groups.side_by_side([those[0].configuration for those in team_of.values()])
    notes = [
        note
        for m, c in zip(found, certified, strict=True)
        for note in (*_missing(of[m.name][0]), *c.notes)
    ]
    return Page(
        title=_title(runs, found),
        subtitle=_subtitle(found, teams),
        generated=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        starts=seed,
        groups=tuple(teams),
        runs=tuple(
            _trained(of[m.name][0], m, of[m.name][1], name, told([m]))
            for name, members in team_of.items()
            for m in members
        ),
        films=(*filmed(leads, beside), *(shot for c in certified for shot in c.films)),
        comparisons=tuple(
            Comparison(of[p["a"]][1], of[p["b"]][1], p["only_a"], p["only_b"], p["p_value"])
            for p in groups.comparisons(found)[:MOST_COMPARED]
        ),
        claims=tuple(shown),
        slices=tuple(part for c in certified for part in c.slices),
        notes=tuple(notes),
        config=common([m.configuration for m in found]),
        changed=tuple(sorted({name for run in runs for name in changed_fields(run)})),
        differing=tuple(Difference(name, values) for name, values in apart),
        training=tuple(_training(run, label) for run, label in of.values()),
        versions=store.versions(),
        command=command,
    )


def game_names(found: Sequence[tuple[Run, str, groups.Measured]], called: str) -> dict[str, str]:
    """What to call the game of each measured run: its task, and what differs where that is shared."""
    tasks = [called or run.labels["task"] for run, _, _ in found]
    names = groups.named(
        [(task, {"task": record(m.game)}) for task, (_, _, m) in zip(tasks, found, strict=True)]
    )
    return {m.name: name for name, (_, _, m) in zip(names, found, strict=True)}


def _more(
    those: Sequence[groups.Measured], game: str, strips: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """What the charts need of runs that belong together beside their figures."""
    finals = np.concatenate([m.evaluation.final for m in those])
    strip = along(np.concatenate([strips[m.name] for m in those]), those[0].game.dt)
    return {"game": game, "finals": tuple(finals.tolist()), "along": strip}


def figures(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of `data.Figures` out of the summary of an evaluation or a group."""
    known = [name for name in groups.SHARES if name in summary]
    shares = {name: Share(**_about_share(summary[name])) for name in known}
    within = [Within(radius=r["radius"], **_about_share(r)) for r in summary["radii"]]
    return {**summary, **shares, "radii": tuple(within)}


def _about_share(part: Mapping[str, Any]) -> dict[str, Any]:
    return {name: part[name] for name in ("episodes", "successes", "success_rate", "interval")}


def _group(
    label: str, members: Sequence[groups.Measured], certified: bool, more: Mapping[str, Any]
) -> Group:
    """What is said of runs that belong together."""
    said = groups.summary(members)
    text = _caveat(said["about"], certified)
    return Group(label=label, text=text, **figures(said), **more)


def _trained(
    run: Run, measured: groups.Measured, label: str, group: str, more: Mapping[str, Any]
) -> Trained:
    """One run, what its evaluation found and what its log says."""
    log = tuple(
        LogRow(line["steps"], line.get("success"), line.get("return"))
        for line in history(run)[0]
        if "steps" in line
    )
    said = figures(measured.evaluation.summary())
    about = {"name": measured.name, "label": label, "group": group, "seed": run.seed}
    return Trained(**about, log=log, **said, **more)


def _title(runs: Sequence[Run], found: Sequence[groups.Measured]) -> str:
    if len(bases := {m.base for m in found}) == 1:
        return bases.pop()
    names = lambda part: sorted({run.labels[part] for run in runs})
    return f"{' and '.join(names('task'))}: {', '.join(names('algorithm'))}"


def _subtitle(found: Sequence[groups.Measured], teams: Sequence[Group]) -> str:
    count = lambda n, what: f"{n} {what}{'s' * (n != 1)}"
    sizes = {(m.game.agents, len(m.game.informed)) for m in found}
    leaders = lambda n, told: f", {count(told, 'leader')}" if told < n else ""
    parts = [count(n, "agent") + leaders(n, told) for n, told in sizes] * (len(sizes) == 1)
    parts.append(count(len(found), "run"))
    parts += [count(len(teams), "configuration")] * (len(teams) > 1)
    return "; ".join(parts)


def _caveat(about: str, certified: bool) -> str:
    """What the interval is about, and what is certified beside it."""
    one = about == "this policy"
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


def _training(run: Run, label: str) -> Training:
    """When and with what a run was made, and the command that makes it again."""
    about = store.read_json(run.directory / "run.json")
    versions = about.get("versions") if isinstance(about.get("versions"), dict) else {}
    seconds = [line.get("seconds") for line in history(run)[0][-1:]]
    return Training(
        name=label,
        command=command_of(run),
        made=str(about.get("created") or ""),
        seed=run.seed,
        seconds=seconds[0] if seconds else None,
        policy=policy_hash(run.controller())[:12],
        versions={str(k): str(v) for k, v in versions.items()},
    )


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


@dataclass(frozen=True)
class Certified:
    """What `certify` left beside a run: its claims, its worst cases as films, its V in slices."""

    claims: tuple[Claim, ...] = ()
    films: tuple[Film, ...] = ()
    slices: tuple[Slice, ...] = ()
    notes: tuple[str, ...] = ()


def certificates(run: Run, game: AbstractGame, label: str) -> Certified:
    """What is certified of a run.

    A certificate of another policy or another game than these is left out, and a note says so. So
    is V that is not a cost sum.
    """
    place, controller = run.directory / "certificate", run.controller(game)
    if not place.is_dir():
        return Certified()
    try:
        _, meta = store.read(place, "certificate")
    except UserError as error:
        return Certified(notes=(f"{run.directory}: its certificate is left out: {error}",))
    other = "policy" * (meta["policy"] != policy_hash(run.controller()))
    if other or meta["game"] != as_json(game):
        other = other or "game"
        note = f"{run.directory}: its certificate is left out, because it is of another {other}."
        return Certified(notes=(note,))
    V, there = None, regulated(game)
    if meta["V"]["kind"] == "CostSum":
        V = CostSum(controller=controller, T=meta["V"]["T"], ball=meta["V"]["ball"])
    worst: dict[tuple[str, int], list[str]] = {}
    for name, verdict in meta["verdicts"].items():
        if (case := _worst(verdict)) is not None:
            worst.setdefault(case, []).append(name)
    named = lambda case: "" if case is None else f"worst case {run.directory} {case[0]} {case[1]}"
    level = meta["verdicts"].get("basin", {}).get("figures", {}).get("level")
    return Certified(
        claims=tuple(
            _claim(name, v, label, named(_worst(v))) for name, v in meta["verdicts"].items()
        ),
        films=tuple(
            worst_case(
                there,
                controller,
                V,
                meta["seed"],
                *case,
                label=f"worst for {', '.join(names)}",
                run=label or run.labels["algorithm"],
                shot=named(case),
            )
            for case, names in worst.items()
        ),
        slices=() if V is None else slices(there, V, level, label),
    )


def _worst(verdict: Mapping[str, Any]) -> tuple[str, int] | None:
    """The start of the worst case of a verdict, if it can be played again."""
    case = verdict["worst"] or {}
    known = {"purpose", "episode"} <= {*case} and "change" not in case
    return (case["purpose"], case["episode"]) if known else None


def _claim(name: str, verdict: Mapping[str, Any], run: str, shot: str) -> Claim:
    """A verdict as it is shown; `shot` is the film of its worst case."""
    known = {k.replace("_", " "): v for k, v in verdict["scope"].items() if v is not None}
    said = {k: verdict[k] for k in ("claim", "evidence", "holds", "bound", "confidence")}
    asked, bound = verdict["figures"].get("share_asked"), verdict["bound"]
    return Claim(
        name=name,
        run=run,
        shot=shot,
        asked=asked,
        shown=None if asked is None or bound is None else percent(bound),
        scope=", ".join(f"{k}: {v}" for k, v in known.items()),
        **said,
    )
