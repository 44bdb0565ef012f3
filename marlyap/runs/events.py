"""What happens to a training, told as it happens.

`fit` and `launch` yield these; the command line draws them, a notebook or a sweep reads them. Each
is one line of JSON as well, which is how a process tells its parent.
"""

import dataclasses
import json
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Event:
    """Something happened to the run in directory `run`, which is "" for training in memory."""

    run: str
    seed: int


@dataclass(frozen=True)
class Started(Event):
    """Training begins or resumes; the programs are compiled next."""


@dataclass(frozen=True)
class Progress(Event):
    """One iteration is done. `line` is what the log says of it."""

    line: dict[str, Any]
    iterations: int  # of the whole training


@dataclass(frozen=True)
class Warned(Event):
    """Something to know; training continues."""

    says: str


@dataclass(frozen=True)
class Diverged(Event):
    """A number stopped being finite in this iteration, which is not saved."""

    iteration: int
    quantity: str  # which: a name of the log, or a part of what the task returns
    says: str  # the same with its remedy, in one sentence


@dataclass(frozen=True)
class Saved(Event):
    """A checkpoint is on disk: from here the run can be resumed."""

    iteration: int


@dataclass(frozen=True)
class Finished(Event):
    """The run was trained to its end and is saved."""


@dataclass(frozen=True)
class Failed(Event):
    """The run ended before its end, and not because `stop` asked for it."""

    says: str


KINDS: dict[str, type[Event]] = {
    kind.__name__: kind for kind in (Started, Progress, Warned, Diverged, Saved, Finished, Failed)
}


def to_json(event: Event) -> str:
    """The event as one line of JSON: its kind and its fields."""
    return json.dumps({"event": type(event).__name__} | dataclasses.asdict(event))


def from_json(text: str) -> Event:
    """The event that `to_json` wrote. Raises ValueError for any other text."""
    data = json.loads(text)
    if not isinstance(data, dict) or data.get("event") not in KINDS:
        raise ValueError(f"not an event: {text[:80]!r}")
    kind = KINDS[data.pop("event")]
    try:
        return kind(**data)
    except TypeError:
        raise ValueError(f"not the fields of {kind.__name__}: {text[:80]!r}") from None
