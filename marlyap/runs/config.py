"""Objects as text and back: an object's fields are its configuration, and nothing else is.

`override` sets one field from the command line, `record` and `build` write and read `run.json`.
Nothing here executes what it reads; code is loaded by `load` alone, from a path the user typed.
"""

import dataclasses
import difflib
import hashlib
import importlib.util
import inspect
import re
import sys
import types
import typing
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cache, singledispatch
from pathlib import Path
from typing import Any, Literal, TypeVar

import equinox as eqx

from marlyap.controllers import CONTROLLERS, AbstractController
from marlyap.errors import UserError, first_line, raised_at, whole
from marlyap.games.dynamics import DYNAMICS, AbstractDynamics
from marlyap.games.game import AbstractGame
from marlyap.hosts.sources import is_file, names_a_host
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.algorithms import ALGORITHMS
from marlyap.learning.constraint import AbstractConstraint
from marlyap.learning.constraints import CONSTRAINTS
from marlyap.learning.hosted import Hosted
from marlyap.learning.schedule import Schedule
from marlyap.shields import Shield, Shielded
from marlyap.tasks import TASKS


T = TypeVar("T")
FAMILIES: dict[type, dict[str, Any]] = {
    AbstractGame: TASKS,
    AbstractAlgorithm: ALGORITHMS,
    AbstractConstraint: CONSTRAINTS,
    AbstractDynamics: DYNAMICS,
}
WORDS = {AbstractGame: "task", AbstractAlgorithm: "algorithm"}


MOST_NAMES = 40  # in one sentence


class UnknownCode(UserError):
    """A record names a class that is neither marlyap's nor named by the user."""


class NotOfThatKind(UserError):
    """The file that was named defines no such task, algorithm or controller."""


def known() -> dict[str, type]:
    """The classes that a record may name without anyone's leave."""
    members = [o for family in FAMILIES.values() for o in family.values()]
    found = {cls.__name__: cls for o in members for cls in classes_in(o)}
    more = (Schedule, Hosted, Shield, Shielded)
    return found | {cls.__name__: cls for cls in more}


def suggest(word: str, among: Iterable[str]) -> str:
    """What may have been meant, or what there is."""
    names = sorted(among)
    near = difflib.get_close_matches(word, names, n=1, cutoff=0.5)
    if near:
        return f"did you mean '{near[0]}'?"
    if len(names) > MOST_NAMES:
        return f"there are {len(names)}, which `marlyap list` shows."
    return f"there is {', '.join(names) or 'none'}."


def load_task(name: str) -> AbstractGame | Hosted:
    """The task called `name`: a game of JAX as `load` has it, or one that is played outside.

    path/to/file.py:make is outside where it names a function. A file is executed: name your own.
    """
    if names_a_host(name):
        return Hosted(name)
    path, _, attribute = name.rpartition(":")
    if path and Path(path).is_file():
        made = getattr(_module(Path(path), "task"), attribute, None)
        if callable(made) and not inspect.isclass(made) and not isinstance(made, AbstractGame):
            return Hosted(name)
    return load(name, AbstractGame)


def load(name: str, family: type[T]) -> T:
    """The configured object called `name`, or the one at `path/to/file.py:Name`.

    Raises UserError with a suggestion for an unknown name. A file is executed: name your own.
    """
    table, word = FAMILIES[family], WORDS[family]
    if name in table:
        return table[name]
    if ":" not in name:
        if name.endswith(".py") and Path(name).is_file():
            classes = re.findall(r"^class (\w+)", Path(name).read_text(errors="replace"), re.M)
            hint = " or ".join(f"{name}:{c}" for c in classes) or f"{name}:Name"
            raise UserError(f"{word}: {name} needs the name of the class, as in {hint}.")
        raise UserError(f"{word}: no {word} is called '{name}'; {suggest(name, table)}")
    path, _, attribute = name.rpartition(":")
    module = _module(Path(path), word)
    thing = getattr(module, attribute, None)
    if inspect.isclass(thing) and issubclass(thing, family):
        thing = _construct(thing, {}, name)
    if not isinstance(thing, family):
        there = [k for k, v in vars(module).items() if _is_of(v, family) and not _ours(_class(v))]
        hint = f"; {suggest(attribute, there)}" if there else "."
        raise NotOfThatKind(f"{word}: {path} defines no {word} called '{attribute}'{hint}")
    for cls in own_classes(thing).values():
        _annotated(cls)
    return thing


