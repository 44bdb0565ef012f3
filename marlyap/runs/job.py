"""How trainings are to be run, as data. Nothing here imports JAX."""

import dataclasses
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from marlyap.errors import UserError, check_range


CHOICES = {
    "parallel": ("auto", "process", "vmap"),
    "on_nan": ("stop", "rollback"),
    "device": (None, "cpu", "gpu"),
}


@dataclass(frozen=True)
class Launch:
    """How `launch` runs trainings. Raises UserError for a value that is none of the choices."""

    parallel: str = "auto"  # process: one run a core; vmap: one program; auto: by the device
    on_nan: str = "stop"  # when numbers diverge: stop, or rollback to the last checkpoint
    device: str | None = None  # cpu or gpu; None: what JAX finds
    attempts: int = 3  # with rollback, how often a run is tried in all
    task: str | None = None  # path/to/file.py:Name where the task is code of the user's own, and
    algorithm: str | None = None  # likewise; None: where the run's own classes were defined
    log: Sequence[str] = ()  # trackers that are told as well: wandb, mlflow, trackio

    def __post_init__(self):
        object.__setattr__(self, "log", tuple(self.log))  # JSON has lists
        if self.log:
            from marlyap.runs.sinks import check

            check(self.log)
        for field, choices in CHOICES.items():
            value = getattr(self, field)
            if value not in choices:
                *first, last = [choice for choice in choices if choice]
                allowed = f"{', '.join(first)} or {last}"
                raise UserError(f"{field.replace('_', '-')}: '{value}' must be {allowed}.")
        check_range("attempts", self.attempts, 1, 1000)

    @property
    def tries(self) -> int:
        """How often a run whose numbers diverge is tried in all."""
        return self.attempts if self.on_nan == "rollback" else 1


@dataclass(frozen=True)
class Job:
    """All that a process of its own is told: which run, on which core, and how."""

    run: str  # its directory
    core: int | None
    how: Launch

    def to_json(self) -> str:
        """One line."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "Job":
        """What `to_json` wrote."""
        data = json.loads(text)
        return cls(data["run"], data["core"], Launch(**data["how"]))


def seeds(words: Iterable[str]) -> list[int]:
    """The seeds asked for: whole numbers, each once."""
    each = [w for word in words for w in word.split(",")]
    for word in each:
        if not re.fullmatch(r"[+-]?\d+", word.strip()):
            raise UserError(f"seeds: '{word}' is not a whole number.")
    numbers = [int(w) for w in each]
    if len(set(numbers)) != len(numbers):
        raise UserError(f"seeds: {' '.join(each)} names a seed twice.")
    if not all(0 <= n < 2**31 for n in numbers):
        raise UserError(f"seeds: {' '.join(each)} must lie between 0 and 2147483647.")
    return numbers
