"""Rows as columns, for whoever analyses them. No JAX here."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """A column for each name that a row has; NaN, or None among words, where a row lacks it."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: _column([row.get(name) for row in rows]) for name in names}


def _column(values: list[Any]) -> np.ndarray:
    known = [value for value in values if value is not None]
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in known):
        if known and len(known) == len(values) and all(isinstance(v, int) for v in known):
            return np.array(values)
        return np.array([np.nan if v is None else v for v in values], float)
    return np.array(values, object)


def framed(found: dict[str, np.ndarray]) -> Any:
    """A DataFrame where pandas is there, else the columns as they are."""
    try:
        import pandas  # pyright: ignore[reportMissingImports] -- an extra
    except ImportError:
        return found
    return pandas.DataFrame(found)