def _class(value: Any) -> type:
    return value if inspect.isclass(value) else type(value)


def _is_of(value: Any, family: type) -> bool:
    """Whether it is an object of the family, or a class that makes one."""
    return issubclass(_class(value), family)


def _annotated(cls: type) -> None:
    """Raise UserError for what looks like a field of a user's class and is none."""
    for base in cls.__mro__:
        declared = vars(base).get("__annotations__", {})
        for name, value in vars(base).items() if not _ours(base) and base is not object else ():
            plain = isinstance(value, bool | int | float | str | tuple | eqx.Module)
            if plain and name not in declared and not name.startswith("_"):
                kind = type(value).__name__
                shown = repr(value) if not isinstance(value, eqx.Module) else f"{kind}()"
                raise UserError(
                    f"{cls.__name__}: {name} = {shown} needs a type: {name}: {kind} = {shown}."
                )


def load_controller(word: str, game: AbstractGame) -> AbstractController:
    """The controller called `word`, or the one at `path/to/file.py:Name`, for this game.

    A file is executed: name your own. Raises UserError for an unknown name (with a suggestion), a
    file that cannot be loaded, a class that is no controller, and a game that it cannot drive.
    """
    if word in CONTROLLERS:
        return CONTROLLERS[word](game)
    cls = controller_class(word)
    try:
        return cls(game)
    except UserError:
        raise
    except Exception as error:  # whatever the constructor of a user's class may raise
        raise UserError(
            f"controller: {cls.__name__} cannot be made from a game alone: {error}."
        ) from error


def controller_class(word: str) -> type[AbstractController]:
    """The class at `path/to/file.py:Name`. Raises UserError as `load_controller` does."""
    path, _, name = word.rpartition(":")
    if word.endswith(".py"):
        raise UserError(f"controller: '{word}' names no class; write {word}:Name.")
    if not path:
        hint = suggest(word, CONTROLLERS)
        raise UserError(f"controller: no controller is called '{word}'; {hint}")
    cls = getattr(_module(Path(path), "controller"), name, None)
    if not (inspect.isclass(cls) and issubclass(cls, AbstractController)):
        raise NotOfThatKind(
            f"controller: {path} defines no controller called '{name}'; write a class "
            f"{name}(AbstractController)."
        )
    return cls


def override(obj: T, path: str, text: str) -> T:
    """`obj` with the field at the dotted `path` set to what `text` says, checked again.

    Raises UserError for an unknown field (with a suggestion) or a value of the wrong kind.
    """
    return _set(obj, {tuple(path.split(".")): text}, ())


def override_all(parts: Mapping[str, Any], texts: Mapping[str, str]) -> dict[str, Any]:
    """The parts with every `part.field` set, whatever the order.

    Raises UserError as `override` does, the option's full name before it.
    """
    changed = dict(parts)
    for part in dict.fromkeys(path.partition(".")[0] for path in texts):
        split = {tuple(path.split(".")): text for path, text in texts.items()}
        own = {path[1:]: text for path, text in split.items() if path[0] == part}
        try:
            changed[part] = _set(changed[part], own, ())
        except UserError as error:
            raise UserError(f"--{part}.{error}") from None
    return changed


def fields(obj: Any) -> dict[str, Any]:
    """The configuration of an object: its fields by name."""
    have = vars(obj)  # at once: a module of equinox takes long to find an attribute
    return {f.name: have[f.name] for f in dataclasses.fields(obj) if f.init}


def record(obj: Any) -> Any:
    """Plain JSON values: an object becomes its fields and its `kind`."""
    if isinstance(obj, eqx.Module):
        return {"kind": type(obj).__name__} | {k: record(v) for k, v in fields(obj).items()}
    return [record(v) for v in obj] if isinstance(obj, tuple) else obj


