"""What a report says of runs: their evaluations, films, certificates and how they were made."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from marlyap.certificates.certificate import percent
from marlyap.certificates.lyapunov import CostSum
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame, regulated
from marlyap.report.changes import changed_fields, command_of, common
from marlyap.report.data import (
    Claim,
    Comparison,
    Difference,
    Film,
    Group,
    Page,
    Slice,
    Training,
)
from marlyap.report.episodes import worst_case
from marlyap.report.filming import Lead, filmed
from marlyap.report.measuring import history, measured, progress
from marlyap.report.slices import slices
from marlyap.runs import groups
from marlyap.runs.run import Run
from marlyap.storage import store
from marlyap.storage.hashing import as_json, policy_hash


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
    tell: Callable[[str], None] = lambda text: None,
) -> Page:
    """Everything that a report shows of these runs.

    `games` has the game that each is measured on, by default its own, and `called` is the name of
    that game where it is not the one that a run was trained on. `beside` names the hand-written
    controller that is filmed beside them (`filming.filmed`). `tell` hears what is being done.
    """
    told = measured(runs, episodes, seed, games, called, tell)
    alone = len(runs) == 1
    whose = lambda m: "" if alone else told.label(m)
    certified = [certificates(told.run(m), m.game, whose(m)) for m in told.found]
    shown = [claim for c in certified for claim in c.claims]
    teams = told.grouped(certified=bool(shown))
    named = lambda m: told.run(m).labels["algorithm"] if alone else told.label(m)
    firsts = [those[0] for those in told.teams.values()]
    leads = [Lead(told.run(m), m, named(m)) for m in firsts[:MOST_FILMED]]
    tell("filming")
    apart = groups.side_by_side([m.configuration for m in firsts])
    notes = [
        note
        for m, c in zip(told.found, certified, strict=True)
        for note in (*_missing(told.run(m)), *c.notes)
    ]
    return Page(
        title=_title(runs, told.found),
        subtitle=_subtitle(told.found, teams),
        generated=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        starts=seed,
        groups=tuple(teams),
        runs=told.trained(),
        films=(*filmed(leads, beside), *(shot for c in certified for shot in c.films)),
        comparisons=tuple(
            Comparison(
                told.labels[p["a"]], told.labels[p["b"]], p["only_a"], p["only_b"], p["p_value"]
            )
            for p in groups.comparisons(told.found)[:MOST_COMPARED]
        ),
        claims=tuple(shown),
        slices=tuple(part for c in certified for part in c.slices),
        notes=tuple(notes),
        config=common([m.configuration for m in told.found]),
        changed=tuple(sorted({name for run in runs for name in changed_fields(run)})),
        differing=tuple(Difference(name, values) for name, values in apart),
        training=tuple(_training(told.run(m), told.label(m)) for m in told.found),
        versions=store.versions(),
        command=command,
    )


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
