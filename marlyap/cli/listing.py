"""`marlyap list`: what there is, or the fields of one of them."""

from argparse import ArgumentParser, Namespace

from marlyap.cli.common import Overrides, Result
from marlyap.cli.environment import prepare
from marlyap.errors import UserError


SUMMARY = "list tasks, algorithms and controllers, or the fields of one"
EPILOG = ""
EXAMPLES = """
  marlyap list
  marlyap list rendezvous
  marlyap list masac-lyapunov
  marlyap list platoon.py:Platoon"""


def options(p: ArgumentParser) -> None:
    p.add_argument("name", nargs="?", help="what to show: any name in the lists, or file.py:Name")


def run(args: Namespace, overrides: Overrides) -> Result:
    """What there is, or the fields of one of them."""
    if overrides:
        raise UserError(f"--{next(iter(overrides))}: list shows what there is; leave it out.")
    prepare()
    from marlyap.cli import catalogue

    if args.name:
        return catalogue.show_fields(args.name, args.json), 0
    return catalogue.show_all(args.json), 0
