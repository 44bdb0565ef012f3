"""Every cell of a plan made and compared before anything starts."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from marlyap.errors import UserError
from marlyap.learning.traced import is_traced
from marlyap.learning.trainers import trainer_for
from marlyap.learning.training import AbstractTrainer
from marlyap.runs import asked as asking, config
from marlyap.runs.asked import Asked
from marlyap.sweeps.plan import WORDS, Cell, Plan, Range, name_of


class Made(NamedTuple):
    """A cell that can be trained."""

    name: str  # of its folder
    set: Cell
    iterations: int  # of each of its jobs
    program: str  # equal for cells that one compiled program trains


def checked(plan: Plan) -> list[Made]:
    """The cells of a plan; those that a search may propose are tried at the ends of its ranges.

    Raises UserError for a cell that cannot be made, and for two that are alike, by their numbers.
    """
    if plan.search is not None:
        for at in _corners(plan.search.ranges):
            for cell in plan.expanded():
                made_of({**cell, **at}, "search")
        return []
    cells, alike, memory = [], dict[str, int](), dict[str, Any]()
    for number, cell in enumerate(plan.expanded(), 1):
        made, what = made_of(cell, f"cell {number}", memory)
        if (first := alike.setdefault(what, number)) != number:
            raise UserError(f"cells {first} and {number} are alike; leave one of them out.")
        cells.append(made)
    return cells


def made_of(cell: Cell, where: str, memory: dict[str, Any] | None = None) -> tuple[Made, str]:
    """The cell, and a text of all that it trains with. Raises UserError, beginning with where.

    In `memory` is kept what many cells have in common.
    """
    memory = {} if memory is None else memory
    parts = _parts(cell, where)
    program = _program(cell, parts)
    kept = lambda key, make: memory[key] if key in memory else memory.setdefault(key, make())
    common = {k: v for k, v in cell.items() if not k.startswith("algorithm.")}
    trained = lambda: _trainer(parts, where).iterations
    told = lambda: [config.record(parts[part]) for part in ("game", "schedule")]
    iterations = kept(f"iterations {common}", trained)
    text = f"{kept(f'record {common}', told)} {config.record(parts['algorithm'])}"
    kept(f"fits {program}", lambda: _trainer(parts, where))
    return Made(name_of(cell), cell, iterations, program), text


def _parts(cell: Mapping[str, str], where: str) -> dict[str, Any]:
    """What trains a cell: game, algorithm and schedule."""
    fields = {k: v for k, v in cell.items() if k not in WORDS}
    asked = Asked(cell["task"], cell["algorithm"], cell.get("preset"))
    try:
        return asking.parts(asked, fields)
    except UserError as error:
        raise UserError(f"{where}: {str(error).removeprefix('--')}") from None


def _trainer(parts: Mapping[str, Any], where: str) -> AbstractTrainer:
    """The trainer. Raises UserError, beginning with `where`, if the algorithm does not fit."""
    try:
        return trainer_for(parts["game"], parts["algorithm"], parts["schedule"])
    except UserError as error:
        raise UserError(f"{where}: {str(error).removeprefix('--')}") from None


def _program(cell: Cell, parts: Mapping[str, Any]) -> str:
    """A name for the compiled program: all that is set but numbers that a program is given."""
    algorithm, part = parts["algorithm"], "algorithm."
    given = {
        name
        for name in cell
        if name.startswith(part) and is_traced(algorithm, name.removeprefix(part))
    }
    return name_of({k: "given" if k in given else v for k, v in cell.items()})


def _corners(ranges: Mapping[str, Range]) -> Iterator[Cell]:
    """The ends of every range, and each of its choices, the others at their first value."""
    ends = {
        name: [*r.choices] or [repr(v) if not r.whole else str(v) for v in (r.low, r.high)]
        for name, r in ranges.items()
    }
    first = {name: values[0] for name, values in ends.items()}
    for name, values in ends.items():
        for value in values:
            yield first | {name: value}
