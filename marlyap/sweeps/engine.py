"""Where units are trained: what every engine offers, and the one of this machine."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from dataclasses import replace
from queue import Empty, Queue
from typing import NamedTuple, Protocol, runtime_checkable

from marlyap.errors import UserError
from marlyap.sweeps.unit import Unit


WORKER = (sys.executable, "-m", "marlyap.sweeps.worker")
MOST = 64  # units that a process trains before a fresh one takes its place


class Ended(NamedTuple):
    """A unit that is trained no longer."""

    unit: Unit
    says: str | None  # why its process ended, if it did so before the unit


@runtime_checkable
class Engine(Protocol):
    """Starts units, tells which have ended, stops them. The folder says what became of them."""

    @property
    def slots(self) -> int:
        """How many units it takes at once."""
        ...

    def start(self, unit: Unit) -> None:
        """Begin to train a unit; never called for more than `slots` at once."""
        ...

    def ended(self, seconds: float) -> list[Ended]:
        """Those that have ended since; waits for the first, but no longer than this."""
        ...

    def stop(self) -> None:
        """Let all that are trained save themselves and end; returns when they have."""
        ...


class Child:
    """A process that trains units. It ends when this process does, however that happens."""

    def __init__(self, core: int | None = None):
        self.core, self.unit, self.count = core, None, 0
        self.errors = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(
            WORKER,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            text=True,
            start_new_session=True,  # Ctrl-C reaches the parent alone, which asks its children
        )

    unit: Unit | None

    def train(self, unit: Unit) -> None:
        """Hand it a unit."""
        assert self.process.stdin is not None
        self.unit, self.count = replace(unit, core=self.core), self.count + 1
        with suppress(OSError):  # it has ended already, which is told by its output
            self.process.stdin.write(self.unit.to_json() + "\n")
            self.process.stdin.flush()

    def answer(self) -> bool:
        """Wait until the unit is done; False if the process ended instead."""
        assert self.process.stdout is not None
        return self.process.stdout.readline().endswith("\n")

    def ask(self) -> None:
        """Ask it to save and to end."""
        with suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGTERM)

    def close(self) -> str:
        """Wait for its end; says how it ended."""
        code = self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            with suppress(OSError):
                assert pipe is not None
                pipe.close()
        self.errors.seek(0)
        said = self.errors.read().strip().splitlines()
        self.errors.close()
        why = f" ({said[-1]})" if said and code not in (130, 143) else ""
        killed = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return f"its process {killed}{why}"


class Local:
    """One process a core of this machine, each for one unit after the other."""

    def __init__(self, slots: int | None = None):
        free = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
        cores = free or list(range(os.cpu_count() or 1))
        self.slots = slots or len(cores)
        pin = free is not None and self.slots <= len(cores)
        self.cores: list[int | None] = [*cores[: self.slots]] if pin else [None] * self.slots
        self.children: set[Child] = set()
        self.queue: Queue[tuple[Child, bool]] = Queue()

    def start(self, unit: Unit) -> None:
        idle = [child for child in self.children if child.unit is None]
        for child in [c for c in idle if c.count >= MOST]:
            idle.remove(child)
            child.ask()
            self._retire(child)
        child = idle[0] if idle else self._spawn()
        child.train(unit)

    def _spawn(self) -> Child:
        child = Child(self.cores.pop(0))
        self.children.add(child)
        threading.Thread(target=self._listen, args=(child,), daemon=True).start()
        return child

    def _listen(self, child: Child) -> None:
        with suppress(ValueError):  # closed meanwhile
            while child.answer():
                self.queue.put((child, True))
        self.queue.put((child, False))

    def _retire(self, child: Child) -> str:
        self.children.discard(child)
        self.cores.append(child.core)
        return child.close()

    def ended(self, seconds: float) -> list[Ended]:
        try:
            child, well = self.queue.get(timeout=seconds)
        except Empty:
            return []
        if child not in self.children:  # retired
            return []
        unit, child.unit = child.unit, None
        says = None if well else self._retire(child)
        return [Ended(unit, says)] if unit is not None else []

    def stop(self) -> None:
        for child in self.children:
            child.ask()
        for child in [*self.children]:
            self._retire(child)


def alone(text: str) -> str | None:
    """Train a unit in a process of its own, from wherever an engine calls this.

    Returns why the process ended, if it did so before the unit was done. The process saves and ends
    when this one is interrupted, and when it is killed.
    """
    child = Child()
    try:
        child.train(Unit.from_json(text))
        done = child.answer()
    finally:
        child.ask()
        says = child.close()
    return None if done else says


def missing(package: str, extra: str, what: str) -> UserError:
    """The sentence about a package that is not installed."""
    return UserError(
        f"{what} needs {package}; install it with pip install 'marlyap[{extra}]', or "
        f"pip install {package}."
    )
