"""One command from its words to its exit code."""

import json
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import NoReturn

from marlyap.cli import interrupts
from marlyap.cli.first import FIRST
from marlyap.cli.parser import VERBS, parse
from marlyap.errors import UserError, explained


def process() -> NoReturn:
    """`main` as a process of its own."""
    interrupts.on_interrupt_exit()
    code = main()
    with suppress(OSError, ValueError):
        sys.stdout.flush()
    if code == interrupts.INTERRUPTED:
        os._exit(code)  # a computation may still run in XLA's threads
    sys.exit(code)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (0 done, 2 bad input, 130 or 143 stopped)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        code = command(argv)
        sys.stdout.flush()
        return code
    except UserError as error:
        return refuse(str(error))
    except KeyboardInterrupt:
        interrupts.tell_interrupted()
        return interrupts.INTERRUPTED
    except BrokenPipeError:
        forget_output()
        return 1
    except Exception as error:
        said = explained(error)
        if said is None and isinstance(error, OSError):
            forget_output()
            what = f"{error.filename} " if error.filename else "standard output "
            said = f"{what}could not be written or read ({error.strerror}); check the disk."
        if said is None:
            raise
        return refuse(said)


def command(argv: list[str]) -> int:
    """Run one command; returns its exit code."""
    args, overrides = parse(argv)
    if args.version:
        from importlib.metadata import version

        print(version("marlyap"))
        return 0
    if args.verb is None:
        print(FIRST, end="")
        return 0
    result, code = VERBS[args.verb].run(args, overrides)
    if args.json and result is not None:
        print(json.dumps(result))
    return code


def refuse(sentence: str) -> int:
    """Say it on standard error; the exit code of bad input."""
    print(f"marlyap: {UserError(sentence)}", file=sys.stderr)
    return 2


def forget_output() -> None:
    """Drop what standard output could not take, so that Python does not try again at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
