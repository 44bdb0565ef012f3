"""Many seeds at once: one process a core on a CPU, one vmapped program on a GPU."""

import json
import os
import signal
import subprocess
import sys
import threading
from argparse import Namespace
from collections.abc import Iterator
from queue import Queue
from typing import Any

import jax

from marlyap.errors import UserError
from marlyap.fit import Diverged, fit
from marlyap.progress import show
from marlyap.run import Run


ATTEMPTS = 3  # at what is not finite, when it is to be rolled back


class Stop:
    """Remembers the first signal, so that the loop can save and end; the second ends at once."""

    def __init__(self):
        self.signal = 0
        self.children: list[subprocess.Popen] = []

    def __enter__(self) -> "Stop":
        self.before = {s: signal.signal(s, self.catch) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for s, handler in self.before.items():
            signal.signal(s, handler)

    def catch(self, number: int, _: object) -> None:
        for child in self.children:
            if child.poll() is None:
                child.send_signal(number)
        if self.signal and not self.children:
            os._exit(128 + number)
        if not self.signal and not os.environ.get("MARLYAP_WORKER"):
            print("\nStopping at the next checkpoint; once more to stop at once.", file=sys.stderr)
        self.signal = number

    def __call__(self) -> bool:
        return self.signal != 0

    @property
    def code(self) -> int:
        return 128 + self.signal if self.signal else 0


def train_all(runs: list[Run], args: Namespace) -> int:
    """Train the runs that are not finished; returns 0, or 128 + the signal that stopped them."""
    runs = [run for run in runs if not run.finished]
    if not runs:
        return 0
    attempts = ATTEMPTS if getattr(args, "on_nan", "stop") == "rollback" else 1
    with Stop() as stop:
        on_cpu = jax.default_backend() == "cpu"
        vmapped = args.parallel == "vmap" or (args.parallel == "auto" and not on_cpu)
        if args.worker:
            for event in fit(runs, stop, attempts):
                print(json.dumps(event), flush=True)
        elif len(runs) == 1 or vmapped:
            show(_side_by_side(runs, stop, attempts), [run.seed for run in runs])
        else:
            show(_processes(runs, stop, args), [run.seed for run in runs])
    if stop.signal:
        where = " ".join(str(run.directory) for run in runs)
        print(f"Saved. Resume with: marlyap train --resume {where}", file=sys.stderr)
    return stop.code


def _side_by_side(runs: list[Run], stop: Stop, attempts: int) -> Iterator[dict[str, Any]]:
    """Runs that differ in their seed alone in one program; one such group after the other.

    Raises UserError at the end if a number stopped being finite in any of them.
    """
    failed: list[str] = []
    while runs:
        group = [run for run in runs if run.trainer == runs[0].trainer]
        runs = [run for run in runs if run.trainer != group[0].trainer]
        says: dict[int, str] = {}
        try:
            for event in fit(group, stop, attempts):
                says |= {event["seed"]: event["says"]} if "diverged" in event else {}
                yield event
        except Diverged as error:
            failed.append(str(error))
        failed += [says[run.seed] for run in group if not run.finished and run.seed in says]
    if failed:
        raise UserError(failed[0])


def _processes(runs: list[Run], stop: Stop, args: Namespace) -> Iterator[dict[str, Any]]:
    """One process a core; each prints its events as JSON lines."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
    waiting, free, queue = list(runs), list(cores), Queue()
    active: dict[int, tuple[subprocess.Popen, int, Run]] = {}
    failed: list[str] = []
    while (waiting and not stop()) or active:
        while waiting and free and not stop():
            run, core = waiting.pop(0), free.pop(0)
            child = _spawn(run, core, args)
            stop.children.append(child)
            active[child.pid] = (child, core, run)
            threading.Thread(target=_listen, args=(child, queue), daemon=True).start()
        pid, line = queue.get()
        if line is not None:
            yield json.loads(line)
            continue
        child, core, run = active.pop(pid)
        stop.children.remove(child)
        free.append(core)
        code = child.wait()
        if code in (130, 143) and not stop():
            failed.append(
                f"{run.directory}: its process was stopped from outside; resume by train --resume."
            )
        elif code not in (0, 130, 143):  # the other seeds go on
            said = child.stderr.read().strip().removeprefix("marlyap: ") if child.stderr else ""
            ended = (
                f"{run.directory}: its process ended with code {code}; resume it by train --resume."
            )
            failed.append(said.splitlines()[-1] if said else ended)
    if failed:
        raise UserError(failed[0])


def _spawn(run: Run, core: int, args: Namespace) -> subprocess.Popen:
    names = [args.task, args.algorithm] if ":" in f"{args.task}{args.algorithm}" else []
    command = [sys.executable, "-m", "marlyap", "train", *names]
    command += ["--worker", "--on-nan", getattr(args, "on_nan", "stop")]
    command += ["--resume", str(run.directory)]
    return subprocess.Popen(
        command,
        env=os.environ | {"MARLYAP_CORE": str(core), "MARLYAP_WORKER": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C reaches the parent, which passes it on once
    )


def _listen(child: subprocess.Popen, queue: Queue) -> None:
    assert child.stdout is not None
    for line in child.stdout:
        if line.startswith("{"):
            queue.put((child.pid, line))
    queue.put((child.pid, None))
