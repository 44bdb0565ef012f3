"""A team of agents on a bus, and the simulator that moves them: in one process, or in many.

The simulator says what each robot's sensors measure and takes commands; it knows no policy. What
separates one process from many is `Stage`: how time passes, and how robots come and go.
"""

import queue
import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from marlyap.deploy import wire
from marlyap.deploy.agent import AS_TRAINED, Agent, Ways
from marlyap.deploy.bus import Bus, Hub, LocalBus
from marlyap.deploy.plant import coasted, step
from marlyap.deploy.runtime import Role
from marlyap.deploy.team import PIECE, distances
from marlyap.deploy.wire import Packet
from marlyap.errors import UserError, check_range


ANSWER = 20.0  # s until a team in step counts as broken
SETTLE = 0.05  # s before an episode, for what is under way


class Event(NamedTuple):
    """Something that happens to a robot in every episode."""

    robot: str
    at: float  # s since the start
    what: str  # kill, late (it joins then) or pause
    seconds: float = 0.0  # of a pause


@dataclass(frozen=True)
class Play:
    """How the team is driven."""

    lock: bool = False  # in step, with the integrator of training
    command_delay: float = 0.0  # s until a command acts
    events: tuple[Event, ...] = ()

    def __post_init__(self):
        check_range("command-delay", self.command_delay, 0, 10)


@dataclass
class Episode:
    """What happened in one episode."""

    x: np.ndarray  # [time, agent, state]
    goal: np.ndarray  # [agent, 2]
    alive: np.ndarray  # [agent], at the end
    edge: float
    delays: list[float] = field(default_factory=list)  # s, from a state to its command
    fallbacks: int = 0
    missed: int = 0  # ticks without a command of a robot that is there

    @property
    def final(self) -> np.ndarray:
        """Distances at the end [agent] (m)."""
        return distances(self.x[-1], self.goal)

    @property
    def success(self) -> bool:
        """Whether all that are alive have arrived."""
        return bool(np.all(self.final[self.alive] <= self.edge))


class Stage(ABC):
    """Where the team plays. `said` is what each robot measured of itself, known at the end."""

    bus: Bus
    said: dict[str, Any]

    @abstractmethod
    def now(self) -> float:
        """Seconds that only grow."""

    @abstractmethod
    def until(self, moment: float, ready: Callable[[], bool] | None = None) -> None:
        """Let time pass until `moment`, or until `ready`, which is asked now and then."""

    @abstractmethod
    def kill(self, robot: str) -> None:
        """End a robot without a word."""

    @abstractmethod
    def pause(self, robot: str, paused: bool) -> None:
        """Hold a robot, or let it go on."""

    @abstractmethod
    def gather(self, robots: Sequence[str]) -> None:
        """See to it that these robots are there."""

    @abstractmethod
    def close(self) -> None:
        """End all."""


