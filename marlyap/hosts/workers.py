"""Copies divided among processes of their own; what they tell does not depend on how many."""

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from marlyap.errors import UserError
from marlyap.hosts.spec import AbstractHostGame, Array, Bounds, Fault, Layout, Side, Spec, fault
from marlyap.hosts.worker import REFUSED, RESET, STEP


COMMAND = (sys.executable, "-m", "marlyap.hosts.worker")
STARTING = 300.0  # seconds that a process may take to start


class Workers(AbstractHostGame):
    """`SideBySide` in so many processes, started anew and not forked."""

    def __init__(
        self, source: str, copies: int, workers: int, arguments: Mapping[str, Any], patience: float
    ):
        ends = [round(copies * k / workers) for k in range(workers + 1)]
        self.shares = [range(a, b) for a, b in zip(ends, ends[1:], strict=False)]
        self.patience, self.processes = patience, list[_Process]()
        try:
            for share in self.shares:
                about = {"source": source, "arguments": arguments}
                about |= {"first": share.start, "copies": len(share)}
                self.processes.append(_Process(about))
            self.made = [process.spec() for process in self.processes][0]
        except BaseException:
            self.close()
            raise
        self.layout = Layout(self.made)
        Bounds(self.made)  # refuses what has none
        self.rows = np.zeros((copies, self.layout.size), np.float32)
        self.time = np.zeros(copies, int)

    @property
    def spec(self):
        return self.made

    @property
    def copies(self):
        return len(self.rows)

    def reset(self, seed, episodes: Sequence[int]):
        order = lambda share: RESET + np.array([seed, *(episodes[c] for c in share)]).tobytes()
        self.time[:] = 0
        self._ask([order(share) for share in self.shares])
        told = self.layout.read(self.rows)
        return told.obs.copy(), told.state.copy()

    def step(self, action: Array):
        self.time += 1
        wide = np.ascontiguousarray(action, np.float32)
        self._ask([STEP + wide[share.start : share.stop].tobytes() for share in self.shares])
        told = self.layout.read(self.rows.copy())
        self.time[told.ended] = 0
        return told

    def close(self):
        for process in self.processes:
            process.end()
        self.processes = []

    def _ask(self, orders: Sequence[bytes]) -> None:
        """Order all at once, then read each copy's row."""
        for process, order in zip(self.processes, orders, strict=True):
            process.say(order)
        size = 4 * self.layout.size
        for process, share in zip(self.processes, self.shares, strict=True):
            for copy in share:
                row = self._row(process, copy, size)
                self.rows[copy] = np.frombuffer(row, np.float32)

    def _row(self, process: "_Process", copy: int, size: int) -> bytes:
        try:
            head = process.read(1, self.patience)
            if head == REFUSED:
                raise Fault(json.loads(process.line(self.patience)))
            return process.read(size, self.patience)
        except TimeoutError:
            what = f"it has not answered for {self.patience:g} s"
        except EOFError:
            what = f"its process ended ({process.last_words()})"
        raise fault(copy, int(self.time[copy]), what)


class _Process:
    """One worker and the pipes to it."""

    def __init__(self, about: Mapping[str, Any]):
        self.errors = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(
            COMMAND,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            start_new_session=True,  # Ctrl-C reaches the parent alone
            bufsize=0,
        )
        assert self.process.stdin is not None and self.process.stdout is not None
        self.orders, self.stream = self.process.stdin, self.process.stdout
        self.answers = self.stream.fileno()
        self.held = b""
        self.say(json.dumps(about).encode() + b"\n")

    def say(self, order: bytes) -> None:
        view = memoryview(order)
        with suppress(BrokenPipeError):  # reading tells what happened
            while view:
                view = view[self.orders.write(view) :]

    def spec(self) -> Spec:
        """The sizes that it tells. Raises UserError where it refuses."""
        try:
            told = json.loads(self.line(STARTING))
        except (EOFError, TimeoutError):
            raise UserError(f"workers: a process did not start ({self.last_words()}).") from None
        if "refused" in told:
            raise UserError(told["refused"])
        source, sides, state = told["spec"]
        made = tuple(Side(n, o, tuple(low), tuple(high)) for n, o, low, high in sides)
        return Spec(source, made, state)

    def read(self, size: int, patience: float) -> bytes:
        until = time.monotonic() + patience
        while len(self.held) < size:
            self._more(until)
        found, self.held = self.held[:size], self.held[size:]
        return found

    def line(self, patience: float) -> bytes:
        until = time.monotonic() + patience
        while b"\n" not in self.held:
            self._more(until)
        found, _, self.held = self.held.partition(b"\n")
        return found

    def _more(self, until: float) -> None:
        left = until - time.monotonic()
        if left <= 0 or not select.select([self.answers], [], [], left)[0]:
            raise TimeoutError
        more = os.read(self.answers, 1 << 20)
        if not more:
            raise EOFError
        self.held += more

    def last_words(self) -> str:
        """How it ended, and the last line that it wrote."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=10)
        code = self.process.poll()
        self.errors.seek(0)
        said = self.errors.read().strip().splitlines()
        how = "it still runs" if code is None else f"code {code}"
        return f"{how}: {said[-1][:160]}" if said else how

    def end(self) -> None:
        with suppress(OSError):
            self.orders.close()
        try:
            self.process.wait(timeout=2)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.stream.close()
        self.errors.close()
