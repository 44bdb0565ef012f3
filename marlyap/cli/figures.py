"""The figures of `evaluate`: measured, as rows of JSON, in the run, and as a table."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from marlyap.certificates.certificate import arrival
from marlyap.certificates.safety import rules
from marlyap.cli.common import Overrides
from marlyap.controllers import CONTROLLERS, names_a_controller
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame, regulated
from marlyap.games.perturbed import Perturbed
from marlyap.report.measuring import progress
from marlyap.runs import config, groups
from marlyap.runs.run import Run, expand
from marlyap.runs.subject import asked, subject
from marlyap.simulation.evaluation import RESTS, evaluate
from marlyap.storage import store


@dataclass(frozen=True)
class Harder:
    """How much harder than in training the game is: longer, from afar, pushed, a jumping target."""

    horizon: int | None = None  # steps; None: the game's own
    spread: float = 1.0  # how many times as far out episodes begin
    push: float = 0.0  # at the end of every horizon, in SI units
    jump: float = 0.0  # of the target, likewise (m)

    def of(self, game: AbstractGame) -> AbstractGame:
        """The game made harder; itself if nothing is asked.

        Raises UserError for a game without a target set, whose starts or agents cannot be moved.
        """
        game = game if self.horizon is None else game.lasting(self.horizon)
        change = {"spread": self.spread, "push": self.push, "jump": self.jump}
        if change == {"spread": 1.0, "push": 0.0, "jump": 0.0}:
            return game
        change["every"] = game.horizon
        return game.beneath(lambda inner: Perturbed(regulated(inner), **change))  # pyright: ignore

    def words(self) -> str:
        """What was asked, for the title of the table."""
        parts = {"starts {:g} times as far": self.spread if self.spread != 1 else 0.0}
        parts |= {"pushes of {:g} every horizon": self.push}
        parts |= {"the target jumps in {:g} m every horizon": self.jump}
        return "".join(f"; {text.format(x)}" for text, x in parts.items() if x)


@dataclass(frozen=True)
class Named:
    """What the user wants measured: runs and controllers, and on which task."""

    words: Sequence[str]
    task: str | None
    algorithm: str | None
    overrides: Overrides
    shield: bool = False  # whether all of it is measured behind a shield
    harder: Harder = Harder()


def measured(
    named: Named, episodes: int, starts: int, confidence: float
) -> tuple[list[groups.Measured], list[str]]:
    """Controllers and then runs, all on the same starts; and what to say of them.

    A run keeps the figures of its own game as evaluation.json.
    """
    harder = named.harder.of
    game = harder(asked(named.task, named.overrides, named.shield)) if named.task else None
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
        run, there = subject(directory, named.task, named.algorithm, named.overrides, named.shield)
        there = harder(there)
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


def show(result: dict[str, Any], found: Sequence[groups.Measured], words: str = "") -> None:
    """The evaluation as a table on standard output, and what it says in words."""
    rows, teams = result["runs"], result["groups"]
    first, arrivals = rows[0], {arrival(m.game) for m in found}
    reached = arrivals.pop() if len(arrivals) == 1 else "as each task defines it"
    heads, table = _table(result, found)
    console = Console()
    console = console if console.is_terminal else Console(width=max(console.width, 110))
    table.title = f"{first['episodes']} held-out starts of seed {result['start_seed']}{words}; "
    table.title += f"success at the last step: {reached}"
    console.print(table)
    for row in rows:
        if row["beyond_steps"]:
            console.print(f"{row['name']}, later: {later(row)}", highlight=False, markup=False)
    units = {row["unit"] for row in rows}
    unit = units.pop() if len(units) == 1 else "in the unit of each task"
    horizons = 1 + max(m.evaluation.beyond / m.game.horizon for m in found)
    legend = {
        "failed": "failed (for good, as the task says)",
        "rest": "rest (no agent above 0.1 m/s or 0.1 rad/s)",
        "stays": f"stays (in every step until {horizons:g} horizons)",
        "broken": "broken (episodes with a violation)",
    }
    told = ["success", *(text for head, text in legend.items() if head in heads)]
    told = [f"{', '.join(told)}: % of the episodes", f"median and 95 %: worst final miss ({unit})"]
    told += [
        "cost: of a step, mean",
        *["m/s and rad/s: of the fastest agent at the last step, median"] * ("m/s" in heads),
    ]
    console.print("; ".join([*told, "settled: median time (s)"]) + "\n", highlight=False)
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


class Column(NamedTuple):
    """A column of the evaluation's table: its head, and what it says of a row; "" if nothing."""

    head: str
    says: Callable[[dict[str, Any]], str]


