"""`marlyap check-task`: a task against the laws that the rest relies on."""

from argparse import ArgumentParser, Namespace

from marlyap.cli.common import Overrides, Result
from marlyap.cli.environment import prepare
from marlyap.cli.options import NAMED, ON_TASK, number
from marlyap.errors import check_range


SUMMARY = "check a task against the laws that training and certificates rely on"
EPILOG = ON_TASK
EXAMPLES = """
  marlyap check-task formation
  marlyap check-task platoon.py:Platoon --task.agents 8"""


def options(p: ArgumentParser) -> None:
    p.add_argument("task", metavar="TASK", help=NAMED)
    p.add_argument("--seed", type=number, default=0, help="of the episodes it plays (default 0)")


def run(args: Namespace, overrides: Overrides) -> Result:
    """One finding for every law; exit code 1 if one is broken."""
    prepare()
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from marlyap.conformance import conformance
    from marlyap.runs.subject import asked

    game = asked(args.task, overrides)
    check_range("seed", args.seed, 0, 2**31 - 1)
    found = conformance(game, args.seed)
    broken = [f.law for f in found if f.faults]
    skipped = [f.law for f in found if f.faults is None]
    waived = [f.law for f in found if f.waived]
    if not args.json:
        table = Table(title=escape(args.task), title_justify="left", show_header=False)
        for f in found:
            if f.faults is None:
                continue
            figures = ", ".join(f"{name} {value:.3g}" for name, value in f.figures.items())
            text = "\n".join(f.faults) or f.says + (f" ({figures})" if figures else "")
            mark = "waived" if f.waived else "broken" if f.faults else "kept"
            table.add_row(f.law, mark, escape(f.waived or text))
        if skipped:
            rest = f"{len(skipped)} laws need sound shapes: {', '.join(skipped)}"
            table.add_row("", "skipped", rest)
        Console().print(table)
        print(
            f"{args.task}: {len(found) - len(broken) - len(skipped) - len(waived)} of "
            f"{len(found)} laws kept",
            end="",
        )
        print(f", {len(skipped)} skipped" if skipped else "", end="")
        print(f", {len(waived)} waived" if waived else "", end="")
        print(f"; broken: {', '.join(broken)}." if broken else ".")
    laws = {f.law: {k: v for k, v in f._asdict().items() if k != "law"} for f in found}
    return {"task": args.task, "passes": not broken, "laws": laws}, int(bool(broken))
