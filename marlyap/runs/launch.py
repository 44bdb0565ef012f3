"""Many trainings at once: one process a core on a CPU, one vmapped program on a GPU."""

import dataclasses
import itertools
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from queue import Empty, Queue
from typing import IO, Any

import jax

from marlyap.errors import UserError
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.traced import program
from marlyap.runs import config, events
from marlyap.runs.fit import Diverged, fit
from marlyap.runs.job import Job, Launch
from marlyap.runs.run import Run


WORKER = (sys.executable, "-m", "marlyap.runs.worker")
POLL = 0.2  # seconds between two looks at whether to stop


USUAL = Launch()


def launch(
    runs: Iterable[Run], how: Launch = USUAL, stop: Callable[[], bool] = lambda: False
) -> Iterator[events.Event]:
    """Train the runs that are not finished; yields what happens to them.

    `stop` is asked again and again; once it says True, everything is saved and this ends, and
    calling it again resumes. A run that fails is told as Failed, and the others continue.
    Dropping the iterator stops all processes, which save first.

    Raises UserError at the end with the reason of the first run that failed, or at once for what
    cannot be trained at all.
    """
    runs = [run for run in runs if not run.finished]
    if not runs:
        return
    on_cpu = how.device == "cpu" if how.device else jax.default_backend() == "cpu"
    alone = len(runs) == 1 or how.parallel == "vmap" or (how.parallel == "auto" and not on_cpu)
    if not alone:
        yield from _processes(runs, how, stop)
        return
    if how.device not in (None, there := jax.default_backend()):
        raise UserError(
            f"device: JAX has started on {there} here; set JAX_PLATFORMS before it is imported."
        )
    yield from (events.Started(*run.named) for run in runs)
    yield from together(runs, how, stop)


def together(runs: list[Run], how: Launch, stop: Callable[[], bool]) -> Iterator[events.Event]:
    """Runs of one program together; one such group after the other.

    They differ in their seeds, and in numbers that the program is given.

    Raises UserError at the end if a number stopped being finite in any of them.
    """
    failed: list[str] = []
    while runs:
        first, *others = runs
        what, apart = program(first.trainer), not first.trainer.side_by_side
        alike = [program(run.trainer) == what and not apart for run in others]
        group = [first, *itertools.compress(others, alike)]
        runs = [run for run, same in zip(others, alike, strict=True) if not same]
        says: dict[str, str] = {}
        try:
            for event in fit(group, stop, how.tries, how.log):
                if isinstance(event, events.Diverged):
                    says[event.run] = event.says
                yield event
        except Diverged:  # in all of the group, each of which is in `says`
            pass
        for run in group:
            if run.finished:
                yield events.Finished(*run.named)
            elif said := says.get(str(run.directory)):
                failed.append(said)
                yield events.Failed(*run.named, said)
    if failed:
        raise UserError(failed[0])


class _Child:
    """A run in a process of its own, and a thread that puts its answers into a queue."""

    def __init__(self, run: Run, core: int, how: Launch, queue: Queue):
        self.run, self.core, self.errors = run, core, tempfile.TemporaryFile("w+")
        self.failed: list[str] = []
        self.process = _spawn(self.errors)
        self.say(Job(str(run.directory), core, how).to_json())
        threading.Thread(target=self._listen, args=(queue,), daemon=True).start()

    def say(self, line: str) -> None:
        assert self.process.stdin is not None
        with suppress(OSError):  # it has ended already
            self.process.stdin.write(line + "\n")
            self.process.stdin.flush()

    def _listen(self, queue: Queue) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as answers:
            for line in answers:
                with suppress(ValueError):  # cut short by a kill
                    queue.put((self, events.from_json(line)))
        queue.put((self, None))

    def end(self, stopped: bool) -> str | None:
        """Why the run failed, once its process has ended; None if it did not."""
        code = self.process.wait()
        assert self.process.stdin is not None
        with suppress(OSError):  # what it never read is still in the buffer
            self.process.stdin.close()
        self.errors.seek(0)
        said = self.errors.read().strip().splitlines()
        self.errors.close()
        if self.failed:
            return self.failed[0]
        if code == 0 or (stopped and code in (130, 143)):
            return None
        how = "was stopped from outside" if code in (130, 143) else f"ended with code {code}"
        why = f" ({said[-1]})" if said and code not in (130, 143) else ""
        return f"{self.run.directory}: its process {how}{why}; resume it by train --resume."


def _spawn(errors: IO[str]) -> subprocess.Popen:
    return subprocess.Popen(
        WORKER,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=errors,
        text=True,
        start_new_session=True,  # Ctrl-C reaches the parent alone, which asks its children
    )


def _processes(runs: list[Run], how: Launch, stop: Callable[[], bool]) -> Iterator[events.Event]:
    """One process a core; the others continue where one fails."""
    free = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
    queue: Queue[tuple[_Child, events.Event | None]] = Queue()
    waiting = [(run, _with_code(run, how)) for run in runs]  # before any process is started
    active, asked = set[_Child](), False
    failed: list[str] = []
    try:
        while active or (waiting and not stop()):
            while waiting and free and not stop():
                run, own = waiting.pop(0)
                active.add(_Child(run, free.pop(0), own, queue))
                yield events.Started(*run.named)
            if stop() and not asked:
                asked = True
                for child in active:
                    child.say("stop")
            try:
                child, event = queue.get(timeout=POLL)
            except Empty:
                continue
            if event is not None and not isinstance(event, events.Failed):
                yield event
            elif event is not None:
                child.failed.append(event.says)
            else:
                active.remove(child)
                free.append(child.core)
                if said := child.end(asked):
                    failed.append(said)
                    yield events.Failed(*child.run.named, said)
    finally:
        for child in active:
            child.say("stop")
        for child in active:
            child.end(stopped=True)
    if failed:
        raise UserError(failed[0])


def reopened(job: Job) -> Run:
    """The run of a job, with the user's own code loaded where it needs some."""
    game = config.load_task(job.how.task) if job.how.task else None
    named = job.how.algorithm
    algorithm = config.load(named, AbstractAlgorithm) if named else None
    return Run.open(job.run, game, algorithm)


def _with_code(run: Run, how: Launch) -> Launch:
    """`how`, with the place of the user's code in this run for a process that must load it."""
    parts = {"task": run.trainer.game, "algorithm": run.trainer.algorithm}
    named = {"task": how.task, "algorithm": how.algorithm}
    found = {
        part: _place_of(obj, part, [named[part] or "", run.names.get(part, "")])
        for part, obj in parts.items()
    }
    return dataclasses.replace(how, **found)  # pyright: ignore[reportArgumentType]


def _place_of(obj: Any, part: str, named: list[str]) -> str | None:
    """path/to/file.py:Name of an object of the user's own; None where all of it is marlyap's."""
    code = config.code_of(obj, "")
    if code is None:
        return None
    for name in named:
        if ":" in name and os.path.isfile(name.rpartition(":")[0]):
            return name
    kind = type(obj).__name__
    if code["source"] is None or kind not in code["classes"] or "<" in type(obj).__qualname__:
        raise UserError(
            f"{part}: {kind} is code of your own that no other process can find; put it in a file "
            f"and name it, as in Launch({part}='path/to/file.py:{kind}'), or take parallel='vmap'."
        )
    return f"{code['source']}:{kind}"