def own_classes(obj: Any) -> dict[str, type]:
    """The classes in an object and its fields that are not marlyap's, outermost first."""
    return {cls.__name__: cls for cls in classes_in(obj) if not _ours(cls)}


def classes_in(obj: Any) -> list[type]:
    """The class of a configured object and those of its fields, outermost first."""
    inside = tuple(fields(obj).values()) if isinstance(obj, eqx.Module) else obj
    found = [type(obj)] if isinstance(obj, eqx.Module) else []
    return found + [c for v in inside for c in classes_in(v)] if isinstance(inside, tuple) else []


def named_by(obj: Any) -> dict[str, type]:
    """The user's classes that may be built once he has named this object.

    Those in its fields, and every module class that the files defining them define or import.
    """
    used = own_classes(obj)
    modules = [sys.modules.get(cls.__module__) for cls in used.values()]
    beside = {
        value.__name__: value
        for module in modules
        for value in (vars(module).values() if module else ())  # none for code that was executed
        if inspect.isclass(value) and issubclass(value, eqx.Module) and not _ours(value)
    }
    return beside | used


def code_of(obj: Any, typed: str) -> dict[str, Any] | None:
    """The user's code in this object: its file, what was in it, its classes; None for ours.

    `typed` is what the object was called: `file` is the file as it was typed there, `source` where
    it lies.
    """
    used, path = own_classes(obj), _maker_of(obj)
    if not used and path is None:
        return None
    path = path or _file(next(iter(used.values())))
    file = typed.rpartition(":")[0] or (path.name if path else None)
    digest = hashlib.sha256(path.read_bytes()).hexdigest() if path else None
    return {"file": file, "sha256": digest, "classes": list(used), "source": path}


@singledispatch
def _maker_of(obj: Any) -> Path | None:
    """The user's file with the function that makes this object's environments, if there is one."""
    return None


@_maker_of.register
def _(obj: Hosted) -> Path | None:
    path = Path(obj.source.rpartition(":")[0])
    return path if is_file(obj.source) and path.is_file() else None


def _ours(cls: type) -> bool:
    return cls.__module__.partition(".")[0] in ("marlyap", "equinox")


def _file(cls: type) -> Path | None:
    """The source file of a class; None where there is none, as in a notebook."""
    name = getattr(sys.modules.get(cls.__module__), "__file__", None)
    return Path(name) if name and Path(name).is_file() else None


def build(data: Any, allowed: Mapping[str, type], where: str) -> Any:
    """The object that `record` wrote. Raises UserError for anything it would not have written."""
    if not isinstance(data, dict) or not isinstance(data.get("kind"), str):
        raise UserError(f"{where}: expected an object with a 'kind'; the file may be damaged.")
    cls = allowed.get(data["kind"])
    if cls is None:
        raise UnknownCode(
            f"{where}: '{data['kind']}' is not part of marlyap; if it is your own code, name it "
            f"with --{where.split('.')[0]} path/to/file.py:{data['kind']}."
        )
    hints, values = _hints(cls), {}
    for name, value in data.items():
        if name == "kind":
            continue
        if name not in hints:
            raise UserError(f"{where}.{name}: unknown field; {suggest(name, hints)}")
        field = f"{where}.{name}"
        if isinstance(value, dict):
            values[name] = build(value, allowed, field)
            kinds = tuple(k for k in _alternatives(hints[name]) if isinstance(k, type))
            if not isinstance(values[name], kinds):
                raise UserError(f"{field}: {value['kind']} is not {_expected(hints[name])}.")
        else:
            values[name] = _convert(
                tuple(value) if isinstance(value, list) else value, hints[name], field
            )
    return _construct(cls, values, where)


