"""`marlyap export`: a trained team as a bundle for robots."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from marlyap.cli.common import Overrides, Result, say
from marlyap.cli.environment import prepare
from marlyap.cli.options import SUBJECT, measured_on, number, place
from marlyap.errors import UserError


SUMMARY = "write a trained team as a bundle for robots: contract, NumPy, ONNX, C"
EPILOG = SUBJECT
EXAMPLES = """
  marlyap export runs/demo/seed0 --out bundle
  marlyap export runs/demo/seed0 --out bundle --with numpy c --starts 100"""
RUNTIMES = ("numpy", "onnx", "c")


def options(p: ArgumentParser) -> None:
    p.add_argument("run", metavar="RUN", help="a run directory")
    p.add_argument("--out", type=place, required=True, help="the folder to make")
    what = "runtimes (default: all; onnx only where it is installed)"
    p.add_argument("--with", dest="runtimes", nargs="+", choices=RUNTIMES, default=None, help=what)
    starts = "starts of the margins and the evidence (default 500; 0: neither)"
    p.add_argument("--starts", type=number, default=500, help=starts)
    measured_on(p, "the task the bundle is for (default: that of the run)")


def run(args: Namespace, overrides: Overrides) -> Result:
    """Write the bundle and run its golden pairs."""
    if args.out.exists():
        raise UserError(f"out: {args.out} already exists; choose another folder.")
    prepare()
    from importlib.util import find_spec

    from marlyap.cli.verify import tell_all
    from marlyap.deploy.bundle import write
    from marlyap.deploy.verify import verify
    from marlyap.runs.run import one_run
    from marlyap.runs.subject import subject

    opened, game = subject(one_run(Path(args.run)), args.task, args.algorithm, overrides)
    for note in opened.warnings:
        say(note)
    runtimes = args.runtimes or RUNTIMES
    if args.runtimes is None and find_spec("onnx") is None:
        runtimes = ("numpy", "c")
        say("No ONNX files, which need onnx: pip install 'marlyap[robots]'.")
    contract = write(opened, args.out, runtimes, args.starts, say, game)
    found = verify(args.out)
    delay = contract["timing"]["max_actuation_delay"]
    if not args.json:
        tell_all(args.out, found)
        if contract["margins"]:
            stands = "none" if delay is None else f"{1000 * delay:.0f} ms"
            print(f"Commands may come {stands} late; contract.json has all margins.")
    done = {"bundle": str(args.out), "runtimes": [f.runtime for f in found]}
    done |= {"robots": contract["sight"] is not None, "max_actuation_delay": delay}
    return done, int(any(f.fault for f in found))