class Simulator:
    """Integrates the robots' motion. Its clock is the stage's; a robot never sees it."""

    def __init__(self, contract: dict[str, Any], robots: list[Role], stage: Stage, team: str):
        self.contract, self.robots, self.stage, self.team = contract, robots, stage, team
        self.names = [r.role["name"] for r in robots]
        self.period = contract["timing"]["period"]
        self.session = secrets.randbits(32)
        self.inbox: queue.SimpleQueue[tuple[str, bytes, float]] = queue.SimpleQueue()
        put = lambda key, payload: self.inbox.put((key, payload, stage.now()))
        stage.bus.on(wire.key(team, "*", wire.COMMAND), put)
        self.inputs = len(contract["action"]["channels"])

    def episode(self, number: int, x: np.ndarray, goal: np.ndarray, play: Play) -> Episode:
        """One episode from x [agent, state] to goal [agent, 2].

        Raises UserError where a team in step does not answer.
        """
        late = {e.robot: e.at for e in play.events if e.what == "late"}
        self.stage.gather(self.names)
        self.number, self.start = number, self.stage.now() + SETTLE
        self.stage.until(self.start)
        self.commands: list[list[tuple[float, np.ndarray]]] = [[] for _ in self.names]
        self.sent: dict[tuple[str, int], float] = {}
        done = Episode(x[None], goal, np.ones(len(x), bool), self.contract["domain"]["edge"])
        todo, seen = sorted(timeline(play.events), key=lambda e: e[0]), [x]
        for tick in range(self.contract["domain"]["horizon"]):
            there = [late.get(name, 0.0) <= tick * self.period + 1e-9 for name in self.names]
            there = [a and bool(b) for a, b in zip(there, done.alive, strict=True)]
            self._measure(tick, x, goal, there)
            if play.lock:
                x, todo = self._in_step(tick, x, there, todo, done)
            else:
                x, todo = self._in_time(tick, x, play, todo, done)
            seen.append(x)
        done.x = np.stack(seen)
        return done

    def _measure(self, tick: int, x: np.ndarray, goal: np.ndarray, there: list[bool]) -> None:
        for i, (name, robot) in enumerate(zip(self.names, self.robots, strict=True)):
            if not there[i]:
                continue
            self.sent[name, tick] = self.stage.now()
            for what, numbers in ((wire.GOAL, goal[i]), (wire.ODOMETRY, x[i])):
                if what == wire.ODOMETRY or robot.leads:
                    packet = Packet(self.session, self.number, tick, False, numbers)
                    self.stage.bus.put(wire.key(self.team, name, what), wire.pack(packet))

    def _take(self, done: Episode) -> None:
        """The commands that have come."""
        while not self.inbox.empty():
            key, payload, arrived = self.inbox.get()
            name, packet = wire.robot_of(key), wire.unpack(payload, self.inputs)
            if packet is None or packet.episode != self.number or name not in self.names:
                continue
            self.commands[self.names.index(name)].append((arrived, packet.numbers))
            done.fallbacks += packet.flag
            if (name, packet.tick) in self.sent:
                done.delays.append(arrived - self.sent.pop((name, packet.tick)))

    def _in_step(
        self, tick: int, x: np.ndarray, there: list[bool], todo: list[Any], done: Episode
    ) -> tuple[np.ndarray, list[Any]]:
        """Wait for every robot, then one step of training."""
        todo = self._happen(tick * self.period, todo, done)

        def answered() -> bool:
            self._take(done)
            waits = zip(self.names, there, done.alive, strict=True)
            return not any((n, tick) in self.sent and t and a for n, t, a in waits)

        self.stage.until(self.stage.now() + ANSWER, answered)
        if not answered():
            silent = [n for n in self.names if (n, tick) in self.sent]
            raise UserError(f"swarm: {', '.join(silent)} did not answer within {ANSWER:g} s.")
        u = [self._acting(i, x, np.inf) for i in range(len(x))]
        return step(self.contract["plant"], x, np.stack(u), self.period), todo

    def _in_time(
        self, tick: int, x: np.ndarray, play: Play, todo: list[Any], done: Episode
    ) -> tuple[np.ndarray, list[Any]]:
        """A period by the clock, in pieces, with the commands that have come by then."""
        pieces = max(1, round(self.period / PIECE))
        dt, plant = self.period / pieces, self.contract["plant"]
        u = np.zeros((len(x), self.inputs))
        for k in range(pieces):
            at = tick * self.period + k * dt
            self.stage.until(self.start + at)
            todo = self._happen(at, todo, done)
            self._take(done)
            now = self.stage.now() - play.command_delay
            u = np.stack([self._acting(i, x, now) for i in range(len(x))])
            x = coasted(plant, x, u, dt, 1)
        if plant["kind"] == "LateUnicycle":
            x[:, 5:] = u
        done.missed += sum((name, tick) in self.sent for name in self.names)
        return x, todo

    def _acting(self, i: int, x: np.ndarray, now: float) -> np.ndarray:
        """The command that acts on robot i; its drive brakes where none has come for too long."""
        oldest = self.contract["timing"]["max_neighbour_age"]
        came = [c for c in self.commands[i] if c[0] <= now]
        self.commands[i] = came[-1:] + [c for c in self.commands[i] if c[0] > now]
        if came and (now == np.inf or now - came[-1][0] <= oldest):
            return came[-1][1]
        return self.robots[i].fallback(x[i])

    def _happen(self, at: float, todo: list[Any], done: Episode) -> list[Any]:
        """The events that are due."""
        while todo and todo[0][0] <= at + 1e-9:
            _, what, name = todo.pop(0)
            if what == "kill":
                self.stage.kill(name)
                done.alive[self.names.index(name)] = False
                self.commands[self.names.index(name)].clear()
            else:
                self.stage.pause(name, what == "pause")
        return todo


def timeline(events: Sequence[Event]) -> Iterator[tuple[float, str, str]]:
    """When something has to be done, what, and to whom."""
    for event in events:
        if event.what != "late":  # who joins late only hears nothing until then
            yield event.at, event.what, event.robot
        if event.what == "pause":
            yield event.at + event.seconds, "resume", event.robot


class Together(Stage):
    """All in one process, in a time of its own: for tests, and to try a bundle without zenoh."""

    def __init__(
        self, robots: list[Role], team: str, ways: Ways = AS_TRAINED, hub: Hub | None = None
    ):
        self.hub, self.time = hub or Hub(), 0.0
        self.bus, self.team, self.ways = LocalBus(self.hub), team, ways
        self.robots = {r.role["name"]: r for r in robots}
        self.agents: dict[str, Agent] = {}
        self.said: dict[str, Any] = {}
        self.paused: set[str] = set()
        self.gather([*self.robots])

    def now(self):
        return self.time

    def until(self, moment, ready=None):
        while True:
            for name, agent in list(self.agents.items()):
                if name not in self.paused:
                    agent.poll()
            if (ready and ready()) or self.time >= moment:
                return
            self.time = min(moment, self.time + PIECE)

    def kill(self, robot):
        self.agents.pop(robot).bus.close()

    def pause(self, robot, paused):
        (self.paused.add if paused else self.paused.discard)(robot)

    def gather(self, robots):
        self.paused.clear()
        for name in robots:
            if name not in self.agents:
                bus = LocalBus(self.hub)
                self.agents[name] = Agent(self.robots[name], bus, self.team, self.ways, self.now)

    def close(self):
        for name, agent in list(self.agents.items()):
            self.said[name] = {"ages": dict(agent.ages), "fallbacks": agent.fallbacks}
            self.kill(name)
        self.bus.close()
