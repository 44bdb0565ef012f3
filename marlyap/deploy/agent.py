"""One robot of a team: hears its own sensors and its neighbours, says where it is, commands.

No time of another machine enters: how old something is follows from when it arrived here, by the
clock of this process.
"""

import json
import queue
import random
import secrets
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from marlyap.deploy import wire
from marlyap.deploy.bus import Bus
from marlyap.deploy.runtime import Role, at_rest
from marlyap.deploy.wire import Packet
from marlyap.errors import UserError, check_range


Silent = Literal["hold", "absent"]
REPEAT = 0.1  # s
LATEST = 64  # messages of one neighbour that may be on their way at once


@dataclass(frozen=True)
class Ways:
    """How a robot listens, and what is to go wrong with what its neighbours send."""

    lock: bool = False  # wait for every neighbour, as a team in step does
    wait: float = 0.3  # periods to wait for this tick's messages; later it acts on what it has
    silent: Silent = "hold"  # what a silent neighbour becomes
    loss: float = 0.0  # probability that a neighbour's message is lost
    delay: float = 0.0  # s that a neighbour's message takes longer
    jitter: float = 0.0  # s, and up to so much more
    seed: int = 0  # of the losses and the jitter

    def __post_init__(self):
        check_range("loss", self.loss, 0, 1)
        check_range("wait", self.wait, 0, 100)
        check_range("delay", self.delay, 0, 60)
        check_range("jitter", self.jitter, 0, 60)
        if self.silent not in ("hold", "absent"):
            raise UserError(f"silent: '{self.silent}' must be hold or absent.")


AS_TRAINED = Ways()


