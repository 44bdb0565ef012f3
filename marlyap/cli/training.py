"""Runs that are made, resumed and trained: what `train` and `demo` share."""

import re
import shutil
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from marlyap.cli.common import Overrides, say
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.hosts.sources import names_a_host
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.hosted import Hosted
from marlyap.runs import config
from marlyap.runs.asked import Asked, assemble
from marlyap.runs.job import Launch, seeds
from marlyap.runs.launch import launch
from marlyap.runs.progress import show
from marlyap.runs.run import Run, expand, one_run
from marlyap.runs.stop import Stop
from marlyap.runs.subject import supplies


def reopened(places: Iterable[Path], task: str | None, algorithm: str | None) -> list[Run]:
    """The runs to be resumed; `task` and `algorithm` name code of the user's own."""
    game = config.load_task(task) if task else None
    rule = config.load(algorithm, AbstractAlgorithm) if algorithm else None
    runs = [Run.open(d, game, rule) for d in expand(places)]
    for run in runs:
        keeps(run, {"task": task, "algorithm": algorithm}, game, rule)
        for warning in run.warnings:
            say(f"warning: {warning}")
    readable(runs)
    return runs


def keeps(
    run: Run,
    named: dict[str, str | None],
    game: AbstractGame | Hosted | None,
    rule: AbstractAlgorithm | None,
) -> None:
    """Raise UserError if another task or algorithm is named than the run was trained with."""
    own_rule = rule is not None and bool(config.own_classes(run.trainer.algorithm))
    fits = {
        "task": game is None or supplies(named["task"] or "", game, run),
        "algorithm": rule is None or own_rule,
    }
    for part, is_own in fits.items():
        if not is_own and named[part] != run.names[part]:
            raise UserError(
                f"{part}: {run.directory} was trained with {run.labels[part]}, and a run that is "
                "resumed keeps it; leave the other out."
            )


def readable(runs: list[Run]) -> None:
    """Raise UserError where a finished run has no sound checkpoint left; nothing would train it."""
    for run in runs:
        if run.finished:
            for warning in run.checkpoints.latest().warnings:
                say(f"warning: {warning}")


def create(
    asked: Asked, overrides: Overrides, words: list[str], out: Path | None, force: bool
) -> list[Run]:
    """One new run for each seed, in `out` or in runs/TASK/ALGORITHM."""
    trainer = assemble(asked, overrides)
    out = out or Path("runs") / folder(asked.task) / folder(asked.algorithm)
    places = {seed: out / f"seed{seed}" for seed in seeds(words)}
    for place in places.values():
        Run.vacant(place, force)
    return [Run.create(p, trainer, seed, asked.names, force) for seed, p in places.items()]


def start_from(runs: list[Run], place: Path, task: str, algorithm: str) -> None:
    """Give new runs the networks of the run at this place; what does not fit leaves none of them.

    Task and algorithm are what the user named for the new runs: they supply the code of his own.
    """
    try:
        other = Run.open(
            one_run(place), config.load_task(task), config.load(algorithm, AbstractAlgorithm)
        )
        for run in runs:
            run.started_from(other)
    except BaseException:
        for run in runs:
            shutil.rmtree(run.directory, ignore_errors=True)
        raise


def folder(name: str) -> str:
    """What the directory of a task or algorithm is called."""
    if names_a_host(name):
        return re.sub(r"[^\w.+-]+", "-", name)
    return Path(name.rpartition(":")[2]).stem if ":" in name else name


def trained(runs: list[Run], how: Launch, new: bool) -> int:
    """Train; a new run in which training could not begin leaves no directory behind."""
    try:
        return follow(runs, how)
    except BaseException:
        for run in runs if new else ():
            if run.untouched:
                shutil.rmtree(run.directory, ignore_errors=True)
                with suppress(OSError):  # as when other runs are in it
                    run.directory.parent.rmdir()
        raise


def follow(runs: list[Run], how: Launch) -> int:
    """Train and draw the progress; returns 0, or 128 + the signal that stopped it."""
    waiting = [run for run in runs if not run.finished]
    tell = lambda: say("\nStopping at the next checkpoint; once more to stop at once.")
    with Stop(tell) as stop:
        show(launch(waiting, how, stop))
    if stop() and waiting:
        where = " ".join(str(run.directory) for run in waiting)
        say(f"Saved. Resume with: marlyap train --resume {where}")
    return stop.code
