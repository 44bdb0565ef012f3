"""Programs that are traced once: what a training compiles is kept as it was before XLA had it.

XLA keeps what it has compiled, but to find it there JAX has to trace and lower the Python anew,
which takes longer at every start than all the rest. Here the lowered program is kept, by
`jax.export`, as a stored directory whose name is a digest of all that it was made from: every
source file of this package, the versions of what it uses, the settings of JAX, the device, the
trainer with its configuration, and the shapes of the arrays. Numbers that the trainer holds as
arrays (`learning.traced`) are arguments of the program and no part of its name.

It is done where the environment variable MARLYAP_PROGRAMS names a folder, as it does for the
command line, and for programs made of this package alone: of code of your own nothing tells whether
it has changed since.
"""

import dataclasses
import hashlib
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax import export

from marlyap.errors import UserError
from marlyap.storage import store
from marlyap.storage.hashing import as_json, words


FOLDER = "MARLYAP_PROGRAMS"
KIND, MOST = "program", 256  # programs kept, the last ones used
SOURCE = Path(__file__).parents[1]  # all of the package, since a program may depend on any of it

Tree = TypeVar("Tree")
Info = dict[str, Any]


def compiled(
    f: Callable[[Any, Any], tuple[Tree, Info]],
    maker: eqx.Module,
    argument: Any,
    like: Callable[[], Tree],
    donate: bool = False,
) -> Callable[[Any], tuple[Tree, Info]]:
    """`f(maker, .)` compiled for arguments shaped as this one; with `donate` they are used up.

    The arrays in `maker` are arguments as well, which are kept: the program is that of all makers
    that differ in their values alone. f returns a tree and a dict of arrays; `like()` has the
    tree's structure, with arrays or their shapes, and all that is not an array.
    """
    folder = os.environ.get(FOLDER)
    given, fixed = eqx.partition(argument, _has_shape)
    leaves, structure = jax.tree.flatten(given)
    numbers, maker_without = eqx.partition(maker, _has_shape)
    known, structure_of_maker = jax.tree.flatten(numbers)
    if not folder or jax.device_count() > 1 or not (_ours(maker) and _ours(fixed)):
        return lambda argument: _traced(f, donate)(maker, argument)
    shapes = [[jax.ShapeDtypeStruct(x.shape, x.dtype) for x in xs] for xs in (leaves, known)]

    def flat(leaves, known):
        made = eqx.combine(structure_of_maker.unflatten(known), maker_without)
        tree, info = f(made, eqx.combine(structure.unflatten(leaves), fixed))
        return jax.tree.leaves(eqx.filter(tree, _has_shape)), info

    about = [f.__qualname__, as_json(maker_without), str(structure_of_maker)]
    about += [words(argument).tobytes().decode(), str(structure)]
    place = Path(folder, _digest(*about, str(shapes), donate))
    run = _kept(place, flat, shapes, donate)
    shaped, fixed_after = eqx.partition(like(), _has_shape)
    structure_after = jax.tree.structure(shaped)

    def call(argument):
        leaves, info = run(jax.tree.leaves(eqx.filter(argument, _has_shape)), known)
        return eqx.combine(structure_after.unflatten(leaves), fixed_after), info

    return call


@cache
def _traced(f: Callable[..., Any], donate: bool) -> Callable[..., Any]:
    return eqx.filter_jit(f, donate="all-except-first" if donate else "none")


def _kept(place: Path, f: Callable[..., Any], shapes: list[Any], donate: bool) -> Any:
    """The program kept there; where there is none, or it is damaged, `f` is traced and kept."""
    with suppress(UserError, OSError):
        run = _loaded(place, os.stat(place / store.PAYLOAD).st_mtime_ns, donate)
        with suppress(OSError):
            os.utime(place)
        return run
    made = export.export(jax.jit(f))(*shapes)
    with suppress(UserError, OSError):  # a disk that is full or read-only takes nothing but time
        place.parent.mkdir(parents=True, exist_ok=True)
        store.write(
            place, KIND, {"exported": np.frombuffer(made.serialize(), np.uint8)}, {}, replace=True
        )
        _forget(place.parent)
    return _compiled(made, donate)


@lru_cache(maxsize=16)
def _loaded(place: Path, written: int, donate: bool) -> Any:
    """The program as it was written then, compiled once for all that this process trains with it.

    Raises UserError where it cannot be read.
    """
    arrays, _ = store.read(place, KIND)
    return _compiled(export.deserialize(bytearray(arrays["exported"].tobytes())), donate)


def _compiled(program: export.Exported, donate: bool) -> Any:
    return jax.jit(program.call, donate_argnums=0 if donate else ())


def _forget(folder: Path) -> None:
    """Remove what has not been used for longest, beyond what is kept."""
    with suppress(OSError):  # another process may forget them too
        by_age = sorted(folder.iterdir(), key=lambda p: p.stat().st_mtime, reverse=True)
        for place in by_age[MOST:]:
            shutil.rmtree(place, ignore_errors=True)


def _digest(*parts: Any) -> str:
    text = "\0".join(map(str, (*parts, *_surroundings())))
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def _surroundings() -> tuple[str, ...]:
    """All that tracing depends on beside its arguments."""
    source = hashlib.sha256()
    for path in sorted(SOURCE.rglob("*.py")):
        source.update(path.read_bytes())
    settings = {k: str(v) for k, v in jax.config.values.items() if "cache" not in k}
    device = jax.devices()[0]
    where = (str(store.versions()), device.platform, device.device_kind)
    return (source.hexdigest(), str(sorted(settings.items())), *where)


def _has_shape(x: Any) -> bool:
    return isinstance(x, jax.Array | jax.ShapeDtypeStruct)


def _ours(value: Any) -> bool:
    """Whether all code in it is this package's, or of libraries whose versions are known."""
    if isinstance(value, eqx.Module):
        inside = [getattr(value, f.name) for f in dataclasses.fields(value)]
        return type(value).__module__.startswith("marlyap.") and all(map(_ours, inside))
    if isinstance(value, dict):
        return all(map(_ours, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_ours, value))
    return value is None or isinstance(value, str | int | float | np.ndarray | jax.Array)