def describe(obj: Any, prefix: str) -> list[tuple[str, str, str]]:
    """(option, value, comment) for every field, nested ones too; comments come from the source."""
    rows, notes, hints = [], _comments(type(obj)), _hints(type(obj))
    for name, value in fields(obj).items():
        note, choices = notes.get(name, ""), _choices(hints[name])
        if choices:
            note = f"{note}{'; ' * bool(note)}one of {', '.join(choices)}"
        if not isinstance(value, eqx.Module) or _members(type(value)):  # else no choice has a name
            rows.append((f"{prefix}.{name}", show(value), note))
        if isinstance(value, eqx.Module):
            rows += describe(value, f"{prefix}.{name}")
    return rows


def describe_class(cls: type) -> list[tuple[str, str, str]]:
    """(field, value, comment) for every field of a class that has a default."""
    notes, missing = _comments(cls), dataclasses.MISSING
    given = [f for f in dataclasses.fields(cls) if f.init and f.default is not missing]
    return [(f.name, show(f.default), notes.get(f.name, "")) for f in given]


def show(value: Any) -> str:
    """A value as one would type it."""
    if isinstance(value, eqx.Module):
        same = [n for t in FAMILIES.values() for n, o in t.items() if type(o) is type(value)]
        return same[0] if same else type(value).__name__
    return ",".join(map(show, value)) if isinstance(value, tuple) else str(value)


def _set(obj: T, texts: dict[tuple[str, ...], str], where: tuple[str, ...]) -> T:
    """`obj` with all of these fields set at once, so that their order cannot matter."""
    have = fields(obj) if dataclasses.is_dataclass(obj) else {}
    values = dict(have)
    for path in sorted(texts, key=len):  # an object is chosen before its fields are set
        name, full = path[0], (*where, path[0])
        if name not in have:
            hint = suggest(name, have)
            if where and not have:
                hint = f"{'.'.join(where)} is {show(obj)}, which has none; set that too."
            raise UserError(f"{'.'.join((*where, *path))}: there is no field '{name}'; {hint}")
        if len(path) == 1:
            values[name] = _parse(texts[path], _hints(type(obj))[name], ".".join(full))
    for name in dict.fromkeys(path[0] for path in texts if len(path) > 1):
        deeper = {path[1:]: text for path, text in texts.items() if path[0] == name and path[1:]}
        values[name] = _set(values[name], deeper, (*where, name))
    return _construct(type(obj), values, ".".join(where))


def _construct(cls: type[T], values: dict[str, Any], where: str) -> T:
    try:
        return cls(**values)
    except UserError as error:
        raise UserError(f"{where}.{error}" if where and ":" not in where else str(error)) from None
    except Exception as error:  # whatever the constructor of a user's class may raise
        if missing := _missing(cls, values):
            raise UserError(f"{where or cls.__name__}: {missing}.") from None
        place = raised_at(error)
        said = f"{place}: {first_line(error)}" if place else f"{error}"
        raise UserError(f"{where or cls.__name__}: {said}.") from error


def _missing(cls: type, values: Mapping[str, Any]) -> str | None:
    """What a class must define and does not, or which field has no value."""
    abstract = ("__abstractmethods__", "__abstractvars__", "__abstractclassvars__")
    lacks = sorted({str(n) for kind in abstract for n in getattr(cls, kind, ())})
    if lacks:
        return f"it lacks {' and '.join(lacks)}; define {'them' if len(lacks) > 1 else 'it'}"
    given = dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ()
    unset = dataclasses.MISSING
    bare = [f.name for f in given if f.init and f.default is unset and f.default_factory is unset]
    if bare := [name for name in bare if name not in values]:
        return f"the field {bare[0]} has no default; give it one"
    return None


def _parse(text: str, hint: Any, where: str) -> Any:
    """Text from the command line as a value of the hinted type."""
    for kind in _alternatives(hint):
        try:
            return _parse_as(text, kind)
        except ValueError:
            continue
    raise UserError(f"{where}: '{text}' is not {_expected(hint)}.")


