"""How far a runtime is from the golden pairs. No JAX is needed."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from marlyap.deploy.runtime import Role, answers


TOLERANCE = 2e-6  # of an action in [-1, 1]

Arrays = Mapping[str, np.ndarray]
Answer = tuple[np.ndarray, np.ndarray]  # commands [pair, input]; whether each is the fallback
Answers = Callable[[dict[str, Any], Arrays], Answer]  # of one role, of its inputs


class Agreement(NamedTuple):
    """What one runtime answers to all golden pairs."""

    pairs: int
    worst: float  # the largest difference of an action
    fault: str  # what is wrong, in words; empty where nothing is


def pairs_of(golden: Arrays, role: str) -> dict[str, np.ndarray]:
    """The golden pairs of one robot."""
    head = f"{role}."
    return {k.removeprefix(head): v for k, v in golden.items() if k.startswith(head)}


def agreement(contract: dict[str, Any], golden: Arrays, runtime: Answers) -> Agreement:
    """Compare a runtime with all golden pairs: commands within TOLERANCE, fallbacks where due."""
    limits = np.array([c["limit"] for c in contract["action"]["channels"]])
    count, worst, fault = 0, 0.0, ""
    for role in contract["roles"]:
        given = pairs_of(golden, role["name"])
        command, fallback = runtime(role, given)
        due, count = given["fallback"].astype(bool), count + len(command)
        if command.shape != given["command"].shape:
            return Agreement(count, np.inf, f"{role['name']} answers {len(command)} pairs")
        missed = np.flatnonzero(due & ~fallback)
        extra = np.flatnonzero(~due & fallback)
        apart = np.abs(command.astype(float) - given["command"]) / limits
        apart = np.where(np.isfinite(apart), apart, np.inf).max(axis=1)
        worst = max(worst, float(apart.max()))
        if fault:
            continue
        if len(missed):
            fault = (
                f"{role['name']} lost its fallback: pair {missed[0]} has a number that is not "
                "finite, no goal or an old state, and it acts on it"
            )
        elif len(extra):
            fault = f"{role['name']} falls back in pair {extra[0]}, where it has to act"
        elif apart.max() > TOLERANCE:
            k = int(apart.argmax())
            fault = f"{role['name']} differs in pair {k} by {apart[k]:.1e} of its largest command"
    return Agreement(count, worst, fault)


def by_numpy(contract: dict[str, Any], arrays: Arrays) -> Answers:
    """The runtime of NumPy, in this process."""

    def answer(role: dict[str, Any], given: Arrays) -> Answer:
        return answers(Role(contract, arrays, role["name"]), given)

    return answer
