"""The words of a command line, as options. Nothing here imports JAX: help comes at once."""

import argparse
from collections.abc import Sequence
from typing import Protocol

from marlyap.cli import (
    agent,
    bag,
    bench,
    certify,
    check_task,
    demo,
    evaluate,
    export,
    listing,
    plot,
    recheck,
    report,
    swarm,
    sweep,
    train,
    verify,
    watch,
)
from marlyap.cli.common import Overrides, Result
from marlyap.cli.options import Parser
from marlyap.errors import UserError


class Verb(Protocol):
    """A file of this package. Its heavy imports are inside `run`."""

    @property
    def SUMMARY(self) -> str:
        """One line."""
        ...

    @property
    def EPILOG(self) -> str:
        """What its help ends with, before the examples."""
        ...

    @property
    def EXAMPLES(self) -> str:
        """One command a line."""
        ...

    def options(self, p: Parser, /) -> None:
        """Add its options."""
        ...

    def run(self, args: argparse.Namespace, overrides: Overrides, /) -> Result:
        """Do it; returns what --json prints, and the exit code."""
        ...


VERBS: dict[str, Verb] = {
    "demo": demo,
    "train": train,
    "sweep": sweep,
    "evaluate": evaluate,
    "bench": bench,
    "certify": certify,
    "recheck": recheck,
    "check-task": check_task,
    "export": export,
    "verify": verify,
    "agent": agent,
    "swarm": swarm,
    "bag": bag,
    "report": report,
    "watch": watch,
    "plot": plot,
    "list": listing,
}


def parser() -> Parser:
    """All verbs and their options."""
    top = Parser(
        prog="marlyap",
        description="Train decentralised controllers for teams of robots, hold them to a Lyapunov "
        "condition, and measure what they do.",
    )
    top.add_argument("--version", action="store_true", help="print the version and stop")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", parser_class=Parser)
    for name, verb in VERBS.items():
        p = verbs.add_parser(
            name,
            help=verb.SUMMARY,
            description=verb.SUMMARY[0].upper() + verb.SUMMARY[1:] + ".",
            epilog=f"{verb.EPILOG}\nexamples:{verb.EXAMPLES}".lstrip(),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        p.add_argument(
            "--json", action="store_true", help="print one JSON object on standard output"
        )
        verb.options(p)
    return top


PARTS = ("task", "shield", "algorithm", "schedule")


def parse(argv: Sequence[str]) -> tuple[argparse.Namespace, dict[str, str]]:
    """Options, and the overrides `--task.FIELD value` by dotted name."""
    plain, overrides = [], {}
    words = iter(argv)
    for word in words:
        name, equals, value = word.partition("=")
        if not (word.startswith("--") and "." in name and name[2:].split(".")[0] in PARTS):
            plain.append(word)
            continue
        if not equals:
            value = next(words, None)
        if value is None:
            raise UserError(f"{name}: it needs a value, as in {name} VALUE.")
        if name[2:] in overrides:
            raise UserError(f"{name}: it is given twice.")
        overrides[name[2:]] = value
    return parser().parse_args(plain), overrides
