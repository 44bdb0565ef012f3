"""What Ctrl-C does to a command: one line, exit code 130, at once. Nothing here imports JAX."""

import os
import signal
import sys
import threading
import time
from contextlib import suppress


INTERRUPTED = 128 + signal.SIGINT


def on_interrupt_exit() -> None:
    """Let Ctrl-C end this process at once, also while XLA compiles or computes.

    Python runs a handler only between two of its own instructions, and an exception that one
    raises within a callback of XLA is lost or crashes. So a thread is told of the signal too.
    Files are replaced whole, so none is lost. Training sets a handler of its own (workers.Stop).
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.signal(signal.SIGINT, exit_interrupted)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)

    def watch() -> None:
        while number := os.read(reader, 1):
            ours = signal.getsignal(signal.SIGINT) is exit_interrupted
            if number[0] == signal.SIGINT and ours:
                exit_interrupted()

    threading.Thread(target=watch, daemon=True).start()


ENDING = threading.Lock()


def exit_interrupted(*_: object) -> None:
    """One line and exit code 130, now. The first of the two threads that are told does it."""
    if not ENDING.acquire(blocking=False):
        time.sleep(1.0)  # the other one ends the process meanwhile
        return
    flush = threading.Thread(target=sys.stdout.flush, daemon=True)
    flush.start()
    flush.join(0.5)  # a full pipe must not keep us
    tell_interrupted()
    os._exit(INTERRUPTED)


def tell_interrupted() -> None:
    """Say what an interrupt left behind."""
    store = sys.modules.get("marlyap.storage.store")
    wrote = store is not None and bool(store.WRITTEN)
    what = "the files written until now are complete" if wrote else "nothing was written"
    with suppress(OSError):
        os.write(2, f"\nmarlyap: interrupted; {what}.\n".encode())
