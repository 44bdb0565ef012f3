"""A sweep on disk. The folders are the truth: who looks at them needs nobody's word, and no JAX.

sweep.json          the plan
cells.jsonl         one line a cell: its name, what is set in it, its iterations
NAME/seedN/         the run of cell NAME with seed N, as `marlyap train` leaves it
NAME/seedN/result.json   written once, when the run was trained to its end and measured
NAME/seedN.lock     held by whoever trains the run; the system frees it however that ends
NAME/seedN.failed   why the run ended before its end
NAME/seedN.drop     asks whoever trains the run to stop: a search has given it up
table.csv, curves.csv   written at the end, and by `marlyap sweep table`
"""

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marlyap.errors import UserError
from marlyap.runs.curves import columns, framed
from marlyap.storage import store
from marlyap.sweeps import table
from marlyap.sweeps.jobs import OVER, Entry, Job, Status, status
from marlyap.sweeps.plan import Plan


@dataclass
class Sweep:
    """A folder with a plan and its jobs: what `make_sweep` returns, or `Sweep.open(folder)`."""

    directory: Path
    plan: Plan
    cells: list[Entry]

    @classmethod
    def make(cls, directory: Path | str, plan: Plan, cells: Iterable[Entry]) -> "Sweep":
        """Write the plan down; a plan that is there already is replaced, its runs are kept.

        What has the same settings keeps its folder, and what was trained is not trained again.
        Raises UserError where the directory holds something else, or is in use.
        """
        directory, cells = Path(directory), list(cells)
        if directory.exists() and not (directory / "sweep.json").exists():
            if not directory.is_dir() or any(directory.iterdir()):
                raise UserError(f"out: {directory} exists and is no sweep; choose another one.")
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"out: {directory} cannot be made ({error.strerror}).") from None
        with store.lock(directory):
            if plan.search is not None and (directory / "cells.jsonl").exists():
                cells = cls.open(directory).cells
            lines = "".join(json.dumps(vars(cell)) + "\n" for cell in cells)
            store.write_text_atomic(directory / "cells.jsonl", lines)
            about = {"versions": store.versions(), **plan.to_json()}
            store.write_text_atomic(directory / "sweep.json", json.dumps(about, indent=1) + "\n")
        return cls(directory, plan, cells)

    @classmethod
    def open(cls, directory: Path | str) -> "Sweep":
        """The sweep in a folder. Raises UserError where there is none, or it is damaged."""
        directory = Path(directory)
        if not (directory / "sweep.json").is_file():
            raise UserError(f"sweep: {directory} is not a sweep (it has no sweep.json).")
        about = store.read_json(directory / "sweep.json")
        if isinstance(about, dict):
            about.pop("versions", None)
        plan = Plan.of_json(about, str(directory / "sweep.json"))
        lines = store.read_jsonl(directory / "cells.jsonl")
        try:
            return cls(directory, plan, [Entry(**line) for line in lines])
        except TypeError:
            where = directory / "cells.jsonl"
            raise UserError(f"sweep: {where} is damaged; use another copy.") from None

    def add(self, cell: Entry) -> None:
        """Write down a cell that a search has proposed."""
        store.append_line(self.directory / "cells.jsonl", json.dumps(vars(cell)))
        self.cells.append(cell)

    def jobs_of(self, cell: Entry) -> list[Job]:
        """A job for each seed."""
        return [Job(self.directory, cell, seed) for seed in self.plan.seeds]

    @property
    def jobs(self) -> list[Job]:
        """All of them, the seeds of a cell one after the other."""
        return [job for cell in self.cells for job in self.jobs_of(cell)]

    def statuses(self, known: Iterable[Status] = ()) -> list[Status]:
        """What the folder says of every job. Those known to be over are not looked at again."""
        over = {s.job.name: s for s in known if s.state in OVER}
        try:
            there = {entry.name for entry in os.scandir(self.directory)}
        except OSError:
            there = set()
        look = lambda job: status(job) if job.cell.name in there else Status(job, "waiting")
        return [over.get(job.name) or look(job) for job in self.jobs]

    def table(self) -> Any:
        """One row a job: what is set in it, how it stands, and what it came to.

        A pandas DataFrame where pandas is there, else a dict of NumPy arrays.
        """
        return framed(columns(table.rows(self.plan, self.statuses())))

    def curves(self) -> Any:
        """One row a number of a log: cell, seed, steps, metric, value. As `table` returns it."""
        return framed(columns(table.curves(self.statuses())))

    def write(self, statuses: Iterable[Status]) -> list[Path]:
        """Write table.csv and curves.csv, whole or not at all."""
        statuses, written = list(statuses), []
        rows = {"table": table.rows(self.plan, statuses), "curves": table.curves(statuses)}
        for name, found in rows.items():
            written.append(self.directory / f"{name}.csv")
            store.write_text_atomic(written[-1], table.text(found))
        return written
