"""The loop that gives units to an engine until the folder says that nothing is left to do."""

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, runtime_checkable

from marlyap.runs.job import Launch
from marlyap.storage import store
from marlyap.sweeps.engine import Ended, Engine
from marlyap.sweeps.folder import Sweep
from marlyap.sweeps.jobs import OVER, Job, Status, status
from marlyap.sweeps.unit import Unit


WAIT, LOOK = 0.2, 1.0  # seconds: for an engine; between two looks at the folder
SHARE = 0.1  # of the time that looks may take
TOGETHER = 64  # jobs in one program, at most
DEATHS = 3  # of its process, with nothing saved in between, until a job has failed


@runtime_checkable
class Source(Protocol):
    """Says which jobs come next."""

    def take(self) -> list[Job]:
        """Jobs to be trained; [] where there is none now."""
        ...

    def look(self, statuses: Sequence[Status]) -> None:
        """What the folder says now."""
        ...

    @property
    def exhausted(self) -> bool:
        """Whether there will never be another."""
        ...


class Listed:
    """All jobs of a plan, in its order."""

    def __init__(self, sweep: Sweep):
        self.waiting = deque(sweep.jobs)

    def take(self) -> list[Job]:
        return [self.waiting.popleft()] if self.waiting else []

    def look(self, statuses: Sequence[Status]) -> None:
        return

    @property
    def exhausted(self) -> bool:
        return not self.waiting


def drive(
    sweep: Sweep,
    engine: Engine,
    source: Source,
    how: Launch,
    stop: Callable[[], bool] = lambda: False,
    retry: bool = False,
) -> Iterator[list[Status]]:
    """Train what is not over; yields what the folder says about once a second, and at the end.

    What is held by another process is waited for. With `retry` failed jobs are tried again.
    Raises UserError where another process drives this sweep.
    """
    with store.lock(sweep.directory):
        if retry:
            for job in sweep.jobs:
                job.beside("failed").unlink(missing_ok=True)
        yield from _Driver(sweep, engine, source, how).run(stop)


class _Driver:
    def __init__(self, sweep: Sweep, engine: Engine, source: Source, how: Launch):
        self.sweep, self.engine, self.source, self.how = sweep, engine, source, how
        self.again: deque[tuple[float, Job]] = deque()  # when to look at it again
        self.ready: deque[Job] = deque()
        self.active, self.deaths = set[str](), dict[str, tuple[int, int]]()
        self.seen: list[Status] = []

    def run(self, stop: Callable[[], bool]) -> Iterator[list[Status]]:
        """Until all is over or `stop()`; whatever happens, nothing is left running here."""
        looked = -LOOK
        try:
            while not self.over(stop()):
                if not stop():
                    self.fill()
                for ended in self.engine.ended(WAIT):
                    self.end(ended, stop())
                if stop():
                    break
                if time.monotonic() - looked > max(LOOK, self.cost):
                    yield self.look()
                    looked = time.monotonic()
        finally:
            self.engine.stop()
        yield self.look()

    cost = 0.0  # seconds until the next look, so that looking takes its share and no more

    def look(self) -> list[Status]:
        start = time.monotonic()
        self.seen = self.sweep.statuses(self.seen)
        self.source.look(self.seen)
        self.cost = (time.monotonic() - start) / SHARE
        return self.seen

    def over(self, stopped: bool) -> bool:
        return stopped or not (self.active or self.ready or self.again or not self.source.exhausted)

    def fill(self) -> None:
        """Give the engine as many units as it takes."""
        while len(self.active) < self.engine.slots and (job := self._next()):
            unit = Unit(tuple(self._with(job)), self.how, self.sweep.plan.evaluate)
            self.active.add(unit.name)
            self.engine.start(unit)

    def _next(self) -> Job | None:
        """A job that is neither over nor trained by somebody else."""
        while True:
            while self.again and self.again[0][0] <= time.monotonic():
                self.ready.append(self.again.popleft()[1])
            self.ready.extend([] if self.ready else self.source.take())
            if not self.ready:
                return None
            job = self.ready.popleft()
            state = status(job).state
            if state == "running":
                self.again.append((time.monotonic() + LOOK, job))
            elif state not in OVER:
                return job

    def _with(self, first: Job) -> Iterator[Job]:
        """The job, and others of the same program where they share one."""
        yield first
        count = 1
        while self.how.parallel == "vmap" and count < TOGETHER and (job := self._next()):
            if job.cell.program != first.cell.program:
                self.ready.appendleft(job)
                return
            count += 1
            yield job

    def end(self, ended: Ended, stopped: bool) -> None:
        """Take up again what was cut short; give up what ends its process again and again."""
        self.active.discard(ended.unit.name)
        for job in ended.unit.jobs:
            now = status(job)
            if now.state in OVER or stopped:
                continue
            if now.state == "running":  # by somebody else
                self.again.append((time.monotonic() + LOOK, job))
            elif self._gets_nowhere(now):
                what = ended.says or "its process did not train it"
                job.directory.parent.mkdir(parents=True, exist_ok=True)
                says = f"{job.directory}: {what}, {DEATHS} times in a row.\n"
                store.write_text_atomic(job.beside("failed"), says)
            else:
                self.ready.append(job)

    def _gets_nowhere(self, now: Status) -> bool:
        """Whether it ended early DEATHS times in a row, no further than the time before."""
        count, at = self.deaths.get(now.job.name, (0, -1))
        count = count + 1 if now.iteration <= at else 1
        self.deaths[now.job.name] = (count, now.iteration)
        return count >= DEATHS
