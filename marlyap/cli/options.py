"""What the options of the verbs share. Nothing here imports JAX."""

import argparse
import difflib
from pathlib import Path
from typing import NoReturn

from marlyap.errors import UserError, whole


OVERRIDES = """
any field of the task, the algorithm and the schedule can be set by its dotted name:
  --task.agents 5 --task.graph path --task.dynamics.limits 2,2
  --algorithm.rate_Q 1e-3 --algorithm.constraint.reading hinge --schedule.environments 16
`marlyap list TASK`, `marlyap list ALGORITHM` and `marlyap list schedule` show the fields.
TASK and ALGORITHM may also be path/to/file.py:Name, code of your own.
"""
ON_TASK = """
any field of the task can be set by its dotted name; `marlyap list TASK` shows them:
  --task.agents 5 --task.graph path --task.dynamics.limits 2,2
"""
SUBJECT = (
    ON_TASK
    + """
without --task a policy is measured on the task it was trained on. A run whose task is your own
code needs --task path/to/file.py:Name for that code. Any other task is measured if the policy fits.
"""
)
NAMED = "a name that `marlyap list` shows, or path/to/file.py:Name"
TRACKERS = "trackers that are told as well: wandb, mlflow, trackio (CSV, TensorBoard: always)"
OWN_TASK = "the task to measure on (default: that of each run; needed for controllers)"
SHIELD = "behind a credit shield (docs/stability.md), set by --shield.FIELD"
SEED = "of the starts (default 0), or the word draw for starts that nobody has seen"


class Parser(argparse.ArgumentParser):
    """Errors are one sentence and exit code 2, like every other bad input."""

    def error(self, message: str) -> NoReturn:
        head, _, rest = message.partition("unrecognized arguments: ")
        if rest and not head:
            word = rest.split()[0]
            options = [o for a in self._actions for o in a.option_strings if o.startswith("--")]
            near = difflib.get_close_matches(word.partition("=")[0], options, n=1)
            hint = f"; did you mean {near[0]}?" if near else f"; see {self.prog} --help."
            raise UserError(f"{self.prog}: there is no option {word}{hint}")
        raise UserError(f"{message}; see {self.prog} --help.")

    def parse_known_args(self, args=None, namespace=None):  # pyright: ignore
        """Of a verb: refuse here what it does not know, for here its options are known."""
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        return found, rest


class Once(argparse.Action):
    """An option that cannot be given twice."""

    def __call__(self, parser, namespace, values, option_string=None):  # pyright: ignore
        given = namespace.__dict__.setdefault("given", set())
        if self.dest in given:
            raise UserError(f"{option_string}: it is given twice.")
        given.add(self.dest)
        setattr(namespace, self.dest, values)


def number(text: str) -> int:
    """A whole number, also as 1e5."""
    try:
        return whole(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number") from None


def seed_of_starts(text: str) -> int | str:
    """A whole number, or the word draw."""
    return text if text == "draw" else number(text)


def place(text: str) -> Path:
    """A path that is not empty."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the path is empty")
    return Path(text)


def measured_on(p: argparse.ArgumentParser, task: str) -> None:
    """What a policy is measured on."""
    p.add_argument("--task", default=None, help=task)
    p.add_argument("--shield", action="store_true", help=SHIELD)
    p.add_argument(
        "--algorithm", default=None, help="the algorithm of a run where it is your own code"
    )
