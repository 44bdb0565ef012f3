"""Hyperparameters that a compiled program is given, instead of being compiled for.

A class names in `traced` those of its fields that may change without another program: rates,
discounts, weights, temperatures. What the Python of a class branches on does not belong there, nor
what decides a shape. Code that is traced then meets an array where there was a Python number.
"""

from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax.numpy as jnp


class AbstractTraced(eqx.Module):
    """Has fields that are numbers to a compiled program."""

    traced: ClassVar[tuple[str, ...]] = ()  # their names


T = TypeVar("T")


def with_arrays(obj: T) -> T:
    """The object with a float32 for each of its traced numbers, and for those of its fields.

    What is no number, such as None or a word, stays what it is: it says which program.
    """
    return _with(obj, jnp.float32)


def is_traced(obj: Any, path: str) -> bool:
    """Whether the field at this dotted path holds a number that a compiled program is given."""
    *above, name = path.split(".")
    for step in above:
        obj = vars(obj)[step]
    return isinstance(obj, AbstractTraced) and name in obj.traced and _is_number(vars(obj)[name])


def program(obj: T) -> T:
    """The object with the same word for each traced number: equal for what one program trains."""
    return _with(obj, lambda value: "given")


def _with(obj: T, new: Callable[[Any], Any]) -> T:
    """A copy, with what `new` makes of each traced number."""
    if not isinstance(obj, eqx.Module):
        return obj
    names = obj.traced if isinstance(obj, AbstractTraced) else ()
    after = object.__new__(type(obj))  # as by JAX: what has been checked is not checked again
    for name, value in vars(obj).items():
        given = name in names and _is_number(value)
        object.__setattr__(after, name, new(value) if given else _with(value, new))
    return after


def _is_number(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool)
