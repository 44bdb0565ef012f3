"""What the verbs share. Nothing here imports JAX."""

import secrets
import sys
from typing import Any


Result = tuple[dict[str, Any] | None, int]  # what --json prints, and the exit code
Overrides = dict[str, str]  # "task.agents": "5"


def say(text: str) -> None:
    """A line for the person; standard output is kept for results."""
    print(text, file=sys.stderr)


def starts_of(seed: int | str) -> int:
    """The seed of the starts; a fresh one for the word draw."""
    return secrets.randbelow(2**31) if seed == "draw" else int(seed)
