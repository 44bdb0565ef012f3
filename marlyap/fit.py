"""The host loop over compiled iterations: progress, log, checkpoints, and stopping in good order."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap import store
from marlyap.errors import UserError
from marlyap.run import Run
from marlyap.train import Carry, Trainer


SHARE = 0.02  # of the training time that checkpoints may take
PATIENCE = 20.0  # seconds between checkpoints at least


class Diverged(UserError):
    """A number stopped being finite; the last checkpoint is sound."""


def fit(runs: list[Run], stop: Callable[[], bool] = lambda: False) -> Iterator[dict[str, Any]]:
    """Train `runs` to the end, or until `stop()`; yields one dict for each run and iteration.

    Several runs must differ in their seed alone; they advance together under `vmap`. Everything
    is saved at the end and when stopped, so that calling this again goes on bit for bit.
    Raises Diverged (a UserError) when a number stops being finite in every run.
    """
    with ExitStack() as held:
        for run in runs:
            held.enter_context(store.lock(run.directory))
            store.sweep(run.directory)
        yield from _fit(runs, stop)


def _fit(runs: list[Run], stop: Callable[[], bool]) -> Iterator[dict[str, Any]]:
    trainer, loaded = runs[0].trainer, [run.load() for run in runs]
    for run, (carry, _, warnings) in zip(runs, loaded, strict=True):
        run.rewind(int(carry.iteration))
        yield from ({"seed": run.seed, "warning": w} for w in warnings)
    carry = _stack([carry for carry, _, _ in loaded])
    before, clock = max(s for _, s, _ in loaded), time.monotonic()
    done, saved = int(np.min(carry.iteration)), _Saved(clock)
    alive = [True] * len(runs)

    while done < trainer.iterations and not stop():
        carry, info = _iterate(trainer, carry)
        done += 1
        if done % trainer.schedule.judge_every == 0 or done == trainer.iterations:
            carry, look = _judge(trainer, carry)
            info |= look
        rows = jax.tree.map(np.asarray, info)
        seconds = before + time.monotonic() - clock
        for i, run in enumerate(runs):
            line = _line(trainer, run, done, seconds, {k: float(v[i]) for k, v in rows.items()})
            fault = _fault(line)
            if fault and alive[i]:
                alive[i] = False
                yield {"seed": run.seed, "iteration": done, "diverged": fault}
            if alive[i]:
                run.log(line)
                yield line | {"iterations": trainer.iterations}
        if not any(alive):
            raise Diverged(_fault_advice(line, runs[0]))
        if saved.due():
            saved.save(runs, carry, alive, seconds)
    saved.save(runs, carry, alive, before + time.monotonic() - clock)


class _Saved:
    """When the last checkpoint was, and how long it took."""

    def __init__(self, now: float):
        self.at, self.cost = now, 0.0

    def due(self) -> bool:
        return time.monotonic() - self.at > max(PATIENCE, self.cost / SHARE)

    def save(self, runs: list[Run], carry: Carry, alive: list[bool], seconds: float) -> None:
        start = time.monotonic()
        for i, run in enumerate(runs):
            if alive[i]:
                run.save(jax.tree.map(lambda x: x[i] if eqx.is_array(x) else x, carry), seconds)
        self.at = time.monotonic()
        self.cost = self.at - start


def _stack(carries: list[Carry]) -> Carry:
    """One leading axis for the runs."""
    join = lambda *xs: jnp.stack(xs) if eqx.is_array(xs[0]) else xs[0]
    return jax.tree.map(join, *carries)


def _each(f: Callable[[Carry], Any], carry: Carry) -> Any:
    """`f` for every run: vmapped only when there are several, since a batch of one costs speed."""
    if carry.iteration.shape[0] > 1:
        return eqx.filter_vmap(f)(carry)
    single = jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, carry)
    return jax.tree.map(lambda x: x[None] if eqx.is_array(x) else x, f(single))


@eqx.filter_jit(donate="all-except-first")
def _iterate(trainer: Trainer, carry: Carry) -> tuple[Carry, dict[str, Any]]:
    return _each(trainer.iterate, carry)


@eqx.filter_jit(donate="all-except-first")
def _judge(trainer: Trainer, carry: Carry) -> tuple[Carry, dict[str, Any]]:
    return _each(trainer.judge, carry)


def _line(
    trainer: Trainer, run: Run, done: int, seconds: float, numbers: dict[str, float]
) -> dict[str, Any]:
    return {
        "seed": run.seed,
        "iteration": done,
        "steps": done * trainer.steps_per_iteration,
        "updates": done * trainer.updates_per_iteration,
        "seconds": round(seconds, 3),
    } | numbers


def _fault(line: dict[str, Any]) -> str | None:
    """What is not finite: what the task gave before what the algorithm made of it."""
    for name in ("obs", "features", "reward", "cost", "action"):
        if line.get(f"bad_{name}", 0) > 0:
            return name
    return next((k for k, v in line.items() if not np.isfinite(v)), None)


def _fault_advice(line: dict[str, Any], run: Run) -> str:
    fault = _fault(line)
    who = "the task returned" if fault in ("obs", "features", "reward", "cost") else "training made"
    mend = "mend the task" if who.startswith("the task") else "lower the learning rates"
    return (
        f"{fault}: {who} a number that is not finite in iteration {line['iteration']} "
        f"(seed {line['seed']}); {mend} and go on from the last checkpoint in {run.directory}."
    )
