"""The figures of `evaluate`: measured, as rows of JSON, in the run, and as a table."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from marlyap.certificates.certificate import arrival
from marlyap.certificates.safety import has_rules
from marlyap.cli.common import Overrides
from marlyap.controllers import CONTROLLERS, names_a_controller
from marlyap.errors import UserError
from marlyap.report.contents import progress
from marlyap.runs import config, groups
from marlyap.runs.run import Run, expand
from marlyap.runs.subject import asked, subject
from marlyap.simulation.evaluation import RESTS, evaluate
from marlyap.storage import store


@dataclass(frozen=True)
class Named:
    """What the user wants measured: runs and controllers, and on which task."""

    words: Sequence[str]
    task: str | None
    algorithm: str | None
    overrides: Overrides


def measured(
    named: Named, episodes: int, starts: int, confidence: float
) -> tuple[list[groups.Measured], list[str]]:
    """Controllers and then runs, all on the same starts; and what to say of them.

    A run keeps the figures of its own game as evaluation.json.
    """
    game = asked(named.task, named.overrides) if named.task else None
    found: list[groups.Measured] = []
    directories, notes = [], []
    for word in named.words:
        if names_a_controller(word):
            if game is None:
                raise UserError(f"task: {word} needs --task, the task it is to be measured on.")
            result = evaluate(game, config.load_controller(word, game), episodes, starts)
            found.append(groups.of_controller(word.rpartition(":")[2], game, result, starts))
        elif Path(word).exists():
            directories.append(Path(word))
        else:
            hint = config.suggest(word, CONTROLLERS)
            raise UserError(f"run: there is no run or controller '{word}'; {hint}")
    for directory in expand(directories):
        run, there = subject(directory, named.task, named.algorithm, named.overrides)
        notes += run.warnings
        result = evaluate(there, run.controller(there), episodes, starts)
        found.append(groups.of_run(run, result, starts, there, named.task or ""))
        done, whole = progress(run)
        if done < whole:
            notes.append(f"{directory}: training is unfinished ({done} of {whole} steps).")
        if groups.same_game(there, run.game):
            notes += keep(run, row_of(found[-1], confidence))
    return found, notes


def row_of(measured: groups.Measured, confidence: float) -> dict[str, Any]:
    """One run's or controller's figures, with all that they depend on."""
    about = {"name": measured.name, "group": measured.base, "seed": measured.seed}
    about |= {"start_seed": measured.starts, "game": config.record(measured.game)}
    return about | measured.evaluation.summary(confidence)


def keep(run: Run, row: dict[str, Any]) -> list[str]:
    """Leave the figures in the run; where that cannot be, say so."""
    try:
        store.write_text_atomic(run.directory / "evaluation.json", json.dumps(row, indent=1) + "\n")
    except UserError as error:
        return [f"evaluation.json was not written: {error}"]
    return []


def show(result: dict[str, Any], found: Sequence[groups.Measured]) -> None:
    """The evaluation as a table on standard output, and what it says in words."""
    rows, teams = result["runs"], result["groups"]
    first, arrivals = rows[0], {arrival(m.game) for m in found}
    reached = arrivals.pop() if len(arrivals) == 1 else "as each task defines it"
    ruled = any(has_rules(m.game) for m in found) or any(r["violations"]["successes"] for r in rows)
    title = f"{first['episodes']} held-out starts of seed {result['start_seed']}; "
    console = Console()
    console = console if console.is_terminal else Console(width=max(console.width, 110))
    console.print(_table(title + f"success at the last step: {reached}", result, found, ruled))
    console.print(
        "success, rest (no agent above 0.1 m/s or 0.1 rad/s), stays (in every step until "
        f"{1 + max(m.evaluation.beyond / m.game.horizon for m in found):g} horizons)"
        + (", broken (episodes with a violation)" if ruled else "")
        + ": % of the episodes; median and 95 %: worst final distance (m); m/s and rad/s: of the "
        "fastest agent at the last step, median; settled: median time (s)\n",
        highlight=False,
    )
    for team in teams:
        console.print(f"{team['group']}: {groups.words(team)}", highlight=False, markup=False)
    for row in rows:
        if row["rests"] and row["rests"] != RESTS:
            console.print(f"{row['name']}: {row['rests']}", highlight=False, markup=False)
    for pair in result["comparisons"]:
        text = f"{pair['a']} against {pair['b']}: only the first {pair['only_a']}, "
        text += f"only the second {pair['only_b']}, McNemar p = {pair['p_value']:.2g}"
        console.print(text, highlight=False, markup=False)
    if len(result["comparisons"]) == groups.MOST_PAIRS:
        console.print(f"Only the first {groups.MOST_PAIRS} pairs are compared.", highlight=False)


def cells(row: dict[str, Any], ruled: bool) -> list[str]:
    """One line of the evaluation's table."""
    number = lambda v, digits: "-" if v is None else f"{v:.{digits}f}"
    share = lambda part: f"{100 * part['success_rate']:.1f}"
    low, high = row["interval"]
    return [
        escape(row["name"]),
        share(row),
        f"{100 * low:.1f}-{100 * high:.1f}",
        share(row["at_rest"]),
        share(row["stayed"]) if row["beyond_steps"] else "-",
        *[share(row["violations"])] * ruled,
        share(row["radii"][0]),
        number(row["final_distance"]["0.5"], 3),
        number(row["final_distance"]["0.95"], 3),
        number(row["final_speed"]["0.5"], 2),
        number(row["final_spin"]["0.5"], 2),
        number(row["settling_time"]["0.5"], 1),
    ]


def _table(
    title: str, result: dict[str, Any], found: Sequence[groups.Measured], ruled: bool
) -> Table:
    """A row for each run and, where there are several, one for their group."""
    rows, teams = result["runs"], result["groups"]
    table = Table(
        title=title,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=0,  # the box has a blank between columns; names need the room on 80 of them
    )
    table.add_column("run", overflow="fold", min_width=10)
    percent = f"{100 * rows[0]['confidence']:g} %"
    heads = ["success", percent, "rest", "stays", *["broken"] * ruled, "in .05"]
    for head in [*heads, "median", "95 %", "m/s", "rad/s", "settled"]:
        table.add_column(head, justify="right", no_wrap=True)
    by_name = {row["name"]: row for row in rows}
    for members, team in zip(groups.grouped(found).values(), teams, strict=True):
        for row in [by_name[m.name] for m in members]:
            table.add_row(*cells(row, ruled))
        if len(members) > 1:
            table.add_row(*cells(team | {"name": team["about"]}, ruled))
    return table