class Agent:
    """A robot on a bus. Call `poll` when something has come, or at the time it asks for.

    Arguments: robot, of the bundle; bus; team, its name on the bus; clock, seconds that only
    grow; nobody else's clock matters.
    """

    def __init__(
        self,
        robot: Role,
        bus: Bus,
        team: str,
        ways: Ways = AS_TRAINED,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.robot, self.bus, self.team, self.ways, self.clock = robot, bus, team, ways, clock
        self.name, timing = robot.role["name"], robot.contract["timing"]
        self.wait = ways.wait * timing["period"]
        self.oldest, self.period = timing["max_neighbour_age"], timing["period"]
        self.reach = robot.contract["sight"]["reach"]
        self.neighbours = [n for n in robot.role["neighbours"] if n is not None]
        self.session, self.stopped = secrets.randbits(32), False
        self.random = random.Random(f"{ways.seed} {self.name}")
        self.inbox: queue.SimpleQueue[tuple[str, bytes, float]] = queue.SimpleQueue()
        self.own: tuple[Packet, float] | None = None
        self.goal: tuple[Packet, float] | None = None
        self.heard: dict[str, tuple[Packet, float]] = {}
        self.coming: list[tuple[float, str, Packet]] = []
        self.told = self.answered = (-1, -1)
        self.repeat = 0.0  # when a team in step says again where it is
        self.ages: Counter[str] = Counter()
        self.fallbacks = 0
        self.began: tuple[float, float] | None = None  # wall and processor seconds at its start
        self._listen()

    def _listen(self) -> None:
        put = lambda key, payload: self.inbox.put((key, payload, self.clock()))
        mine = [(self.name, wire.ODOMETRY), (wire.ALL, wire.STOP)]
        mine += [(self.name, wire.GOAL)] if self.robot.leads else []
        for robot, what in mine + [(n, wire.MESSAGE) for n in self.neighbours]:
            self.bus.on(wire.key(self.team, robot, what), put)
        self.bus.alive(wire.key(self.team, self.name, wire.ALIVE))

    def poll(self) -> float | None:
        """Take what has come, answer if it is time; returns when to look again at the latest."""
        while not self.inbox.empty():
            self._take(*self.inbox.get())
        now = self.clock()
        self._arrive(now)
        soon = [at for at, _, _ in self.coming]
        if self.own is None:
            return min(soon, default=None)
        packet, arrived = self.own
        if self.told < _when(packet) or (self.ways.lock and now >= self.repeat):
            self._say(wire.MESSAGE, packet, self.robot.message(packet.numbers))
            self.told, self.repeat = _when(packet), now + REPEAT
        latest = self.repeat if self.ways.lock else arrived + self.wait
        if _when(packet) <= self.answered:
            return min([latest, *soon]) if self.ways.lock else min(soon, default=None)
        there = all(self._at(name, packet) for name in self.neighbours)
        if there or (not self.ways.lock and now >= latest):
            self._answer(packet, now - arrived, now)
        return min([latest, *soon])

    def run(self, ended: Callable[[], bool] = lambda: False) -> None:
        """Be this robot until the team is stopped, or `ended`, which is asked now and then."""
        while not self.stopped and not ended():
            until = self.poll()
            rest = 0.5 if until is None else max(0.0, until - self.clock())
            try:
                first = self.inbox.get(timeout=min(rest, 0.5)) if rest else self.inbox.get_nowait()
            except queue.Empty:
                continue
            self._take(*first)
        self.bus.put(wire.key(self.team, self.name, wire.FIGURES), self.figures())
        time.sleep(0.05)  # let it leave

    def figures(self) -> bytes:
        """What this robot measured of itself, as JSON."""
        wall, used = self.began or (time.monotonic(), time.process_time())
        said = {"ages": dict(self.ages), "fallbacks": self.fallbacks, "peak_mb": peak()}
        said |= {"wall_s": time.monotonic() - wall, "cpu_s": time.process_time() - used}
        return json.dumps(said).encode()

    def _take(self, key: str, payload: bytes, arrived: float) -> None:
        robot, what = wire.robot_of(key), wire.what_of(key)
        if what == wire.STOP:
            self.stopped = True
            return
        states, tells = len(self.robot.contract["state"]), self.robot.tells
        count = {wire.ODOMETRY: states, wire.GOAL: 2, wire.MESSAGE: tells}
        packet = wire.unpack(payload, count[what])
        if packet is None:
            return
        if what == wire.ODOMETRY:
            if packet.follows(self.own and self.own[0]):
                self.began = self.began or (time.monotonic(), time.process_time())
                self.own = packet, arrived
                if self.answered[0] != packet.episode:
                    self.answered = self.told = (packet.episode, -1)
        elif what == wire.GOAL:
            self.goal = packet, arrived
        elif self.random.random() >= self.ways.loss and len(self.coming) < LATEST * 8:
            late = self.ways.delay + self.ways.jitter * self.random.random()
            self.coming.append((arrived + late, robot, packet))

    def _arrive(self, now: float) -> None:
        """What was under way, and should have arrived by now."""
        due = sorted((c for c in self.coming if c[0] <= now), key=lambda c: c[0])
        self.coming = [c for c in self.coming if c[0] > now]
        for at, robot, packet in due:
            sound = bool(np.isfinite(packet.numbers).all())
            last = self.heard.get(robot)
            if sound and packet.follows(last and last[0]):
                self.heard[robot] = packet, at

    def _at(self, name: str, own: Packet) -> bool:
        """Whether the neighbour has told where it is at this tick."""
        last = self.heard.get(name)
        return last is not None and _when(last[0]) >= _when(own)

    def _answer(self, own: Packet, age: float, now: float) -> None:
        shape = self.robot.slots, self.robot.tells
        messages, present = np.zeros(shape, np.float32), np.zeros(shape[0], bool)
        for k, name in enumerate(self.robot.role["neighbours"]):
            last = self.heard.get(name) if name else None
            if last is not None and last[0].episode == own.episode:
                messages[k], present[k] = self._seen(last[0], now - last[1], own)
            elif name:
                self.ages["never"] += 1
        goal = self.goal and self.goal[0].episode == own.episode and self.goal[0].numbers
        given = goal if isinstance(goal, np.ndarray) else None
        own_age = 0.0 if self.ways.lock else age
        u, fallback = self.robot.command(own.numbers, given, messages, present, own_age)
        self.fallbacks += bool(fallback)
        self.answered = _when(own)
        self._say(wire.COMMAND, own, u, bool(fallback))

    def _seen(self, packet: Packet, age: float, own: Packet) -> tuple[np.ndarray, bool]:
        """What a message counts for, and whether it counts."""
        behind = own.tick - packet.tick
        old = behind * self.period > self.oldest if self.ways.lock else age > self.oldest
        self.ages["old" if old else str(max(0, behind))] += 1
        message = at_rest(packet.numbers) if old else packet.numbers
        present = not (old and self.ways.silent == "absent")
        if self.reach is not None:
            gap = np.linalg.norm(message[:2] - own.numbers[:2])
            present = present and bool(gap <= self.reach)
        return message, present

    def _say(self, what: str, now: Packet, numbers: np.ndarray, flag: bool = False) -> None:
        packet = Packet(self.session, now.episode, now.tick, flag, numbers)
        self.bus.put(wire.key(self.team, self.name, what), wire.pack(packet))


def _when(packet: Packet) -> tuple[int, int]:
    return packet.episode, packet.tick


def peak() -> float | None:
    """The most memory this process has had (MB), where Linux tells."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    line: Any = next((x for x in status.read_text().splitlines() if x.startswith("VmHWM")), None)
    return int(line.split()[1]) / 1024 if line else None
