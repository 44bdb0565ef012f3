"""The host loop over compiled iterations: progress, log, checkpoints, stopping."""

import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from marlyap.compute.cache import enable_cache
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.algorithms import ALGORITHMS
from marlyap.learning.health import Health, TaskFault
from marlyap.learning.schedule import Schedule
from marlyap.learning.trainer import Trainer, schedule_for
from marlyap.learning.training import AbstractTrainer, Carry, row, stack, stacked
from marlyap.nets.nets import LyapunovNet, NormNet
from marlyap.runs import config, events
from marlyap.runs.progress import show
from marlyap.runs.run import Run, begin, sound
from marlyap.runs.sinks import Sinks
from marlyap.simulation.rollout import Decentralised, Policy
from marlyap.storage import store
from marlyap.tasks import TASKS


SHARE = 0.02  # of the training time that checkpoints may take
PATIENCE = 20.0  # seconds between checkpoints at least


class Diverged(UserError):
    """A number stopped being finite; the last checkpoint is sound."""


def fit(
    runs: list[Run],
    stop: Callable[[], bool] = lambda: False,
    attempts: int = 1,
    log: Sequence[str] = (),
) -> Iterator[events.Event]:
    """Train `runs` to the end, or until `stop()`; yields a Progress for each run and iteration.

    Several runs must differ in their seeds, and in numbers that their programs are given
    (`learning.traced`), alone; they advance together under `vmap`. Everything
    is saved at the end and when stopped, so that calling this again resumes bit for bit. A run in
    which a number stops being finite is stopped, the others continue; with more `attempts` it is
    taken up again, from its last checkpoint and with other random numbers. `log` names trackers
    that are told the log as well.
    Raises Diverged (a UserError) if this was so in every run to the last.
    """
    with ExitStack() as held:
        for run in runs:
            held.enter_context(store.lock(run.directory))
            store.sweep(run.directory)
        yield from _fit(runs, stop, attempts, log)


def _fit(
    runs: list[Run], stop: Callable[[], bool], attempts: int, log: Sequence[str]
) -> Iterator[events.Event]:
    """Train the runs that stand at the same iteration together, one such group after the other.

    A damaged checkpoint or a fault may have thrown one run further back than the others.
    """
    faults: dict[int, Diverged] = {}
    for attempt in range(attempts):
        loaded = [_Loaded(run, *run.load()) for run in runs if not attempt or run.seed in faults]
        for one in loaded:
            one.run.rewind(one.iteration)
            yield from (events.Warned(*one.run.named, w) for w in one.warnings)
        faults = {}
        for _, group in groupby(sorted(loaded, key=_iteration), key=_iteration):
            going = [one.reseeded(attempt) for one in group]
            with ExitStack() as told:
                sinks = [told.enter_context(closing(one.run.sinks(log))) for one in going]
                faults |= yield from _together(going, sinks, stop)
        if not faults or stop():
            break
        if attempt + 1 < attempts:
            told = f"going on from the last checkpoint with other random numbers ({attempt + 1})"
            yield from (events.Warned(*r.named, told) for r in runs if r.seed in faults)
    if len(faults) == len(runs):
        raise next(iter(faults.values()))


class _Loaded(NamedTuple):
    """A run and what its newest sound checkpoint holds."""

    run: Run
    carry: Carry
    seconds: float
    warnings: tuple[str, ...]

    @property
    def iteration(self) -> int:
        return int(self.carry.iteration)

    def reseeded(self, attempt: int) -> "_Loaded":
        """With other random numbers from here on, unless this is the first attempt."""
        if not attempt:
            return self
        key = jax.random.fold_in(self.carry.key, attempt)
        return self._replace(carry=eqx.tree_at(lambda c: c.key, self.carry, key))


def _iteration(loaded: _Loaded) -> int:
    return loaded.iteration


def _together(
    loaded: list[_Loaded], sinks: list[Sinks], stop: Callable[[], bool]
) -> Generator[events.Event, None, dict[int, Diverged]]:
    """Train runs that stand at the same iteration; returns why, for each seed that was stopped."""
    faults: dict[int, Diverged] = {}
    runs, trainer = [one.run for one in loaded], loaded[0].run.trainer
    given = stacked([run.trainer for run in runs])
    first = carry = stack([one.carry for one in loaded])
    before, clock = max(one.seconds for one in loaded), time.monotonic()
    saved, alive = _Saved(clock), [True] * len(runs)

    for done, carry, told in given.advance(first, stop):
        seconds = before + time.monotonic() - clock
        for i, run in enumerate(runs):
            line = _line(trainer, run.seed, done, seconds, told.log, i)
            fault = _fault(line, told.health_of(i), trainer.agents)
            if fault and alive[i]:
                alive[i] = False
                where = None if fault.by_task else run.trainer.diagnose(run.load()[0], done)
                says = f"{fault.says(where)} in {run.directory}."
                faults[run.seed] = Diverged(says)
                yield events.Diverged(*run.named, done, fault.name, says)
                if not any(alive):
                    return faults
            if alive[i]:
                sinks[i].line(run.log(line))
                yield events.Progress(*run.named, line, trainer.iterations)
        if saved.due():
            yield from saved.save(runs, carry, alive, seconds)
    yield from saved.save(runs, carry, alive, before + time.monotonic() - clock)
    return faults


