"""The command line. `program` is the process, `main` one command in a process that is there.

Importing this loads nothing else, so that an interrupt is caught from the first moment.
"""

import os
import signal


def program() -> None:
    """`main` as a process of its own, which Ctrl-C ends at once and without a traceback."""
    signal.signal(signal.SIGINT, _end)
    from marlyap.cli.entry import process

    process()


def main(argv: "list[str] | None" = None) -> int:
    """Run one command; returns the exit code (0 done, 2 bad input, 130 or 143 stopped)."""
    from marlyap.cli.entry import main

    return main(argv)


def _end(*_: object) -> None:
    """Exit while the rest is imported; `interrupts` takes over."""
    os.write(2, b"\nmarlyap: interrupted; nothing was written.\n")
    os._exit(130)
