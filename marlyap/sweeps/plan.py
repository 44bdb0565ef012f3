"""What a sweep is to train, as data: read from a TOML file or from words. Nothing here imports JAX.

A *cell* is one setting of the fields that the plan varies; a *job* is a cell with a training seed.
A cell is named by the hash of all that is set in it, so that the same settings are the same folder
in whatever plan they stand.
"""

import dataclasses
import hashlib
import itertools
import json
import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marlyap.errors import UserError, check_range, whole
from marlyap.runs.job import seeds


SCHEMA = 1
WORDS = ("task", "algorithm", "preset")  # what a cell may set besides fields
PARTS = ("task", "algorithm", "schedule")
KEYS = (*WORDS, "seeds", "evaluate", "fixed", "grid", "cells", "search")
SEARCH = ("trials", "prune", "seed", "metric")
RANGE = ("low", "high", "log", "step", "choices")
METRICS = ("success", "return")
MOST = 1_000_000  # cells

Cell = dict[str, str]  # what is set, by dotted name


@dataclass(frozen=True)
class Range:
    """The values that a search may take for one field."""

    low: float | int = 0.0
    high: float | int = 1.0
    log: bool = False
    step: float | int | None = None
    choices: tuple[str, ...] = ()  # instead of numbers
    whole: bool = False  # whole numbers only


@dataclass(frozen=True)
class Search:
    """How a search goes: an optimiser proposes so many cells, one after the other."""

    ranges: dict[str, Range]
    trials: int = 20
    prune: bool = True  # stop what does worse than most did at the same step
    seed: int = 0  # of the proposals
    metric: str = "success"  # success or return, the largest that the seeds reach on average


@dataclass(frozen=True)
class Plan:
    """What is trained; `of_toml` reads one.

    Values are numbers, words, or lists of those, and are kept as one would type them. Raises
    UserError, naming the entry, for a plan that leaves something out or says something twice.
    """

    seeds: Sequence[Any] = (0,)
    fixed: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # set in every cell
    grid: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # a list for each name
    cells: Sequence[Mapping[str, Any]] = ()  # a list, each crossed with the grid
    search: Search | None = None
    evaluate: int = 0  # held-out starts of every finished job; 0: none

    def __post_init__(self):
        put = lambda name, value: object.__setattr__(self, name, value)
        put("seeds", tuple(seeds(map(str, self.seeds))))
        put("fixed", _texts(self.fixed, "fixed."))
        for name, values in self.grid.items():
            if isinstance(values, str) or not isinstance(values, Sequence):
                raise UserError(f"grid.{name}: {values!r} is no list; write [{values!r}].")
        grid = {k: [text_of(v, f"grid.{k}") for v in values] for k, values in self.grid.items()}
        put("grid", {k: tuple(values) for k, values in _known(grid).items()})
        cells = enumerate(self.cells, 1)
        put("cells", tuple(_texts(cell, f"cell {i}: ") for i, cell in cells))
        if self.search is not None:
            _known(dict(self.search.ranges))
        self._complete()

    def _complete(self) -> None:
        """Raise UserError for what is missing, empty, or there twice."""
        check_range("evaluate", self.evaluate, 0, 10_000_000)
        if "task" not in self.varied and "task" not in self.fixed:
            raise UserError('task: the sweep names none; write task = "rendezvous".')
        if "algorithm" not in self.varied and "algorithm" not in self.fixed:
            raise UserError('algorithm: the sweep names none; write algorithm = "masac".')
        for name, values in self.grid.items():
            if not values:
                raise UserError(f"grid.{name}: the list is empty; give it a value at least.")
        places = (self.fixed, self.grid, {k: 0 for cell in self.cells for k in cell})
        places += (self.search.ranges if self.search else {},)
        names = ("fixed", "grid", "cells", "search")
        for (a, one), (b, other) in itertools.combinations(zip(names, places, strict=True), 2):
            for name in one.keys() & other.keys():
                raise UserError(f"{name}: it is set in {a} and in {b}; leave one out.")
        if self.search is not None and self.count > 1:
            raise UserError("search: it stands without a grid or a list of cells; fix what is one.")
        if (count := self.count) > MOST:
            raise UserError(f"grid: it has {count} cells; take {MOST} at most.")

    @property
    def varied(self) -> list[str]:
        """What differs between cells, in the order of the plan."""
        listed = (name for cell in self.cells for name in cell)
        sought = self.search.ranges if self.search else ()
        return list(dict.fromkeys((*listed, *self.grid, *sought)))

    @property
    def count(self) -> int:
        """How many cells there are; of a search, for each of its trials."""
        return max(1, len(self.cells)) * math.prod(map(len, self.grid.values()))

    def expanded(self) -> list[Cell]:
        """Every cell, with what is fixed: the list times the grid, the last field fastest."""
        keys, found = list(self.grid), []
        for cell in self.cells or ({},):
            for values in itertools.product(*self.grid.values()):
                found.append({**self.fixed, **cell, **dict(zip(keys, values, strict=True))})
        return found

    def to_json(self) -> dict[str, Any]:
        """Plain values, which `of_json` reads."""
        return {"schema": SCHEMA} | dataclasses.asdict(self)

    @classmethod
    def of_json(cls, data: Any, where: str) -> "Plan":
        """What `to_json` wrote. Raises UserError for anything else."""
        if not isinstance(data, dict) or data.pop("schema", None) != SCHEMA:
            raise UserError(f"sweep: {where} is of another version of marlyap, or damaged.")
        try:
            if found := data.pop("search"):
                ranges = {
                    k: Range(**{**r, "choices": tuple(r["choices"])})
                    for k, r in found.pop("ranges").items()
                }
                data["search"] = Search(ranges=ranges, **found)
            return cls(**data)
        except (TypeError, KeyError, AttributeError) as error:
            raise UserError(f"sweep: {where} is damaged ({error}); use another copy.") from None