@dataclass(frozen=True)
class Trained:
    """What training in memory leaves: the policy, its Lyapunov function if any, and the log."""

    policy: Policy
    lyapunov: LyapunovNet | NormNet | None
    game: AbstractGame
    history: list[dict[str, Any]]
    trainer: Trainer
    seed: int
    carry: Carry  # all of it, so that it can be saved and resumed

    @property
    def controller(self) -> Decentralised:
        """The policy as a controller of its game, to be evaluated or certified."""
        return Decentralised(self.policy, self.game)

    def save(self, directory: Path | str) -> Run:
        """Write a run directory, as `marlyap train` does: to be evaluated, reported and certified.

        Raises UserError where there is something already.
        """
        parts = {"task": (self.game, TASKS), "algorithm": (self.trainer.algorithm, ALGORITHMS)}
        names = {part: _called(*found) for part, found in parts.items()} | {"preset": "tuned"}
        run = Run.create(directory, self.trainer, self.seed, names)
        with store.lock(run.directory):
            for line in self.history:
                run.log(line)
            run.sinks().close()
            run.save(self.carry, self.history[-1]["seconds"])
        return run


def _called(thing: Any, table: Mapping[str, Any]) -> str:
    """The name of a task or algorithm in its table, else that of its class."""
    same = lambda o: type(o) is type(thing) and config.record(o) == config.record(thing)
    return next((name for name, o in table.items() if same(o)), type(thing).__name__)


def train(
    game: AbstractGame | str,
    algorithm: AbstractAlgorithm | str,
    schedule: Schedule | None = None,
    seed: int = 0,
    on_iteration: Callable[[dict[str, Any]], None] | None = None,
    progress: bool = True,
) -> Trained:
    """Train one team in memory; nothing is written until `Trained.save`.

    Game and algorithm may be names of `marlyap list`, or path/to/file.py:Name. Without a schedule,
    the tuned one for this algorithm. `on_iteration` is given one dict an iteration. With
    `progress`, a terminal or notebook shows a bar. Compiled programs are kept for the next start
    (`cache.enable_cache`).

    Raises UserError for what cannot be trained, and Diverged (a UserError) when a number stops
    being finite.
    """
    enable_cache(programs=True)
    game = config.load(game, AbstractGame) if isinstance(game, str) else game
    if isinstance(algorithm, str):
        algorithm = config.load(algorithm, AbstractAlgorithm)
    sound(game)
    trainer = Trainer(game, algorithm, schedule or schedule_for(algorithm))
    last: list[Carry] = []
    history = []

    def happening() -> Iterator[events.Event]:
        yield events.Started("", seed)
        clock = time.monotonic()
        first = stack([begin(trainer, seed)])
        for done, carry, told in trainer.advance(first):
            last[:] = [carry]
            line = _line(trainer, seed, done, time.monotonic() - clock, told.log, 0)
            if fault := _fault(line, told.health_of(0), game.agents):
                raise Diverged(f"{fault.says()}.")
            history.append(line)
            if on_iteration:
                on_iteration(history[-1])
            yield events.Progress("", seed, history[-1], trainer.iterations)

    if progress:
        show(happening(), plain=False)
    else:
        for _ in happening():
            pass
    carry = row(last[0], 0)
    lyapunov = algorithm.lyapunov(algorithm.networks(carry.learner))
    return Trained(carry.best, lyapunov, game, history, trainer, seed, carry)


class _Saved:
    """When the last checkpoint was, and how long it took."""

    def __init__(self, now: float):
        self.at, self.cost = now, 0.0

    def due(self) -> bool:
        return time.monotonic() - self.at > max(PATIENCE, self.cost / SHARE)

    def save(
        self, runs: list[Run], carry: Carry, alive: list[bool], seconds: float
    ) -> list[events.Event]:
        """A checkpoint of every run that is alive; returns what to tell of it."""
        start, sound = time.monotonic(), [i for i, well in enumerate(alive) if well]
        for i in sound:
            runs[i].save(row(carry, i), seconds)
        self.at = time.monotonic()
        self.cost = self.at - start
        done = int(np.min(carry.iteration))
        return [events.Saved(*runs[i].named, done) for i in sound]


def _line(
    trainer: AbstractTrainer,
    seed: int,
    done: int,
    seconds: float,
    log: dict[str, np.ndarray],
    i: int,
) -> dict[str, Any]:
    """One line of the log."""
    return {
        "seed": seed,
        "iteration": done,
        "steps": done * trainer.steps_per_iteration,
        "updates": done * trainer.updates_per_iteration,
        "seconds": round(seconds, 3),
    } | {name: float(values[i]) for name, values in log.items()}


class _Fault(NamedTuple):
    """What stopped a run, and when."""

    name: str  # a kind of number, or a figure of the log
    when: str
    by_task: TaskFault | None  # None where training made it

    def says(self, where: str | None = None) -> str:
        """The fault and its remedy; `where` it was found first, if that is known."""
        if self.by_task:
            return f"{self.by_task.says(self.when)} and resume from the last checkpoint"
        first = f", first in {where}" if where else ""
        return (
            f"{self.name}: training made a number that is not finite {self.when}{first}; lower "
            "the learning rates and resume from the last checkpoint"
        )


def _fault(line: dict[str, Any], health: Health, agents: int) -> _Fault | None:
    """What is wrong: what the task gave before what the algorithm made of it."""
    when = f"in iteration {line['iteration']} (seed {line['seed']})"
    if by_task := health.by_task(agents):
        return _Fault(by_task.name, when, by_task)
    losses = (name for name, value in line.items() if not np.isfinite(value))
    name = next(losses, health.by_training())
    return _Fault(name, when, None) if name else None
