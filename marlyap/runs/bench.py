"""The bench: controllers and runs on many games, at the horizon and at ten times it.

Each cell of the table is measured once and kept as a JSON file, with all that it depends on, so
that a bench can be stopped at any time and resumes where it was.
"""

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jax

from marlyap.controllers import CONTROLLERS, AbstractController
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.runs.config import record
from marlyap.runs.groups import same_game
from marlyap.runs.provenance import SOURCE
from marlyap.runs.run import Run
from marlyap.simulation.evaluation import evaluate
from marlyap.simulation.rollout import AbstractPlanner, Controller
from marlyap.storage import store
from marlyap.storage.hashing import policy_hash


@dataclasses.dataclass(frozen=True)
class Plan:
    """How every cell is measured."""

    episodes: int = 1_000  # held-out starts
    seed: int = 0  # of the starts
    longer: int = 10  # times the horizon, at which every controller is measured once more

    def __post_init__(self):
        if not 1 <= self.episodes <= 1_000_000:
            raise UserError(f"episodes: {self.episodes} is out of range; take 1 to 1000000.")
        if not 1 <= self.longer <= 1_000:
            raise UserError(f"longer: {self.longer} is out of range; take 1 to 1000 horizons.")


@dataclasses.dataclass(frozen=True)
class Cell:
    """One controller on one game over so many steps, and what it is called."""

    game: str
    controller: str
    horizons: int
    made: Callable[[AbstractGame], Controller]  # for this game
    on: AbstractGame
    about: Any  # the record of the controller, or the hash of the run's policy

    @property
    def asked(self) -> dict[str, Any]:
        """All that the figures depend on, but the plan and the code."""
        return {"game": record(self.on), "controller": self.about, "horizons": self.horizons}


def suited(game: AbstractGame) -> list[str]:
    """The hand-written controllers that drive this game, without those that plan beforehand."""
    return [name for name, cls in CONTROLLERS.items() if drives(cls, game)]


def drives(cls: type[AbstractController], game: AbstractGame) -> bool:
    if issubclass(cls, AbstractPlanner) or (cls.drives and game.plant.moves not in cls.drives):
        return False
    try:
        cls(game)
    except UserError:  # it asks for more than the plant, such as one graph
        return False
    return True


def cells(
    games: dict[str, AbstractGame], names: Sequence[str] | None, runs: Sequence[Run], plan: Plan
) -> list[Cell]:
    """Every cell of the table. `names` are controllers; None stands for all that drive a game.

    Raises UserError for a controller that drives none of the games, and a run of none of them.
    """
    found = []
    for name, game in games.items():
        laws = [c for c in suited(game) if names is None or c in names]
        for horizons in dict.fromkeys((1, plan.longer)):
            long = game.lasting(horizons * game.horizon)
            for law in laws:
                cls = CONTROLLERS[law]
                found.append(Cell(name, law, horizons, cls, long, record(cls(game))))
            for run in runs:
                if same_game(run.game, game):
                    place, digest = str(run.directory), policy_hash(run.deployed()[0])
                    found.append(Cell(name, place, horizons, run.controller, long, digest))
    for what in [*(names or ()), *(str(run.directory) for run in runs)]:
        if all(cell.controller != what for cell in found):
            raise UserError(f"bench: {what} drives none of these games; leave it out.")
    return found


def bench(asked: Sequence[Cell], plan: Plan, out: Path) -> Iterator[dict[str, Any]]:
    """A row for each cell, as in the CSV: what `out` keeps of it, and else measured and kept.

    Raises UserError where `out` cannot be written.
    """
    before = None
    for cell in asked:
        if before not in (None, cell.game):
            jax.clear_caches()  # compiled programs fill the memory maps that a process may have
        before = cell.game
        whole = cell.asked | dataclasses.asdict(plan) | {"code": code()}
        name = f"{cell.controller}-{cell.horizons}".replace("/", "+")
        file = out / "cells" / cell.game / f"{name}.json"
        row = kept(file, whole)
        if row is None:
            begin = time.monotonic()
            result = evaluate(cell.on, cell.made(cell.on), plan.episodes, plan.seed, beyond=0)
            row = tidy(cell, result.summary(), round(time.monotonic() - begin, 2))
            file.parent.mkdir(parents=True, exist_ok=True)
            store.write_text_atomic(file, json.dumps({"asked": whole, "row": row}, indent=1) + "\n")
        yield row


def kept(file: Path, asked: dict[str, Any]) -> dict[str, Any] | None:
    """The row in a file, if it is whole and about the same question."""
    try:
        found = json.loads(file.read_text())
        same = json.dumps(found["asked"]) == json.dumps(asked)
        whole = [*found["row"]] == [*COLUMNS]
        return found["row"] if same and whole else None
    except (OSError, ValueError, LookupError, TypeError):
        return None


@cache
def code() -> str:
    """A hash of what decides a figure: games and their data, controllers, how they are played."""
    found = hashlib.sha256()
    for folder in ("games", "tasks", "controllers", "nets", "simulation"):
        for path in sorted((SOURCE / folder).rglob("*")):
            found.update(path.read_bytes() if path.suffix in (".py", ".json") else b"")
    return found.hexdigest()


COLUMNS = ("game", "controller", "horizons", "steps", "episodes", "cost", "success", "low", "high")
COLUMNS += ("failed", "median", "p95", "unit", "seconds")


def tidy(cell: Cell, row: dict[str, Any], seconds: float) -> dict[str, Any]:
    """One line of the CSV, from the summary of an evaluation."""
    low, high = row["interval"]
    values = (cell.game, cell.controller, cell.horizons, cell.on.horizon, row["episodes"])
    values += (row["cost_mean"], row["success_rate"], low, high, row["failed"]["success_rate"])
    values += (row["final_distance"]["0.5"], row["final_distance"]["0.95"], row["unit"])
    return dict(zip(COLUMNS, (*values, seconds), strict=True))
