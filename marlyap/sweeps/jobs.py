"""The jobs of a sweep, and what the folder says of each. `folder` has the names of the files."""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from marlyap.errors import UserError
from marlyap.storage import store
from marlyap.sweeps.plan import Cell


State = Literal["waiting", "running", "stopped", "finished", "failed", "dropped"]
STATES: tuple[State, ...] = ("waiting", "running", "stopped", "finished", "failed", "dropped")
OVER = ("finished", "failed", "dropped")  # nothing more happens unless it is asked for
TAIL = 8_192  # bytes of a log that are read to see its last lines


@dataclass(frozen=True)
class Entry:
    """A cell as it stands in the folder."""

    name: str
    set: Cell
    iterations: int
    program: str = ""  # equal for cells that one compiled program trains
    trial: int | None = None  # of a search


@dataclass(frozen=True)
class Job:
    """One run of a sweep."""

    sweep: Path
    cell: Entry
    seed: int

    @property
    def name(self) -> str:
        return f"{self.cell.name}/seed{self.seed}"

    @property
    def directory(self) -> Path:
        return self.sweep / self.cell.name / f"seed{self.seed}"

    def beside(self, kind: str) -> Path:
        """The file `seedN.KIND` beside the run."""
        return self.sweep / self.cell.name / f"seed{self.seed}.{kind}"


@dataclass(frozen=True)
class Status:
    """What the folder says of a job."""

    job: Job
    state: State
    iteration: int = 0
    last: dict[str, Any] = field(default_factory=dict)  # the last line of its log
    success: float | None = None  # at the last evaluation
    says: str = ""  # why it failed
    result: dict[str, Any] | None = None

    @property
    def share(self) -> float:
        """How much of it is done, from 0 to 1."""
        return 1.0 if self.result else min(1.0, self.iteration / self.job.cell.iterations)


def status(job: Job) -> Status:
    """What the folder says of a job now. Nothing is waited for."""
    directory = job.directory
    with suppress(UserError):
        result = store.read_json(directory / "result.json")
        if isinstance(result, dict):
            done = result.get("iterations", job.cell.iterations)
            return Status(job, "finished", done, success=result.get("success"), result=result)
    lines = last_lines(directory / "log.jsonl")
    last = lines[-1] if lines else {}
    success = next((line["success"] for line in reversed(lines) if "success" in line), None)
    told = Status(job, "running", int(last.get("iteration", 0)), last, success)
    if is_held(job.beside("lock")):
        return told
    change: dict[str, Any] = {"state": "stopped" if last else "waiting"}
    if (said := _text(job.beside("failed"))) is not None:
        change = {"state": "failed", "says": said}
    elif job.beside("drop").exists():
        change = {"state": "dropped"}
    return Status(**{**vars(told), **change})


def _text(path: Path) -> str | None:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None


def last_lines(path: Path) -> list[dict[str, Any]]:
    """The last whole lines of a log, as far as a short read has them; [] where there is none."""
    try:
        with open(path, "rb") as file:
            end = file.seek(0, os.SEEK_END)
            file.seek(max(0, end - TAIL))
            text = file.read()
    except OSError:
        return []
    lines = text.split(b"\n")[(end > TAIL) : -1]
    found = []
    for line in lines:
        with suppress(ValueError):
            found.append(json.loads(line))
    return [line for line in found if isinstance(line, dict)]


def is_held(path: Path) -> bool:
    """Whether another process holds the lock at this path."""
    try:
        with open(path) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        pass
    return False


@contextmanager
def held(job: Job) -> Iterator[bool]:
    """Hold the lock of a job; False where another process does."""
    path = job.beside("lock")
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True
