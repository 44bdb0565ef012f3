"""Stopping a training so that nothing is lost."""

import os
import signal
from collections.abc import Callable


class Stop:
    """Remembers the first request, so that training saves and ends; the second ends at once.

    Within `with`, SIGINT and SIGTERM are such requests. `tell` is called at the first.
    """

    def __init__(self, tell: Callable[[], None] = lambda: None):
        self.signal, self.tell = 0, tell

    def __enter__(self) -> "Stop":
        self.before = {s: signal.signal(s, self.catch) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for s, handler in self.before.items():
            signal.signal(s, handler)

    def catch(self, number: int, _: object) -> None:
        self.ask(number)

    def ask(self, number: int = signal.SIGTERM) -> None:
        """Ask for the end, as this signal would."""
        if self.signal:
            os._exit(128 + number)  # files are replaced whole, so that none is lost
        self.signal = number
        self.tell()

    def __call__(self) -> bool:
        return self.signal != 0

    @property
    def code(self) -> int:
        """The exit code: 0, or 128 + the signal."""
        return 128 + self.signal if self.signal else 0
