"""What a process of its own is told to train: one job, or several in one program. No JAX here."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

from marlyap.runs.job import Launch
from marlyap.sweeps.jobs import Entry, Job


@dataclass(frozen=True)
class Unit:
    """Jobs that are trained together, and how."""

    jobs: tuple[Job, ...]
    how: Launch
    evaluate: int = 0  # held-out starts of every finished job
    core: int | None = None  # to which the process is pinned

    @property
    def name(self) -> str:
        return self.jobs[0].name

    def to_json(self) -> str:
        """One line."""
        jobs = [[str(j.sweep), vars(j.cell), j.seed] for j in self.jobs]
        rest = {"how": dataclasses.asdict(self.how), "evaluate": self.evaluate, "core": self.core}
        return json.dumps({"jobs": jobs} | rest)

    @classmethod
    def from_json(cls, text: str) -> "Unit":
        """What `to_json` wrote."""
        data = json.loads(text)
        jobs = tuple(Job(Path(sweep), Entry(**cell), seed) for sweep, cell, seed in data["jobs"])
        return cls(jobs, Launch(**data["how"]), data["evaluate"], data["core"])
