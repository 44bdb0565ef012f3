"""What the user can correct, said in one sentence."""

import dataclasses
import inspect
import re
import sysconfig
from pathlib import Path
from types import FrameType
from typing import Any


# Whose code is not the user's: this package, Python's library and what is installed.
OTHERS = [Path(__file__).parent, *map(Path, sysconfig.get_paths().values())]


class UserError(Exception):
    """Bad input. The message is one sentence that names the field and the remedy.

    The command line prints it on standard error and exits with code 2, without a traceback. It is
    one line whatever was quoted in it, and nothing in it moves a terminal's cursor.
    """

    def __str__(self) -> str:
        visible = "".join(c if c.isprintable() else " " for c in super().__str__())
        return " ".join(visible.split())


def check_range(
    name: str, value: float | int, low: float | int, high: float | int, open: bool = False
) -> None:
    """Raise UserError unless low <= value <= high; `open` leaves `low` itself out."""
    if not (low < value if open else low <= value) or not value <= high:
        least = f"more than {low:g}" if open else f"{low:g}"
        raise UserError(f"{name}: {value} is out of range; take {least} to {high:g}.")


def whole_fields(obj: Any) -> None:
    """Raise UserError for a field of a dataclass that has to hold whole numbers and does not.

    Python would take 1e5 for it, and JAX would fail much later.
    """
    is_whole = lambda value: isinstance(value, int) and not isinstance(value, bool)
    for field in dataclasses.fields(obj):
        value = getattr(obj, field.name)
        if field.type in (int, "int") and not is_whole(value):
            remedy = (
                f"write {int(value)}" if isinstance(value, float) and value % 1 == 0 else "use one"
            )
            raise UserError(f"{field.name}: {value!r} is not a whole number (int); {remedy}.")
        if field.type in (tuple[int, ...], "tuple[int, ...]") and not (
            isinstance(value, tuple) and all(map(is_whole, value))
        ):
            remedy = f"write ({value!r},)" if is_whole(value) else "write one such as (0, 1)"
            raise UserError(f"{field.name}: {value!r} is not a tuple of whole numbers; {remedy}.")


def whole(text: str) -> int:
    """A whole number, also as 1e5 or 100_000. Raises ValueError for any other text."""
    plain = text.replace("_", "")
    if re.fullmatch(r"[+-]?\d+(\.\d+)?[eE]\+?\d{1,2}", plain) and float(plain).is_integer():
        return int(float(plain))
    return int(plain)


def explained(error: BaseException) -> str | None:
    """One sentence about an error of the user's code or machine; None for an error of ours."""
    if "RESOURCE_EXHAUSTED" in str(error) or isinstance(error, MemoryError):
        said = str(error).partition("RESOURCE_EXHAUSTED:")[2].strip().rstrip(".")
        detail = f" ({said.splitlines()[0][:160]})" if said else ""
        return (
            f"memory: there is not enough{detail}; lower --schedule.environments, "
            "--schedule.capacity or the number of episodes."
        )
    place = raised_at(error)
    return f"{place}: {first_line(error)}." if place else None


def raised_at(error: BaseException) -> str | None:
    """'file.py:12': the last line of the user's code that the error came through."""
    found = None
    if isinstance(error, SyntaxError) and error.filename and error.lineno:
        found = f"{Path(error.filename).name}:{error.lineno}"
    step = error.__traceback__
    while step is not None:
        if _is_users(step.tb_frame):
            found = f"{Path(step.tb_frame.f_code.co_filename).name}:{step.tb_lineno}"
        step = step.tb_next
    return found


def defined_at(obj: Any, method: str) -> str | None:
    """'file.py:12': where the user's class defines a method; None where it does not."""
    code = getattr(inspect.unwrap(getattr(type(obj), method, None) or len), "__code__", None)
    if code is None or not _is_users_file(code.co_filename):
        return None
    return f"{Path(code.co_filename).name}:{code.co_firstlineno}"


def first_line(error: BaseException) -> str:
    """The error's kind and the first line of what it says, without a full stop."""
    said = error.msg if isinstance(error, SyntaxError) else str(error)
    line = (said.strip().splitlines() or [""])[0].strip().rstrip(".")[:160]
    return f"{type(error).__name__} ({line})" if line else type(error).__name__


def _is_users(frame: FrameType) -> bool:
    return _is_users_file(frame.f_code.co_filename)


def _is_users_file(name: str) -> bool:
    return not name.startswith("<") and not any(Path(name).is_relative_to(p) for p in OTHERS)
