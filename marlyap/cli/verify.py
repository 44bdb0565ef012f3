"""`marlyap verify`: a bundle's golden pairs in each of its runtimes, without JAX."""

import math
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from marlyap.cli.common import Overrides, Result
from marlyap.cli.options import place


SUMMARY = "run a bundle's golden pairs in NumPy, ONNX and C; refuse what was altered"
EPILOG = """
The exit code is 0 if every runtime agrees, 1 if one differs, and 2 if the bundle was altered. The
bundle's own code is run, so verify what you trust. The compiler is $CC, cc or gcc.
"""
EXAMPLES = """
  marlyap verify bundle
  marlyap verify bundle --with c --cflags "-O3 -march=native\""""


def options(p: ArgumentParser) -> None:
    p.add_argument("bundle", type=place, metavar="BUNDLE", help="what export wrote")
    what = "runtimes (default: all that the bundle has and that can be run here)"
    choices = ("numpy", "onnx", "c")
    p.add_argument("--with", dest="runtimes", nargs="+", choices=choices, default=None, help=what)
    p.add_argument("--cflags", default="-O2", help="for the C compiler (default -O2)")


def run(args: Namespace, overrides: Overrides) -> Result:
    """One line for each runtime."""
    from marlyap.deploy.verify import verify

    found = verify(args.bundle, args.runtimes, args.cflags)
    if not args.json:
        tell_all(args.bundle, found)
    said = {f.runtime: f._asdict() | {"worst": _finite(f.worst)} for f in found}
    bad = any(f.fault for f in found)
    return {"bundle": str(args.bundle), "agrees": not bad, "runtimes": said}, int(bad)


def _finite(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


def tell_all(bundle: Path, found: Iterable[Any]) -> None:
    """What each runtime said, and the bundle as a whole."""
    found = list(found)
    for f in found:
        if f.left_out:
            print(f"{f.runtime}: not run; it needs {f.left_out}.")
        elif f.fault:
            print(f"{f.runtime}: REFUSED: {f.fault}.")
        else:
            print(f"{f.runtime}: {f.pairs} golden pairs agree, within {f.worst:.1e} of an action.")
    good = not any(f.fault for f in found)
    print(f"{bundle}: {'whole, and its runtimes agree' if good else 'refused'}.")
