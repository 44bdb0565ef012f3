"""Which measured runs belong together, what a group is called, and what may be said of it.

Runs belong together only if everything but their training seed is equal: the game that they were
measured on, and task, algorithm and schedule of their training. No figure here is ever taken over
different configurations.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np

from marlyap.games.game import AbstractGame
from marlyap.runs.config import record
from marlyap.runs.run import Run
from marlyap.simulation.evaluation import Evaluation, compare, pooled
from marlyap.statistics import mean_interval


SHARES = (
    "failed",
    "held",
    "at_rest",
    "stayed",
    "lost",
    "violations",
)  # of a summary, where it has them
MOST_PAIRS = 100


@dataclass(frozen=True)
class Measured:
    """One run or hand-written controller, measured on one game."""

    name: str  # the run's directory, or the controller's name
    base: str  # task and algorithm in words, before what tells configurations apart
    configuration: dict[str, Any]  # the record of all but the training seed
    game: AbstractGame  # that it was measured on
    starts: int  # seed of the starts
    evaluation: Evaluation
    seed: int | None = None  # of the training

    @property
    def key(self) -> str:
        """Equal for runs that belong together."""
        return json.dumps([self.base, self.configuration], sort_keys=True, default=str)


def of_run(
    run: Run,
    evaluation: Evaluation,
    starts: int,
    game: AbstractGame | None = None,
    called: str = "",
) -> Measured:
    """A run that was measured on its own game, or on another, which may be `called` something."""
    asked = run.game if game is None else game
    base, configuration = configured(run)
    if not same_game(asked, run.game):
        configuration["measured on"] = record(asked)
        base += f" measured on {told(run.game, asked, called)}"
    place = str(run.directory)
    return Measured(place, base, configuration, asked, starts, evaluation, run.seed)


def configured(run: Run) -> tuple[str, dict[str, Any]]:
    """What a run is called, and the record of all that it was trained with but its seed."""
    t = run.trainer
    parts = {"task": t.game, "algorithm": t.algorithm, "schedule": t.schedule}
    base = f"{run.labels['task']} {run.labels['algorithm']}"
    if run.names.get("preset", "") not in ("", "tuned"):
        base += f" ({run.names['preset']})"
    return base, {part: record(value) for part, value in parts.items()}


def told(trained: AbstractGame, asked: AbstractGame, called: str = "") -> str:
    """A game in words for whom knows the trained one: its name, if it has one, or what differs."""
    fields = differing([record(trained), record(asked)])[1]
    return called.rpartition(":")[2] or fields or type(asked).__name__


def of_controller(name: str, game: AbstractGame, evaluation: Evaluation, starts: int) -> Measured:
    """A hand-written controller, which no seed has made."""
    return Measured(name, name, {"measured on": record(game)}, game, starts, evaluation)


def same_game(a: AbstractGame, b: AbstractGame) -> bool:
    """Whether two games are one and the same in all their fields."""
    return bool(eqx.tree_equal(a, b))


def grouped(found: Sequence[Measured]) -> dict[str, list[Measured]]:
    """Those that belong together under their group's name, in order of appearance."""
    names = named([(one.base, one.configuration) for one in found])
    called: dict[str, str] = {}
    groups: dict[str, list[Measured]] = {}
    for name, one in zip(names, found, strict=True):
        if one.key not in called:  # a name never joins two configurations
            called[one.key] = f"{name}, another" if name in groups else name
        groups.setdefault(called[one.key], []).append(one)
    return groups


def named(configurations: Sequence[tuple[str, Mapping[str, Any]]]) -> list[str]:
    """A name for each configuration, given what it is called and its record; equal for equal ones.

    It says task and algorithm and, where several configurations share those, the fields that
    differ.
    """
    names = []
    for base, configuration in configurations:
        alike = [other for name, other in configurations if name == base]
        apart = differing(alike)[alike.index(configuration)]
        names.append(f"{base} ({apart})" if apart else base)
    return names


