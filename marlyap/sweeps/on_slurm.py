"""Units as Slurm jobs, by submitit: Slurm decides where and when, the folders say what came of it.

The folder of the sweep has to be on a file system that all nodes share. Jobs outlive the process
that submitted them; started again, it does not train what they train. `cluster=local` runs the
jobs as processes of this machine, to try it where there is no Slurm.
"""

import os
import time
from pathlib import Path
from typing import Any

from marlyap.errors import UserError
from marlyap.sweeps.engine import Ended, alone, missing
from marlyap.sweeps.unit import Unit


POLL = 0.5  # seconds between two looks at the queue


class OnSlurm:
    """One Slurm job a unit, at most `slots` in the queue."""

    def __init__(
        self, folder: Path, slots: int | None = None, options: dict[str, str] | None = None
    ):
        try:
            import submitit  # pyright: ignore[reportMissingImports] -- an extra
        except ImportError:
            raise missing("submitit", "sweep", "on: slurm") from None
        given = dict(options or {})
        self.cluster = given.pop("cluster", "slurm")
        try:
            self.executor: Any = submitit.AutoExecutor(folder, cluster=self.cluster)
        except (RuntimeError, ValueError) as error:
            raise UserError(
                f"engine: submitit finds no {self.cluster} here ({error}); to try it without, "
                "--engine cluster=local."
            ) from None
        self.slots = slots or (os.cpu_count() or 1 if self.cluster == "local" else 1_000)
        settings = {k: int(v) if v.isdigit() else v for k, v in given.items()}
        usual = {"name": "marlyap", "cpus_per_task": 1, "timeout_min": 24 * 60}
        try:
            self.executor.update_parameters(**(usual | settings))
        except (NameError, ValueError, TypeError) as error:
            raise UserError(f"engine: submitit does not take this ({error}).") from None
        self.active: list[tuple[Any, Unit]] = []

    def start(self, unit: Unit) -> None:
        self.active.append((self.executor.submit(alone, unit.to_json()), unit))

    def ended(self, seconds: float) -> list[Ended]:
        until = time.monotonic() + seconds
        while not (done := [pair for pair in self.active if pair[0].done()]):
            if time.monotonic() > until:
                return []
            time.sleep(POLL)
        self.active = [pair for pair in self.active if pair not in done]
        return [Ended(unit, self._says(job)) for job, unit in done]

    def _says(self, job: Any) -> str | None:
        try:
            return job.result()
        except Exception as error:  # submitit's own kinds, and whatever the job raised
            first = str(error).strip().partition("\n")[0]
            return f"its job {job.job_id} failed ({type(error).__name__}: {first})"

    def stop(self) -> None:
        for job, _ in self.active:
            job.cancel(check=False)
        until = time.monotonic() + 30
        while any(not job.done() for job, _ in self.active) and time.monotonic() < until:
            time.sleep(POLL)
