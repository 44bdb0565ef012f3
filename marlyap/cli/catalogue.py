"""What `marlyap list` shows: names with a sentence each, and the fields of one."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from marlyap.certificates import CERTIFICATES
from marlyap.controllers import CONTROLLERS, AbstractController
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.games.sensing import Entry
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.algorithms import ALGORITHMS, PRESETS
from marlyap.learning.trainer import SCHEDULES
from marlyap.runs import config
from marlyap.tasks import TASKS


PRESET_NOTES = {
    "tuned": "what learns best here; every algorithm and schedule as listed",
    "paper": "section 4 of the paper: plain networks, one environment, 100,000 steps",
}


FAMILIES: dict[str, Mapping[str, Any]] = {
    "tasks": TASKS,
    "algorithms": ALGORITHMS,
    "controllers": CONTROLLERS,
    "certificates": CERTIFICATES,
}


def show_all(quiet: bool) -> dict[str, Any]:
    """Every name, by its family, with a sentence."""
    result = {
        title: {name: summary(thing) for name, thing in family.items()}
        for title, family in FAMILIES.items()
    }
    result["presets"] = dict(PRESET_NOTES)
    if not quiet:
        console = Console()
        for title, members in result.items():
            table = Table(
                title=title, title_justify="left", show_header=False, box=None, padding=(0, 2)
            )
            for name, text in members.items():
                table.add_row(f"[bold]{escape(name)}[/]", escape(text))
            console.print(table, "")
        console.print("`marlyap list NAME` shows the fields of each, and `marlyap list schedule`.")
    return result


def summary(thing: Any) -> str:
    """The first sentence of its documentation, and what sets it apart from others of its class."""
    cls = thing if isinstance(thing, type) else type(thing)
    first = (cls.__doc__ or "").strip().partition("\n\n")[0]
    line = re.split(r"(?<=\.) (?=[A-Z])", " ".join(first.split()))[0]
    if isinstance(thing, AbstractGame):
        n, who = thing.agents, len(thing.informed)
        limits = " and ".join(f"{u:g}" for u in thing.plant.limits)
        leaders = f", {who} leader{'s' * (who > 1)}" if who < n else ""
        line += f" ({n} agents{leaders}, {thing.graph} graph, limits {limits})"
    elif isinstance(thing, AbstractAlgorithm) and (set_here := changes(thing)):
        line += f" ({', '.join(set_here)})"
    return line


def changes(thing: Any, prefix: str = "") -> list[str]:
    """The fields, nested ones too, that are not what their class has by default."""
    usual, found = config.fields(type(thing)()), []
    for name, value in config.fields(thing).items():
        if config.show(value) != config.show(usual[name]):
            found.append(f"{prefix}{name} {config.show(value)}")
        if dataclasses.is_dataclass(value):
            found += changes(value, f"{prefix}{name}.")
    return found


def show_fields(name: str, quiet: bool) -> dict[str, Any]:
    """Every field of what `list` names, or of path/to/file.py:Name, with value and meaning."""
    rows = rows_of(name)
    table = Table(title=escape(name), title_justify="left", title_style="bold")
    table.add_column("option", overflow="fold", min_width=max(len(row[0]) for row in rows))
    table.add_column("value", overflow="fold")
    table.add_column("meaning", overflow="fold")
    for row in rows:
        table.add_row(*map(escape, row))
    found: dict[str, Any] = {
        option: {"value": value, "meaning": note} for option, value, note in rows
    }
    if not quiet:
        Console().print(table)
    if (game := game_called(name)) is not None:
        entries = game.entries()
        found["entries"] = {k: [e._asdict() for e in of_kind] for k, of_kind in entries.items()}
        if not quiet:
            show_entries(entries)
    return found


def show_entries(entries: Mapping[str, Sequence[Entry]]) -> None:
    """What every number of an observation, a state and an action is."""
    for kind, of_kind in entries.items():
        table = Table(title=f"one agent's {kind}", title_justify="left", title_style="bold")
        for head in ("#", "entry", "unit", "frame"):
            table.add_column(head, overflow="fold")
        for k, entry in enumerate(of_kind):
            table.add_row(str(k), escape(entry.name), entry.unit, entry.frame)
        if of_kind:
            Console().print(table)


def rows_of(name: str) -> list[tuple[str, str, str]]:
    """(option or field, value, meaning) of whatever has this name."""
    dotted = lambda obj, part: [(f"--{o}", v, m) for o, v, m in config.describe(obj, part)]
    for table, family in ((TASKS, AbstractGame), (ALGORITHMS, AbstractAlgorithm)):
        if name in table:
            return dotted(table[name], config.WORDS[family])
    if name in ("schedule", *PRESETS):
        return dotted(SCHEDULES["tuned" if name == "schedule" else name], "schedule")
    if name in CONTROLLERS:
        return gains_of(CONTROLLERS[name])
    if name in CERTIFICATES:
        return [(o.lstrip("."), v, m) for o, v, m in config.describe(CERTIFICATES[name], "")]
    if ":" not in name and not name.endswith(".py"):
        there = [*TASKS, *ALGORITHMS, *CONTROLLERS, *CERTIFICATES, *PRESETS, "schedule"]
        raise UserError(f"name: nothing is called '{name}'; {config.suggest(name, there)}")
    if (game := game_called(name)) is not None:
        return dotted(game, "task")
    with suppress(config.NotOfThatKind):
        return dotted(config.load(name, AbstractAlgorithm), "algorithm")
    with suppress(config.NotOfThatKind):
        return gains_of(config.controller_class(name))
    path, _, attribute = name.rpartition(":")
    raise UserError(
        f"name: {path} defines no task, algorithm or controller called '{attribute}'; write its "
        "class there."
    )


def gains_of(cls: type[AbstractController]) -> list[tuple[str, str, str]]:
    """(field, value, meaning) of a controller."""
    return config.describe_class(cls) or [("(no gains)", "", "")]


def game_called(name: str) -> AbstractGame | None:
    """The task of this name, or in path/to/file.py:Name; None where that is no task."""
    if name in TASKS or ":" not in name:
        return TASKS.get(name)
    with suppress(config.NotOfThatKind):
        return config.load(name, AbstractGame)
    return None
