"""A stage whose robots are processes of this machine, on zenoh."""

import json
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from marlyap.deploy import wire
from marlyap.deploy.agent import AS_TRAINED, Ways
from marlyap.deploy.bus import ZenohBus
from marlyap.deploy.swarm import Stage
from marlyap.errors import UserError


UP = 60.0  # s until a robot counts as one that does not start
MEET = 0.5  # s after the last has come, for them to find each other
POLL = 0.0005  # s
LAST = 5.0  # s that robots get to say what they measured


class Processes(Stage):
    """One process a robot: `marlyap agent BUNDLE ROLE`.

    Raises UserError where zenoh is missing, or where a robot does not start.
    """

    def __init__(self, bundle: Path, robots: Sequence[str], team: str, ways: Ways = AS_TRAINED):
        self.bundle, self.team, self.ways = bundle, team, ways
        ports = free_ports(1 + len(robots))
        ends = [f"tcp/127.0.0.1:{port}" for port in ports]
        self.ends = dict(zip(robots, ends[1:], strict=True))
        self.here = ends[0]
        self.bus = ZenohBus(listen=[ends[0]])
        self.running: dict[str, subprocess.Popen[str]] = {}
        self.said: dict[str, Any] = {}
        self.there: queue.SimpleQueue[tuple[str, bool]] = queue.SimpleQueue()
        self.alive: set[str] = set()
        self.words = tempfile.TemporaryFile("w+")
        self.bus.watch(wire.key(team, "*", wire.ALIVE), self._hear)
        self.bus.on(wire.key(team, "*", wire.FIGURES), self._figures)

    def _hear(self, key: str, there: bool) -> None:
        self.there.put((wire.robot_of(key), there))

    def _figures(self, key: str, payload: bytes) -> None:
        self.said[wire.robot_of(key)] = json.loads(payload)

    def now(self):
        return time.monotonic()

    def until(self, moment, ready=None):
        while (rest := moment - time.monotonic()) > 0:
            if ready is not None and ready():
                return
            time.sleep(rest if ready is None else min(rest, POLL))

    def kill(self, robot):
        process = self.running.pop(robot)
        process.kill()
        process.wait()

    def pause(self, robot, paused):
        if robot in self.running:
            self.running[robot].send_signal(signal.SIGSTOP if paused else signal.SIGCONT)

    def gather(self, robots):
        new = [name for name in robots if name not in self.running]
        for name in new:
            self._start(name)
        if not new:
            return
        latest = time.monotonic() + UP
        gone = set(new)  # of those that were killed the token may still be falling
        while gone and time.monotonic() < latest:
            try:
                name, there = self.there.get(timeout=0.2)
            except queue.Empty:
                self._broken()
                continue
            (gone.discard if there else gone.add)(name)
            gone &= set(new)
        if gone:
            raise UserError(f"swarm: {', '.join(sorted(gone))} did not start within {UP:g} s.")
        time.sleep(MEET)

    def _start(self, name: str) -> None:
        others = [end for robot, end in self.ends.items() if robot != name]
        w = self.ways
        words = [sys.executable, "-m", "marlyap", "agent", str(self.bundle), name]
        words += ["--team", self.team, "--listen", self.ends[name]]
        words += ["--connect", self.here, *others, "--end-with-input", "--silent", w.silent]
        words += ["--lock"] if w.lock else []
        for option in ("wait", "loss", "delay", "jitter", "seed"):
            words += [f"--{option}", str(getattr(w, option))]
        self.running[name] = subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self.words,
            text=True,
            start_new_session=True,  # Ctrl-C is ours; they end with their input
        )

    def _broken(self) -> None:
        """Raise UserError if a robot ended by itself, with its last words."""
        for name, process in self.running.items():
            if process.poll() is not None:
                self.words.seek(0)
                said = (self.words.read().strip().splitlines() or ["no reason given"])[-1]
                raise UserError(f"swarm: {name} ended: {said.removeprefix('marlyap: ')}")

    def close(self):
        self.bus.put(wire.key(self.team, wire.ALL, wire.STOP), b"")
        latest = time.monotonic() + LAST
        while self.running and time.monotonic() < latest and set(self.said) < set(self.running):
            time.sleep(0.01)
        for process in self.running.values():
            process.kill()
            process.wait()
        self.running.clear()
        self.bus.close()
        self.words.close()


def free_ports(count: int) -> list[int]:
    """Ports of this machine that nobody listens on now."""
    sockets = [socket.socket() for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports
