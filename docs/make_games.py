"""Write docs/games/ from the docstrings of the tasks and what `marlyap bench` measured.

./run marlyap bench --out runs/bench
./run python docs/make_games.py runs/bench/bench.csv
"""

import csv
import dataclasses
import inspect
import shutil
import sys
from itertools import groupby
from pathlib import Path

from marlyap.controllers import CONTROLLERS
from marlyap.games.game import AbstractGame
from marlyap.runs.bench import suited
from marlyap.runs.config import fields, show
from marlyap.tasks import TASKS


FOLDER = Path(__file__).parent / "games"
FIGURES = FOLDER / "bench.csv"


def pages() -> dict[str, str]:
    """The text of every page by its file's name."""
    groups = grouped()
    made = {f"{module}.md": page(names) for module, names in groups.items()}
    return {"README.md": index(groups)} | made


def grouped() -> dict[str, list[str]]:
    """The names of the tasks by the file that they are in."""
    by_module = lambda name: type(TASKS[name].nominal).__module__.rpartition(".")[2]
    return {m: list(those) for m, those in groupby(sorted(TASKS, key=by_module), by_module)}


def index(groups: dict[str, list[str]]) -> str:
    """All games in one table."""
    lines = [
        "# Games",
        "",
        "Every task that has a name, by its file. A cost is that of a step, mean over agents and",
        "steps: of the action zero, and of the cheapest hand-written controller. Made by",
        "`./run marlyap bench --out runs/bench` and `./run python docs/make_games.py "
        "runs/bench/bench.csv`.",
        "",
        "| game | agents | step, horizon | zero: cost, success | best by hand: cost, success |",
        "|---|---|---|---|---|",
    ]
    for module, names in groups.items():
        for name in names:
            game, rows = TASKS[name], measured(name, 1)
            best = min(rows, key=lambda row: float(row["cost"]), default=None)
            none = next((row for row in rows if row["controller"] == "zero"), None)
            told = f"{best['controller']}: {brief(best)}" if best else "-"
            link = f"[{name}]({module}.md)"
            about = f"| {link} | {game.agents} | {game.dt:g} s, {game.horizon} "
            lines.append(f"{about}| {brief(none) if none else '-'} | {told} |")
    return "\n".join([*lines, ""])


def page(names: list[str]) -> str:
    """One game: equations, presets, entries, controllers, figures."""
    game = TASKS[names[0]]
    parts = [f"# {', '.join(names)}", prose(sys.modules[type(game).__module__])]
    parts += ["## Task", prose(type(game)), "## Equations of motion", prose(game.plant.moves)]
    parts += ["## Presets", presets(names), "## What an agent observes", entries(game)]
    parts += ["## Controllers", controllers(game)]
    for name in names:
        if rows := measured(name):
            parts += [f"## Measured: {name}", table(rows)]
    if measured(names[0]):
        parts += [f"![An episode of {names[0]} under {cheapest(names[0])}]({names[0]}.png)"]
    parts.append(
        f"`./run marlyap bench {' '.join(names)}` measures its controllers, and "
        f"`./run marlyap list {names[0]}` shows every field with its meaning."
    )
    return "\n\n".join(parts) + "\n"


def prose(thing) -> str:
    """A docstring, its indented equations as they are."""
    return inspect.getdoc(thing) or ""


def presets(names: list[str]) -> str:
    """What tells the presets of one class apart."""
    first, lines = TASKS[names[0]], []
    for name in names:
        game = TASKS[name]
        base = fields(type(first)()) if _plain(type(first)) else fields(first)
        if type(game) is not type(first):  # a game with another one inside
            base = {f.name: f.default for f in dataclasses.fields(game)} | {"inner": game.nominal}
        other = [f"`{k} = {show(v)}`" for k, v in fields(game).items() if v != base[k]]
        lines.append(f"* `{name}`: {', '.join(other) or 'the defaults'}")
    return "\n".join(lines)


def _plain(cls: type[AbstractGame]) -> bool:
    """Whether every field has a default."""
    return all(p.default is not p.empty for p in inspect.signature(cls).parameters.values())


def entries(game: AbstractGame) -> str:
    lines = ["| # | entry | unit |", "|---|---|---|"]
    told = game.entries()["observation"]
    text = lambda name: name.replace("|", "\\|")
    return "\n".join(
        [*lines, *(f"| {k} | {text(e.name)} | {e.unit} |" for k, e in enumerate(told))]
    )


def controllers(game: AbstractGame) -> str:
    first = lambda cls: " ".join(prose(cls).split("\n\n")[0].split())
    return "\n".join(f"* `{name}`: {first(CONTROLLERS[name])}" for name in suited(game))


def measured(name: str, horizons: int | None = None) -> list[dict[str, str]]:
    """The rows of a game in the CSV."""
    if not FIGURES.exists():
        return []
    with FIGURES.open() as file:
        rows = [row for row in csv.DictReader(file) if row["game"] == name]
    return [row for row in rows if horizons is None or int(row["horizons"]) == horizons]


def brief(row: dict[str, str]) -> str:
    return f"{float(row['cost']):.4g}, {100 * float(row['success']):.1f} %"


def table(rows: list[dict[str, str]]) -> str:
    lines = ["| controller | steps | starts | cost | success, 95 % interval | failed |"]
    lines += ["|---|---|---|---|---|---|"]
    for row in sorted(rows, key=lambda row: (int(row["horizons"]), float(row["cost"]))):
        low, high = (100 * float(row[k]) for k in ("low", "high"))
        success = f"{100 * float(row['success']):.1f} % [{low:.1f}, {high:.1f}]"
        failed = f"{100 * float(row['failed']):.1f} %"
        about = f"| {row['controller']} | {row['steps']} | {row['episodes']} "
        lines.append(f"{about}| {float(row['cost']):.4g} | {success} | {failed} |")
    return "\n".join(lines)


def picture(name: str) -> None:
    """An episode of the cheapest controller: paths on the map, or signals."""
    from marlyap.report.episodes import driven
    from marlyap.report.png import trajectories_png

    game = TASKS[name]
    law = cheapest(name)
    controller = CONTROLLERS[law](game)
    trajectories_png([driven(game, controller, 0, 0)], FOLDER / f"{name}.png")


def cheapest(name: str) -> str:
    """The hand-written controller whose steps cost least."""
    return min(measured(name, 1), key=lambda row: float(row["cost"]))["controller"]


def main(argv: list[str]) -> None:
    FOLDER.mkdir(exist_ok=True)
    if argv:
        shutil.copy(argv[0], FIGURES)
        for names in grouped().values():
            if measured(names[0]):
                picture(names[0])
    for name, text in pages().items():
        (FOLDER / name).write_text(text)


if __name__ == "__main__":
    main(sys.argv[1:])
