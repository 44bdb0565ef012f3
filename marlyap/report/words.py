"""Numbers in words, for tables and labels. What is missing or not finite is a dash."""

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np


DASH = "–"
MINUS = "\u2212"


def number(value: Any) -> float | None:
    """A finite number, or None."""
    try:
        found = float(value)
    except (TypeError, ValueError):
        return None
    return found if math.isfinite(found) else None


def pair(values: Any) -> tuple[float, float] | None:
    """Two finite numbers, or None."""
    low, high = (number(v) for v in (*(values if values is not None else ()), None, None)[:2])
    return None if low is None or high is None else (low, high)


def quantile(quantiles: Mapping[str, Any], q: float) -> float | None:
    return next((value for key, value in quantiles.items() if number(key) == q), None)


def text(value: Any) -> str:
    return DASH if value is None or value == "" else str(value)


def integer(value: Any) -> str:
    found = number(value)
    return DASH if found is None else f"{found:,.0f}".replace(",", "\u202f")


def decimal(value: Any, digits: int, unit: str = "") -> str:
    found = number(value)
    if found is None:
        return DASH
    return f"{found:.{digits}f}{' ' + unit if unit else ''}".replace("-", MINUS)


def both(quantiles: Mapping[str, Any], digits: int) -> str:
    """The median, and what 95 % stay under."""
    if not quantiles:
        return DASH
    return " / ".join(decimal(quantile(quantiles, q), digits) for q in (0.5, 0.95))


def percent(value: Any) -> str:
    """A rate in per cent; only an exact one is written as 0 or 100."""
    rate = number(value)
    if rate is None:
        return DASH
    if rate in (0.0, 1.0):
        return f"{100 * rate:.0f} %"
    return f"{min(max(100 * rate, 0.1), 99.9):.1f} %"


def interval(values: Any) -> str:
    ends = pair(values)
    if ends is None:
        return DASH
    return f"{percent(ends[0]).removesuffix(' %')} {DASH} {percent(ends[1])}"


def p_value(value: Any) -> str:
    found = number(value)
    if found is None:
        return DASH
    return "< 0.0001" if found < 1e-4 else f"{found:.2g}"


def short(value: float | int) -> str:
    """The label of a tick."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}".replace("-", MINUS)
    return f"{0.0 if abs(value) < 1e-12 else value:.6g}".replace("-", MINUS)


def duration(seconds: Any) -> str:
    found = number(seconds)
    if found is None:
        return DASH
    if found < 60:
        return f"{found:.1f} s"
    minutes, left = divmod(round(found), 60)
    hours, minutes = divmod(minutes, 60)
    parts = ((hours, "h"), (minutes, "min"), (left, "s"))
    return " ".join(f"{count} {unit}" for count, unit in parts if count)


def anything(value: Any) -> str:
    """A value of unknown kind as text."""
    shown = plain(value, significant=True)
    if shown is None:
        return DASH
    if isinstance(shown, bool):
        return "yes" if shown else "no"
    if isinstance(shown, list) and not any(isinstance(item, list | dict) for item in shown):
        return ", ".join(anything(item) for item in shown) or DASH
    if isinstance(shown, str):
        return shown
    return json.dumps(shown, ensure_ascii=False, default=str)


def plain(value: Any, digits: int = 4, *, significant: bool = False) -> Any:
    """Python's own numbers, rounded, with None for what is not finite."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        value = float(f"{value:.{digits}g}") if significant else round(value, digits)
        return int(value) if value == int(value) and abs(value) < 1e6 else value
    within = lambda item: plain(item, digits, significant=significant)
    if isinstance(value, Mapping):
        return {str(key): within(item) for key, item in value.items()}
    return [within(item) for item in value] if isinstance(value, list | tuple) else value


def flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    """The leaves of a nested dictionary with their dotted paths."""
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
