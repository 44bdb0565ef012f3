"""Who makes the games of other libraries, by the word that names them."""

import importlib
import importlib.util
import inspect
import json
import os
import sysconfig
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from marlyap.errors import UserError, first_line, raised_at
from marlyap.hosts.adapters import Parallel, Single, made
from marlyap.hosts.copies import AbstractEnvironment
from marlyap.hosts.spec import AbstractHostGame


Arguments = Mapping[str, Any]
Maker = Callable[[str, Arguments], AbstractEnvironment]


def maker(source: str, arguments: Arguments) -> Callable[[], AbstractEnvironment]:
    """What makes one copy."""
    family = source.partition(":")[0]
    one = ONE.get(family, _own)
    return lambda: one(source, arguments)


def names_a_host(word: str) -> bool:
    """Whether a word names a game of a library; files of one's own are not looked into."""
    family, colon, _ = word.partition(":")
    return bool(colon) and (family in ONE or family in WHOLE)


def is_file(source: str) -> bool:
    """Whether a source is code of the user's own."""
    return not names_a_host(source)


def parsed(arguments: tuple[str, ...]) -> dict[str, Any]:
    """name=value as JSON where it is some, else as text. Raises UserError for any other word."""
    found: dict[str, Any] = {}
    for word in arguments:
        name, equals, value = word.partition("=")
        if not equals or not name.isidentifier():
            raise UserError(f"arguments: '{word}' is not name=value, as in N=3,max_cycles=25.")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = {"True": True, "False": False, "None": None}.get(value, value)
    return found


def _pettingzoo(source: str, arguments: Arguments) -> AbstractEnvironment:
    module = installed(source, source.partition(":")[2], "pettingzoo", "games")
    make = getattr(module, "parallel_env", None)
    if make is None:
        raise UserError(f"task: {module.__name__} has no parallel_env; name a module that has one.")
    return Parallel(source, _quietly(source, make, _continuous(module, arguments)))


def _continuous(module: Any, arguments: Arguments) -> Arguments:
    """Actions are numbers: an environment that can have both kinds is asked for those."""
    if "continuous_actions" in arguments:
        return arguments
    makers = [getattr(module, name, None) for name in ("parallel_env", "raw_env")]
    more = any("continuous_actions" in _parameters(f) for f in makers)
    return {**arguments, "continuous_actions": True} if more else arguments


def _parameters(f: Any) -> Mapping[str, Any]:
    try:
        return inspect.signature(f).parameters
    except (TypeError, ValueError):
        return {}


def _mamujoco(source: str, arguments: Arguments) -> AbstractEnvironment:
    os.environ.setdefault("MUJOCO_GL", "egl")
    robotics = installed(source, "gymnasium_robotics", "gymnasium-robotics mujoco", "")
    scenario, _, split = source.partition(":")[2].partition(":")
    given = {"agent_conf": split or None, **arguments}
    make = lambda **more: robotics.mamujoco_v1.parallel_env(scenario, **more)
    return Parallel(source, _quietly(source, make, given))


def _gymnasium(source: str, arguments: Arguments) -> AbstractEnvironment:
    os.environ.setdefault("MUJOCO_GL", "egl")
    gymnasium = installed(source, "gymnasium", "gymnasium", "games")
    make = lambda **more: gymnasium.make(source.partition(":")[2], **more)
    return Single(source, _quietly(source, make, arguments))


def _own(source: str, arguments: Arguments) -> AbstractEnvironment:
    """A `ParallelEnv` that a function in a file makes. The file is executed: name your own."""
    path, _, name = source.rpartition(":")
    make = getattr(load_file(path), name, None)
    if not callable(make):
        raise UserError(f"task: {path} defines no function called '{name}'.")
    env = _quietly(source, make, arguments)
    if not hasattr(env, "possible_agents"):
        raise UserError(f"task: {source} made a {type(env).__name__}, which is no ParallelEnv.")
    return Parallel(source, env)


def _quietly(source: str, make: Callable[..., Any], arguments: Arguments) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return made(source, make, arguments)


def load_file(path: str) -> Any:
    """The module at a path that the user typed."""
    if not Path(path).is_file():
        raise UserError(f"task: there is no file {path}.")
    spec = importlib.util.spec_from_file_location(Path(path).stem, path)
    if spec is None or spec.loader is None:
        raise UserError(f"task: {path} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        place = raised_at(error) or Path(path).name
        raise UserError(
            f"task: {path} could not be loaded: {place}: {first_line(error)}."
        ) from error
    return module


def installed(source: str, module: str, packages: str, extra: str) -> Any:
    """An installed module. Raises UserError where it is missing, or lies in no library.

    A run names its game, and runs are passed on: what lies in the working directory is not
    imported for one.
    """
    how = f"pip install 'marlyap[{extra}]'" if extra else f"pip install {packages}"
    try:
        found = importlib.util.find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        found = None
    where = [found.origin] if found and found.origin else []
    where += list(found.submodule_search_locations or ()) if found else []
    if not where:
        missing = module.partition(".")[0]
        raise UserError(f"task: {source} needs {missing}, which is not installed: {how}.")
    libraries = [Path(sysconfig.get_paths()[k]) for k in ("purelib", "platlib")]
    if not any(Path(w).resolve().is_relative_to(p.resolve()) for w in where for p in libraries):
        raise UserError(
            f"task: {module} lies outside the installed packages; a function of your own that "
            "makes a ParallelEnv is named path/to/file.py:make."
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return importlib.import_module(module)
    except ImportError as error:
        raise UserError(
            f"task: {source} could not be imported ({first_line(error)}): {how}."
        ) from error


def _vmas(source: str, copies: int, arguments: Arguments) -> AbstractHostGame:
    library = installed(source, "vmas", "vmas", "")
    from marlyap.hosts.vmas import Vmas

    return Vmas(library, source, copies, arguments)


def _jaxmarl(source: str, copies: int, arguments: Arguments) -> AbstractHostGame:
    library = installed(source, "jaxmarl", "jaxmarl", "")
    from marlyap.hosts.jaxmarl import JaxMarl

    return JaxMarl(library, source, copies, arguments)


ONE: dict[str, Maker] = {
    "pettingzoo": _pettingzoo,
    "mamujoco": _mamujoco,
    "gymnasium": _gymnasium,
}
WHOLE: dict[str, Callable[[str, int, Arguments], AbstractHostGame]] = {
    "vmas": _vmas,
    "jaxmarl": _jaxmarl,
}
