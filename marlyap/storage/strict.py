"""Strict JSON: no key twice, no NaN or infinity, no unpaired surrogate, no deep nesting."""

import json
import math
from typing import Any


JSON_DEPTH = 64


def parse(raw: bytes) -> Any:
    """The JSON value of these bytes. Raises ValueError for anything but strict JSON."""
    hooks = {"object_pairs_hook": _unique, "parse_float": _finite, "parse_constant": _finite}
    try:
        value = json.loads(raw.decode(), **hooks)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    level, depth = [value], 0
    while level:
        if (depth := depth + 1) > JSON_DEPTH:
            raise ValueError("it is nested too deeply")
        nodes = [[*x.values()] if isinstance(x, dict) else x for x in level]
        level = [child for node in nodes if isinstance(node, list) for child in node]
    json.dumps(value, ensure_ascii=False).encode()  # refuses a surrogate without its pair
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is written twice")
    return found


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text[:20]} is not a finite number")
    return number
