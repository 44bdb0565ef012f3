"""A process that trains units: `python -m marlyap.sweeps.worker`, started by an engine.

Each line of its standard input is a `Unit`; it answers with its name when the unit is done. At the
end of the input its parent is gone: what it trains has GRACE seconds to save itself, and the
process ends whatever it does then. SIGTERM and SIGINT let it save and end.
"""

import os
import signal


if __name__ == "__main__":  # until `Stop` stands, a signal ends this process at once
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: os._exit(128 + number))

import sys
import threading
from queue import Queue

from marlyap.runs import environment
from marlyap.runs.stop import Stop
from marlyap.sweeps.unit import Unit


GRACE = 2.0  # seconds


def main() -> int:
    """Train the units that standard input names; returns the exit code."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what a task or a library prints
    units: Queue[Unit | None] = Queue()
    with Stop(tell=lambda: units.put(None)) as stop:
        threading.Thread(target=listen, args=(units, stop), daemon=True).start()
        while (unit := units.get()) is not None and not stop():
            environment.prepare(unit.how.device, unit.core)
            from marlyap.sweeps.train import train  # JAX is imported here

            train(unit, stop)
            answers.write(unit.name + "\n")
        return stop.code


def listen(units: "Queue[Unit | None]", stop: Stop) -> None:
    """Pass on what the input names; at its end, see to the end of this process."""
    for line in sys.stdin:
        units.put(Unit.from_json(line))
    stop.ask()
    threading.Timer(GRACE, os._exit, (143,)).start()


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    os._exit(code)  # a thread still reads standard input