def _parse_as(text: str, kind: Any) -> Any:
    if kind is type(None) and text.lower() in ("none", "null"):
        return None
    if kind is bool and text.lower() in ("true", "false", "yes", "no", "1", "0"):
        return text.lower() in ("true", "yes", "1")
    if kind is int:
        return whole(text)
    if kind is float:
        return _finite(float(text))
    if kind is str:
        return text
    if typing.get_origin(kind) is Literal and text in typing.get_args(kind):
        return text
    if typing.get_origin(kind) is tuple:
        item = typing.get_args(kind)[0]
        return tuple(
            _parse_as(part.strip(), item) for part in text.strip("()[]").split(",") if part
        )
    if text in (members := _members(kind)):
        return members[text]
    raise ValueError(text)


def _members(kind: Any) -> dict[str, Any]:
    """The objects of this class that have a name."""
    tables = [
        t for family, t in FAMILIES.items() if isinstance(kind, type) and issubclass(kind, family)
    ]
    return {name: o for table in tables for name, o in table.items() if isinstance(o, kind)}


def _finite(value: float) -> float:
    if value != value or abs(value) == float("inf"):
        raise ValueError(value)
    return value


def _convert(value: Any, hint: Any, where: str) -> Any:
    """A value read from JSON, if it is of the hinted type."""
    for kind in _alternatives(hint):
        origin = typing.get_origin(kind)
        if origin is Literal and value in typing.get_args(kind):
            return value
        if origin is tuple and isinstance(value, tuple):
            return tuple(_convert(v, typing.get_args(kind)[0], where) for v in value)
        if kind is float and (type(value) is float or _is_int64(value)):
            return float(value)
        if isinstance(kind, type) and type(value) is kind:
            return value
    raise UserError(f"{where}: {value!r} is not {_expected(hint)}.")


def _is_int64(value: Any) -> bool:
    return type(value) is int and abs(value) < 2**63


def _alternatives(hint: Any) -> list[Any]:
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    kinds = list(typing.get_args(hint)) if union else [hint]
    return sorted(kinds, key=lambda k: (k is str, k is float))  # the narrowest first


def _expected(hint: Any) -> str:
    names = []
    for kind in _alternatives(hint):
        if typing.get_origin(kind) is Literal:
            names += map(str, typing.get_args(kind))
        elif typing.get_origin(kind) is tuple:
            names.append(f"{typing.get_args(kind)[0].__name__}s with commas between")
        elif members := _members(kind):
            names += members
        else:
            plain = {int: "a whole number", float: "a number", bool: "true or false"}
            names.append("none" if kind is type(None) else plain.get(kind, kind.__name__))
    return " or ".join(names)


@cache
def _hints(cls: type) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {f.name: hints[f.name] for f in dataclasses.fields(cls) if f.init}


def _choices(hint: Any) -> list[str]:
    """The words a field may be set to, where only some are known."""
    found: list[str] = []
    for kind in _alternatives(hint):
        found += map(str, typing.get_args(kind)) if typing.get_origin(kind) is Literal else ()
        found += _members(kind)
    return found


def _comments(cls: type) -> dict[str, str]:
    """The comment behind each field, of base classes too, from the source where it can be read."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        lines: list[str] = []
        if base.__module__ != "builtins" and dataclasses.is_dataclass(base):
            with suppress(OSError, TypeError):
                lines = inspect.getsource(base).splitlines()
        for line in lines:
            code, mark, note = line.partition("#")
            if mark and (field := re.fullmatch(r"    (\w+):.*", code.rstrip())):
                found[field[1]] = note.strip()
    return found


def _module(path: Path, word: str) -> types.ModuleType:
    if not path.is_file():
        raise UserError(f"{word}: there is no file {path}.")
    made_of = str(path.resolve()).encode() + b"\0" + path.read_bytes()
    name = f"marlyap_user_{hashlib.sha256(made_of).hexdigest()[:12]}"
    if name in sys.modules:  # a class must stay the same class when it is named again
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UserError(f"{word}: {path} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where typing and inspect look for it
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        if isinstance(error, UserError) or not isinstance(error, (Exception, SystemExit)):
            raise
        place = raised_at(error) or path.name
        raise UserError(
            f"{word}: {path} could not be loaded: {place}: {first_line(error)}."
        ) from error
    return module
