"""What robots talk over: a small interface, one bus within a process, and zenoh.

A key is words joined by slashes; in a pattern `*` stands for any one word.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

from marlyap.deploy.extras import needs


Listener = Callable[[str, bytes], None]  # key, payload
Watcher = Callable[[str, bool], None]  # key, whether its owner is there


class Bus(ABC):
    """Listeners may be called in threads of the bus; they must return at once."""

    @abstractmethod
    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Send to all who listen."""

    @abstractmethod
    def on(self, pattern: str, listener: Listener) -> None:
        """Call the listener with all that is sent from now on."""

    @abstractmethod
    def alive(self, key: str) -> None:
        """Say that the owner of the key is there, until this bus is closed or its process dies."""

    @abstractmethod
    def watch(self, pattern: str, watcher: Watcher) -> None:
        """Call the watcher for all owners that are there, that come and that go."""

    @abstractmethod
    def close(self) -> None:
        """Leave."""


def matches(pattern: str, key: str) -> bool:
    """Whether a key is one of the pattern's."""
    asked, words = pattern.split("/"), key.split("/")
    return len(asked) == len(words) and all(
        a in ("*", w) for a, w in zip(asked, words, strict=True)
    )


class Hub:
    """What the buses of one process are plugged into."""

    def __init__(self):
        self.buses: list[LocalBus] = []


class LocalBus(Bus):
    """A bus within one process: delivers at once, in the caller's thread."""

    def __init__(self, hub: Hub):
        self.hub, self.listeners, self.watchers, self.owned = hub, [], [], []
        hub.buses.append(self)

    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        for bus in self.hub.buses:
            for pattern, listener in bus.listeners:
                if matches(pattern, key):
                    listener(key, payload)

    def on(self, pattern: str, listener: Listener) -> None:
        self.listeners.append((pattern, listener))

    def alive(self, key: str) -> None:
        self.owned.append(key)
        self._tell(key, True)

    def watch(self, pattern: str, watcher: Watcher) -> None:
        self.watchers.append((pattern, watcher))
        for bus in self.hub.buses:
            for key in bus.owned:
                if matches(pattern, key):
                    watcher(key, True)

    def close(self) -> None:
        if self in self.hub.buses:
            self.hub.buses.remove(self)
            for key in self.owned:
                self._tell(key, False)

    def _tell(self, key: str, there: bool) -> None:
        for bus in self.hub.buses:
            for pattern, watcher in bus.watchers:
                if matches(pattern, key):
                    watcher(key, there)


class ZenohBus(Bus):
    """Eclipse zenoh between peers, without multicast: who connects to whom is told.

    Arguments: listen and connect, endpoints such as tcp/127.0.0.1:7601; those that do not answer
    yet are tried again.
    Raises UserError where zenoh is not installed.
    """

    def __init__(self, listen: Sequence[str] = (), connect: Sequence[str] = ()):
        self.zenoh = needs("zenoh", "the bus", "eclipse-zenoh")
        config = self.zenoh.Config()
        for name, value in (
            ("mode", '"peer"'),
            ("listen/endpoints", _list(listen)),
            ("connect/endpoints", _list(connect)),
            ("connect/timeout_ms", "0"),
            ("connect/exit_on_failure", "false"),
            ("scouting/multicast/enabled", "false"),
        ):
            config.insert_json5(name, value)
        self.session = self.zenoh.open(config)
        self.kept: list[Any] = []

    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        self.session.put(key, payload, express=True, attachment=attachment)

    def on(self, pattern: str, listener: Listener) -> None:
        call = lambda sample: listener(str(sample.key_expr), sample.payload.to_bytes())
        self.kept.append(self.session.declare_subscriber(pattern, call))

    def alive(self, key: str) -> None:
        self.kept.append(self.session.liveliness().declare_token(key))

    def watch(self, pattern: str, watcher: Watcher) -> None:
        came = self.zenoh.SampleKind.PUT
        call = lambda sample: watcher(str(sample.key_expr), sample.kind == came)
        watched = self.session.liveliness().declare_subscriber(pattern, call, history=True)
        self.kept.append(watched)

    def close(self) -> None:
        self.session.close()


def _list(words: Sequence[str]) -> str:
    return "[" + ", ".join(f'"{word}"' for word in words) + "]"