def name_of(cell: Mapping[str, str]) -> str:
    """Ten letters for all that is set in a cell, whatever its order."""
    return hashlib.sha256(json.dumps(sorted(cell.items())).encode()).hexdigest()[:10]


# --- From a file ---------------------------------------------------------------------------------


def of_toml(path: Path) -> Plan:
    """The plan in a TOML file. Raises UserError for what is none, naming the entry."""
    try:
        data = tomllib.loads(path.read_text())
    except OSError as error:
        raise UserError(f"sweep: {path} cannot be read ({error.strerror}).") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"sweep: {path} is not sound TOML: {error}.") from None
    try:
        return of_data(data)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def of_data(data: Mapping[str, Any]) -> Plan:
    """The plan in the values of a TOML file."""
    for key in data:
        if key not in KEYS:
            raise UserError(f"{key}: there is no such entry; there is {', '.join(KEYS)}.")
    for key in ("fixed", "grid", "search"):
        if not isinstance(data.get(key, {}), dict):
            raise UserError(f"{key}: it has to be a table, as in [{key}].")
    fixed = _flat(data.get("fixed", {})) | {k: data[k] for k in WORDS if k in data}
    cells = data.get("cells", [])
    if not isinstance(cells, list) or not all(isinstance(c, dict) for c in cells):
        raise UserError("cells: it has to be a list of tables, as in [[cells]].")
    if "cells" in data and not cells:
        raise UserError("cells: the list is empty; give it a cell at least.")
    listed = data.get("seeds", [0])
    if not isinstance(listed, list) or not listed:
        raise UserError("seeds: they have to be a list of whole numbers, as in seeds = [0, 1].")
    evaluate = data.get("evaluate", 0)
    if not isinstance(evaluate, int) or isinstance(evaluate, bool):
        raise UserError(f"evaluate: {evaluate!r} is not a whole number.")
    return Plan(
        seeds=listed,
        fixed=fixed,
        grid=_flat(data.get("grid", {})),
        cells=[_flat(cell) for cell in cells],
        search=_search(data["search"]) if "search" in data else None,
        evaluate=evaluate,
    )


def _search(data: Mapping[str, Any]) -> Search:
    """The table [search]: its settings, and a range for each field."""
    settings = {k: v for k, v in data.items() if k in SEARCH}
    ranges = {k: _range(v, k) for k, v in _flat_ranges(data).items() if k not in SEARCH}
    if not ranges:
        raise UserError('search: no field is searched; write "algorithm.rate_Q" = {low = ...}.')
    for name in ("trials", "seed"):
        if not isinstance(value := settings.get(name, 1), int) or isinstance(value, bool):
            raise UserError(f"search.{name}: {value!r} is not a whole number.")
    check_range("search.trials", settings.get("trials", 1), 1, 1_000_000)
    if not isinstance(settings.get("prune", True), bool):
        raise UserError("search.prune: it has to be true or false.")
    if settings.get("metric", "success") not in METRICS:
        raise UserError(f"search.metric: it has to be {' or '.join(METRICS)}.")
    return Search(ranges=ranges, **settings)


