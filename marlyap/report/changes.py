"""The fields of a run that are not the default, and the command that makes it."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx

from marlyap.errors import UserError
from marlyap.learning.algorithms import ALGORITHMS, PRESETS
from marlyap.learning.trainer import schedule_for
from marlyap.runs import config
from marlyap.runs.run import Run
from marlyap.tasks import TASKS


def common(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The fields that are equal in all records, nested as they are."""
    first, rest = records[0], records[1:]
    kept = {}
    for name, value in first.items():
        others = [r[name] for r in rest if name in r]
        if len(others) < len(rest):
            continue
        if isinstance(value, Mapping) and all(isinstance(o, Mapping) for o in others):
            if inner := common([value, *others]):
                kept[name] = inner
        elif all(o == value for o in others):
            kept[name] = value
    return kept


def changed_fields(run: Run) -> dict[str, str]:
    """Fields of a run, by dotted name, that are not what their class has by default."""
    t, found = run.trainer, {}
    for part, value in {"task": t.game, "algorithm": t.algorithm, "schedule": t.schedule}.items():
        found |= changed_from(value, _usual(value), part)
    return found


def changed_from(thing: Any, usual: Any, path: str) -> dict[str, str]:
    """Fields of an object, by dotted name, that are not what they usually are."""
    found: dict[str, str] = {}
    for name, value in config.fields(thing).items():
        normal = config.fields(usual).get(name) if usual is not None else None
        if isinstance(value, eqx.Module):
            if type(value) is not type(normal):
                found[f"{path}.{name}"] = config.show(value)
                normal = _usual(value)
            found |= changed_from(value, normal, f"{path}.{name}")
        elif usual is None or value != normal:
            found[f"{path}.{name}"] = config.show(value)
    return found


def command_of(run: Run) -> str:
    """The command that trains this run; empty where its parts cannot be named."""
    name = run.names
    if name["task"] not in TASKS or name["algorithm"] not in ALGORITHMS:
        return ""  # code of the user's own, or an object made in Python
    rule = PRESETS.get(name["preset"] or "tuned", PRESETS["tuned"])(ALGORITHMS[name["algorithm"]])
    plan = schedule_for(rule, name["preset"] or "tuned")
    words = ["marlyap", "train", name["task"], name["algorithm"], "--seeds", str(run.seed)]
    words += ["--preset", name["preset"]] * (name["preset"] not in ("", "tuned"))
    t = run.trainer
    usual = {"task": TASKS[name["task"]], "algorithm": rule, "schedule": plan}
    for part, value in {"task": t.game, "algorithm": t.algorithm, "schedule": t.schedule}.items():
        for field, shown in changed_from(value, usual[part], part).items():
            words += [f"--{field}", shown]
    return shlex.join(words)


def _usual(thing: Any) -> Any:
    """The object that its class makes of nothing; None where that cannot be."""
    try:
        return type(thing)()
    except (TypeError, UserError):
        return None
