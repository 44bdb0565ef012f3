"""`marlyap recheck`: a certificate derived again, without JAX."""

from argparse import ArgumentParser, Namespace
from typing import Any

from marlyap.cli.common import Overrides, Result
from marlyap.cli.options import place


SUMMARY = "derive every figure of a certificate again, without JAX"
EPILOG = ""
EXAMPLES = """
  marlyap recheck runs/demo/seed0/certificate"""


def options(p: ArgumentParser) -> None:
    p.add_argument("certificate", type=place, metavar="CERTIFICATE", help="what certify wrote")


def run(args: Namespace, overrides: Overrides) -> Result:
    """Reject the certificate, or say of each verdict that it agrees.

    The exit code is 0 only if every verdict was derived again, and 1 where some could not be.
    """
    from marlyap.recheck import recheck

    def tell(name: str, verdict: dict[str, Any]) -> None:
        if not args.json:
            mark = "holds" if verdict["holds"] else "does not hold"
            print(f"{name} agrees: {verdict['claim']}: {mark}.", flush=True)

    result = recheck(args.certificate, tell)
    done, left = len(result["rechecked"]), result["not_rechecked"]
    if not args.json:
        for name, why in left.items():
            print(f"NOT CHECKED: {name}: {why}.")
        print(
            f"{args.certificate}: {done} of {done + len(left)} verdicts were derived again; ",
            end="",
        )
        print("the file as a whole is not confirmed." if left else "all agree.")
    return result, int(not result["agrees"])