def _flat_ranges(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as dotted names, down to those that say a range."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        deeper = isinstance(value, dict) and not value.keys() & {*RANGE}
        found |= _flat_ranges(value, f"{prefix}{key}.") if deeper else {f"{prefix}{key}": value}
    return found


def _range(given: Any, name: str) -> Range:
    """The range of one field. Raises UserError where it is none."""
    where = f"search.{name}"
    if not isinstance(given, dict) or not given.keys() <= {*RANGE}:
        raise UserError(f"{where}: write {{low = 1e-4, high = 1e-2}} or {{choices = [...]}}.")
    if "choices" in given:
        choices = given["choices"]
        if len(given) > 1 or not isinstance(choices, list) or not choices:
            raise UserError(f"{where}: choices are a list, and nothing stands beside it.")
        return Range(choices=tuple(text_of(v, where) for v in choices))
    number = lambda v: isinstance(v, int | float) and not isinstance(v, bool)
    bounds = [given.get("low"), given.get("high"), given.get("step", 1)]
    if not all(map(number, bounds)) or not bounds[0] < bounds[1]:
        raise UserError(f"{where}: it needs numbers low < high.")
    log = given.get("log", False)
    if not isinstance(log, bool) or (log and (bounds[0] <= 0 or "step" in given)):
        raise UserError(f"{where}: log is true or false, and needs low > 0 and no step.")
    all_whole = all(isinstance(v, int) for v in bounds)
    return Range(bounds[0], bounds[1], log, given.get("step"), whole=all_whole)


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as dotted names: TOML reads algorithm.rate_Q = 1 as a table in a table."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        deeper = isinstance(value, dict)
        found |= _flat(value, f"{prefix}{key}.") if deeper else {f"{prefix}{key}": value}
    return found


def _texts(fields: Mapping[str, Any], where: str) -> Cell:
    """Values as one would type them. Raises UserError for a name that cannot be set."""
    return _known({k: text_of(v, f"{where}{k}") for k, v in fields.items()})


def text_of(value: Any, where: str) -> str:
    """A value of TOML as one would type it. Raises UserError for a date or a table."""
    match value:
        case bool():
            return str(value).lower()
        case int() | float() | str():
            return canonical(str(value))
        case list() | tuple():
            return ",".join(text_of(v, where) for v in value)
    raise UserError(f"{where}: {value!r} is not a number, a word, true, false or a list.")


NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")


def canonical(text: str) -> str:
    """The same number in the same letters: 1e-3, 0.001 and .001 are one."""
    words = [word.strip() for word in text.split(",")]
    return ",".join(_canonical(word) for word in words)


def _canonical(word: str) -> str:
    try:
        return str(whole(word))
    except ValueError:
        pass
    if not NUMBER.fullmatch(word) or not math.isfinite(number := float(word)):
        return {"True": "true", "False": "false", "None": "none"}.get(word, word)
    return str(int(number)) if number.is_integer() and abs(number) < 1e15 else repr(number)


def _known(fields: dict[str, Any]) -> dict[str, Any]:
    """The same, where every name is one that a cell may set. Raises UserError otherwise."""
    for name in fields:
        if name not in WORDS and ("." not in name or name.partition(".")[0] not in PARTS):
            parts = ", ".join(f"{part}.FIELD" for part in PARTS)
            raise UserError(f"{name}: it cannot be set; set {parts}, or {', '.join(WORDS)}.")
    return fields


# --- From words ----------------------------------------------------------------------------------


def of_words(
    task: str,
    algorithm: str,
    grid: Iterable[str],
    fixed: Mapping[str, str],
    listed: Iterable[str],
    evaluate: int = 0,
    preset: str | None = None,
) -> Plan:
    """The plan of a command line: `grid` holds words such as algorithm.rate_Q=1e-3,3e-3."""
    found: dict[str, tuple[str, ...]] = {}
    for word in grid:
        name, equals, values = word.partition("=")
        if not equals or not name:
            raise UserError(f"grid: '{word}' is not FIELD=VALUE,VALUE.")
        if name in found:
            raise UserError(f"grid.{name}: it is given twice.")
        between = ";" if ";" in values else ","  # ; where the values have commas themselves
        found[name] = tuple(v for v in values.split(between) if v.strip())
    words = {"task": task, "algorithm": algorithm} | ({"preset": preset} if preset else {})
    return Plan(seeds(listed), {**fixed, **words}, found, evaluate=evaluate)
