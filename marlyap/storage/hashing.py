"""What a controller or a game is made of, as words, arrays and one hash."""

import dataclasses
import json
import math
from typing import Any

import equinox as eqx
import jax
import numpy as np

from marlyap.storage import store


def policy_hash(controller: Any) -> str:
    """SHA-256 of every number and word the controller is made of."""
    return store.hash_arrays(named_arrays(controller) | {"words": words(controller)})


def words(controller: Any) -> np.ndarray:
    """Of what the controller is made of, all that is not an array, as bytes of JSON."""
    text = json.dumps(as_json(without_arrays(controller)), sort_keys=True)
    return np.frombuffer(text.encode(), np.uint8)


def named_arrays(tree: Any) -> dict[str, np.ndarray]:
    """The arrays of a module by their path, such as policy.pi.net.layers.0.weight."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {_name(path): np.asarray(leaf) for path, leaf in leaves if eqx.is_array(leaf)}


def _name(path: Any) -> str:
    return ".".join(str(getattr(p, "name", getattr(p, "idx", getattr(p, "key", p)))) for p in path)


def without_arrays(tree: Any) -> Any:
    """The module with None for every array."""
    return eqx.filter(tree, eqx.is_array, inverse=True)


def as_json(value: Any) -> Any:
    """Modules, arrays and numbers as JSON values; what is not finite becomes null.

    The kind of a module is the name of its class, with "(own code)" behind it where the class is
    not marlyap's: no code of a user's own passes for what bears the same name here.
    """
    if isinstance(value, eqx.Module):
        ours = type(value).__module__.startswith("marlyap.")
        kind = {"kind": type(value).__name__ + ("" if ours else " (own code)")}
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return kind | as_json(fields)
    if isinstance(value, dict):
        return {str(k): as_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json(v) for v in value]
    if isinstance(value, (np.ndarray, jax.Array)):
        return as_json(np.asarray(value).tolist())
    if isinstance(value, np.generic):
        return as_json(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, (str, int, bool, type(None))) else str(value)
