"""One training in a process of its own: `python -m marlyap.runs.worker`, started by `launch`.

The first line of its standard input is its `Job`. A second line asks it to stop, and so does the
end of the input: its parent is gone then. It answers with events, one line of JSON each, on what
was standard output; what a task or a library prints goes to standard error.
"""

import os
import signal


if __name__ == "__main__":  # until `Stop` stands, a signal ends this process at once
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: os._exit(128 + number))

import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TextIO

from marlyap.errors import UserError, explained
from marlyap.runs import environment, events
from marlyap.runs.job import Job
from marlyap.runs.stop import Stop


GRACE = 2.0  # seconds


def main() -> int:
    """Do the job that standard input names; returns the exit code."""
    job = Job.from_json(sys.stdin.readline())
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def send(event: events.Event) -> None:
        with suppress(BrokenPipeError):  # the parent is gone, and `obey` hears of it
            answers.write(events.to_json(event) + "\n")

    environment.prepare(job.how.device, job.core)
    with Stop() as stop:
        threading.Thread(target=obey, args=(sys.stdin, stop), daemon=True).start()
        return work(job, stop, send)


def obey(orders: TextIO, stop: Stop) -> None:
    """Ask `stop` at a line, and at the end of the input.

    The parent is gone then, so this process ends after GRACE seconds, whatever it compiles.
    """
    for _ in orders:
        stop.ask()
    stop.ask()
    threading.Timer(GRACE, os._exit, (143,)).start()


def work(job: Job, stop: Stop, send: Callable[[events.Event], None]) -> int:
    """Train the run, telling of it; returns the exit code."""
    from marlyap.runs.launch import reopened, together  # JAX is imported here

    told, named = False, (job.run, -1)
    try:
        run = reopened(job)
        named = run.named
        for event in together([run], job.how, stop):
            told = told or isinstance(event, events.Failed)
            send(event)
    except Exception as error:
        said = str(error) if isinstance(error, UserError) else explained(error)
        if said is None:
            raise
        if not told:
            send(events.Failed(*named, said))
        return 2
    return stop.code


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    os._exit(code)  # a thread still reads standard input