def later(row: dict[str, Any]) -> str:
    """What became of it until the end of the watch, in words."""
    said = f"{share(row['lost'])} % lost (farther off at the end than at the start)"
    said += f", 95 % of the worst distances swing by at most {number(row['swing']['0.95'])}"
    said += " in the last horizon"
    if "final_speed" in row:  # the game has a map
        said += f", and the fastest end at {number(row['end_speed']['0.95'])} m/s"
    back = row["back"]
    return said if back is None else f"{said}; {100 * back:.1f} % of horizons end in success"


def share(part: dict[str, Any] | None) -> str:
    return "" if part is None else f"{100 * part['success_rate']:.1f}"


def number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def columns(first: dict[str, Any], ruled: bool, fails: bool) -> list[Column]:
    """The columns of the evaluation's table, the first for a name."""
    half = f"{first['radii'][0]['radius']:.2g}".removeprefix("0")
    median = lambda name: lambda row: f"{row[name]['0.5']:.2f}" if name in row else ""
    interval = lambda row: "-".join(f"{100 * x:.1f}" for x in row["interval"])
    return [
        Column("run", lambda row: escape(row["name"])),
        Column("success", share),
        Column(f"{100 * first['confidence']:g} %", interval),
        Column("failed", lambda row: share(row["failed"]) if fails else ""),
        Column("rest", lambda row: share(row.get("at_rest"))),
        Column("stays", lambda row: share(row["stayed"]) if row["beyond_steps"] else "-"),
        Column("broken", lambda row: share(row["violations"]) if ruled else ""),
        Column(f"in {half}", lambda row: share(row["radii"][0])),
        Column("median", lambda row: number(row["final_distance"]["0.5"])),
        Column("95 %", lambda row: number(row["final_distance"]["0.95"])),
        Column("cost", lambda row: number(row["cost_mean"])),
        Column("m/s", median("final_speed")),
        Column("rad/s", median("final_spin")),
        Column("settled", lambda row: number(row["settling_time"]["0.5"])),
    ]


def _spoken_of(rows: Sequence[dict[str, Any]], found: Sequence[groups.Measured]) -> list[bool]:
    """Whether violations and failures get a column: a game speaks of them, or one occurred."""
    says = {name for m in found for name in rules(m.game)}
    occurred = lambda name: any(r[name]["successes"] for r in rows)
    return [name in says or occurred(name) for name in ("violations", "failed")]


def _table(result: dict[str, Any], found: Sequence[groups.Measured]) -> tuple[list[str], Table]:
    """Its heads, and a row for each run and, where there are several, one for their group."""
    rows, teams = result["runs"], result["groups"]
    ruled, fails = _spoken_of(rows, found)
    table = Table(
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=0,  # the box has a blank between columns; names need the room on 80 of them
    )
    by_name, lines = {row["name"]: row for row in rows}, []
    for members, team in zip(groups.grouped(found).values(), teams, strict=True):
        lines += [by_name[m.name] for m in members]
        lines += [team | {"name": team["about"]}] * (len(members) > 1)
    name, *others = [c for c in columns(rows[0], ruled, fails) if any(map(c.says, lines))]
    table.add_column(name.head, overflow="fold", min_width=10)
    for column in others:
        table.add_column(column.head, justify="right", no_wrap=True)
    for line in lines:
        table.add_row(name.says(line), *(column.says(line) or "-" for column in others))
    return [column.head for column in others], table
