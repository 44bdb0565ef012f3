"""The jobs of a unit, trained and measured in this process."""

import json
import os
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from marlyap.errors import UserError, explained
from marlyap.learning.training import AbstractTrainer
from marlyap.runs import asked, config, events
from marlyap.runs.launch import together
from marlyap.runs.run import Run
from marlyap.simulation.evaluation import evaluate
from marlyap.storage import store
from marlyap.storage.hashing import policy_hash
from marlyap.sweeps.jobs import Job, held
from marlyap.sweeps.plan import WORDS
from marlyap.sweeps.unit import Unit


def train(unit: Unit, stop: Callable[[], bool]) -> None:
    """Train those jobs of the unit that nobody trains, and that are not finished.

    Whatever happens to a job is written beside it; nothing is raised for it.
    """
    began = time.process_time()
    with ExitStack() as locks:
        mine = [job for job in unit.jobs if locks.enter_context(held(job))]
        mine = [job for job in mine if not (job.directory / "result.json").exists()]
        for job in mine:
            job.beside("failed").unlink(missing_ok=True)
        opened = [(j, run) for j in mine if (run := _told(j, lambda j=j: run_of(j)))]
        _together(opened, unit, stop)
        for job, run in opened:
            if run.finished and not job.beside("failed").exists():
                _told(job, lambda run=run, job=job: finish(job, run, unit.evaluate, began))


def _together(opened: list[tuple[Job, Run]], unit: Unit, stop: Callable[[], bool]) -> None:
    """Train these runs in one program; write down which of them failed, and why."""
    given_up = lambda: all(job.beside("drop").exists() for job, _ in opened)
    by_place = {str(run.directory): job for job, run in opened}
    runs = [run for _, run in opened if not run.finished]
    told = False
    try:
        for event in together(runs, unit.how, lambda: stop() or given_up()):
            if isinstance(event, events.Failed):
                told = True
                _fail(by_place[event.run], event.says)
    except Exception as error:  # whatever the code of a user's task may raise
        for run in runs if not told else ():  # else it repeats what was told
            _fail(by_place[str(run.directory)], _sentence(error))


def run_of(job: Job) -> Run:
    """The run of a job, made if it is not there.

    Raises UserError if it cannot be made, or if the run that is there has other settings.
    """
    cell = job.cell.set
    named = asked.Asked(cell["task"], cell["algorithm"], cell.get("preset"))
    trainer = asked.assemble(named, {k: v for k, v in cell.items() if k not in WORDS})
    if not (job.directory / "run.json").is_file():
        _clear(job.directory)
        return Run.create(job.directory, trainer, job.seed, named.names)
    run = Run.open(job.directory, trainer.game, trainer.algorithm)
    if _record(run.trainer) != _record(trainer):
        raise UserError(
            f"{job.directory}: this run was made with other settings than its name says, by "
            "another version of marlyap perhaps; move it away."
        )
    return Run(run.directory, trainer, run.seed, run.names)


def _record(trainer: AbstractTrainer) -> list[Any]:
    return [config.record(p) for p in (trainer.game, trainer.algorithm, trainer.schedule)]


def _clear(directory: Path) -> None:
    """Remove what a process left that was killed while it made the run, and nothing else."""
    with suppress(FileNotFoundError):
        for name in os.listdir(directory):
            if store.SCRATCH.fullmatch(name):
                (directory / name).unlink()


def finish(job: Job, run: Run, episodes: int, began: float) -> None:
    """Measure a trained run, and write its result down, once.

    Its `cpu_seconds` are those since `began`, of all that was trained together, and without what
    was spent before it was last resumed.
    """
    lines = run.history()
    last = lines[-1] if lines else {}
    looks = [line for line in lines if "success" in line]
    about = {
        "cell": job.cell.name,
        "seed": job.seed,
        "set": job.cell.set,
        "iterations": run.trainer.iterations,
        "policy": policy_hash(run.controller()),
        "cpu_seconds": round(time.process_time() - began, 3),
        "host": socket.gethostname(),
        "versions": store.versions(),
    }
    about |= {k: last[k] for k in ("steps", "updates", "seconds", "return") if k in last}
    about |= {"success": looks[-1]["success"], "best": max(_of(looks))} if looks else {}
    if episodes:
        about |= measured(run, episodes)
    text = json.dumps(about, indent=1)
    store.write_text_atomic(job.directory / "result.json", text + "\n")


def _of(looks: list[dict[str, Any]]) -> list[float]:
    return [line["success"] for line in looks]


def measured(run: Run, episodes: int) -> dict[str, Any]:
    """What `marlyap evaluate` finds, as columns: held-out success with its interval, distances."""
    found = evaluate(run.game, run.controller(), episodes).summary()
    low, high = found["interval"]
    figures = {"held_out": found["success_rate"], "low": low, "high": high, "episodes": episodes}
    ends = found["final_distance"]
    return figures | {"final_p50": ends["0.5"], "final_p95": ends["0.95"]}


def _told(job: Job, make: Callable[[], Any]) -> Any:
    """What `make` returns; None, and the reason beside the job, where it raises."""
    try:
        return make()
    except Exception as error:  # whatever the code of a user's task may raise
        _fail(job, _sentence(error))
        return None


def _sentence(error: Exception) -> str:
    said = str(error) if isinstance(error, UserError) else explained(error)
    return said or f"{type(error).__name__}: {error}"


def _fail(job: Job, says: str) -> None:
    store.write_text_atomic(job.beside("failed"), says + "\n")