def differing(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """For each of several records, the fields in which they differ, as one would type them."""
    flats, telling = _telling(records)
    said = lambda flat: [f"{_field(n)}={_shown(flat[n])}" for n in telling if n in flat]
    return [", ".join(said(flat)) for flat in flats]


def side_by_side(records: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """The fields in which records differ by dotted name, with the value of each; "" without."""
    flats = [dict(_flat(r)) for r in records]
    names = dict.fromkeys(name for flat in flats for name in flat)
    shown = lambda name: [_shown(flat[name]) if name in flat else "" for flat in flats]
    rows = [(name, shown(name)) for name in names]
    return [(name, values) for name, values in rows if len(set(values)) > 1]


def _telling(records: Sequence[Mapping[str, Any]]) -> tuple[list[dict[str, Any]], list[str]]:
    """The records flat, and the fields that tell those apart that have them."""
    flats = [dict(_flat(r)) for r in records]
    names = dict.fromkeys(name for flat in flats for name in flat)
    values = lambda name: {json.dumps(f[name], default=str) for f in flats if name in f}
    return flats, [name for name in names if len(values(name)) > 1]


def _flat(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """The leaves of a record by dotted name; an object's kind stands under its own name."""
    rows: list[tuple[str, Any]] = []
    for name, value in tree.items():
        path = prefix.rstrip(".") if name == "kind" and prefix else f"{prefix}{name}"
        rows += _flat(value, f"{path}.") if isinstance(value, Mapping) else [(path, value)]
    return rows


def _field(path: str) -> str:
    """A field's name without the part of the trainer that it belongs to."""
    part, dot, rest = path.partition(".")
    return rest if dot and part in ("task", "algorithm", "schedule", "measured on") else path


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(_shown, value)) or "none"
    return "none" if value is None else f"{value:g}" if type(value) is float else str(value)


def labels(found: Sequence[Measured], brief: bool = False) -> tuple[list[str], list[str]]:
    """What to call the groups, and each of the runs so that no two are called the same.

    `brief` leaves out what all of them have in common.
    """
    teams = grouped(found)
    names, bases = dict(zip(teams, teams, strict=True)), {m.base for m in found}
    if brief and len(teams) > 1 and len(bases) == 1:
        base = bases.pop()
        names = {name: name.removeprefix(f"{base} (").removesuffix(")") for name in teams}
    team = {id(m): names[name] for name, members in teams.items() for m in members}
    said = lambda m: team[id(m)] + ("" if m.seed is None else f", seed {m.seed}")
    first = [said(m) for m in found]
    each = [
        f"{label} ({m.name})" if first.count(label) > 1 else label
        for m, label in zip(found, first, strict=True)
    ]
    return list(names.values()), each


def summary(members: Sequence[Measured], confidence: float = 0.95) -> dict[str, Any]:
    """The figures of one group, as `Evaluation.summary` has them.

    Of one policy the intervals are about that policy. Of several training seeds the rates are means
    of the seeds' rates, and the intervals are about their expectation over training seeds.
    """
    whole = pooled([m.evaluation for m in members]).summary(confidence)
    if len(members) == 1:
        return {"seeds": [members[0].seed], "about": "this policy"} | whole
    each = [m.evaluation.summary(confidence) for m in members]
    whole |= _over_seeds(members, [e["success_rate"] for e in each], confidence)
    for name in [name for name in SHARES if name in whole]:
        rates = [e[name]["success_rate"] for e in each]
        whole[name] |= _over_seeds(members, rates, confidence)
    for k, within in enumerate(whole["radii"]):
        rates = [e["radii"][k]["success_rate"] for e in each]
        within |= _over_seeds(members, rates, confidence)
    seeds = sorted({m.seed for m in members if m.seed is not None})
    rates = [e["success_rate"] for e in each]
    about = f"mean over {len(seeds)} training seed{'s' * (len(seeds) != 1)}"
    return {"seeds": seeds, "about": about, "rates": rates} | whole


def _over_seeds(
    members: Sequence[Measured], rates: Sequence[float], confidence: float
) -> dict[str, Any]:
    """Mean and interval over the seeds; runs of the same seed count as one."""
    seeds = np.array([-1 if m.seed is None else m.seed for m in members])
    values = [float(np.mean(np.asarray(rates)[seeds == s])) for s in np.unique(seeds)]
    low, high = mean_interval(values, confidence)
    return {"success_rate": float(np.mean(values)), "interval": [low, high]}


def words(group: Mapping[str, Any]) -> str:
    """A group's success in words, such as "mean over 10 training seeds 92.8 % [71.0, 99.6]"."""
    low, high = group["interval"]
    rate = f"{100 * group['success_rate']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
    of_one = group["about"] == "this policy"
    return f"{rate} of this policy" if of_one else f"{group['about']} {rate}"


def comparisons(found: Sequence[Measured]) -> list[dict[str, Any]]:
    """McNemar's test for every pair of different groups that share their game and their starts."""
    pairs = []
    for i, a in enumerate(found):
        for b in found[i + 1 :]:
            shared = a.starts == b.starts and len(a.evaluation.final) == len(b.evaluation.final)
            if a.key != b.key and shared and same_game(a.game, b.game):
                pairs.append({"a": a.name, "b": b.name} | compare(a.evaluation, b.evaluation))
    return pairs[:MOST_PAIRS]
