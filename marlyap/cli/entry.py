"""The command line: what was asked for, in words. The work is in `commands`, imported only then.

Nothing here imports JAX, so help and bad usage answer at once.
"""

import argparse
import difflib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from marlyap.cache import enable_cache
from marlyap.errors import UserError, explained, whole


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
EXAMPLES = {
    "demo": """
  marlyap demo
  marlyap demo --seeds 0 1 2 --out runs/three""",
    "train": """
  marlyap train rendezvous masac-lyapunov
  marlyap train formation masac --seeds 0 1 2 --steps 100000 --task.agents 5
  marlyap train platoon.py:Platoon apg
  marlyap train --resume runs/rendezvous/masac-lyapunov/seed0""",
    "evaluate": """
  marlyap evaluate runs/demo
  marlyap evaluate runs/demo/seed0 --task rendezvous-late
  marlyap evaluate runs/demo/seed0 tree-pursuit --task rendezvous --task.size 2""",
    "certify": """
  marlyap certify runs/demo/seed0
  marlyap certify runs/demo/seed0 --certificates reach --task.size 2 --out certificate
  marlyap certify tree-pursuit --task rendezvous --out certificate""",
    "recheck": """
  marlyap recheck runs/demo/seed0/certificate""",
    "check-task": """
  marlyap check-task formation
  marlyap check-task platoon.py:Platoon --task.agents 8""",
    "report": """
  marlyap report runs/demo
  marlyap report runs/demo/seed0 --task rendezvous-late --out late.html""",
    "watch": """
  marlyap watch runs/demo/seed0 --episode 3
  marlyap watch runs/demo/seed0 --task.size 2 --out films""",
    "list": """
  marlyap list
  marlyap list rendezvous
  marlyap list masac-lyapunov
  marlyap list platoon.py:Platoon""",
}


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


def parser() -> Parser:
    """All verbs and their options."""
    top = Parser(
        prog="marlyap",
        description="Train decentralised controllers for teams of robots, hold them to a Lyapunov "
        "condition, and measure what they do.",
    )
    top.add_argument("--version", action="store_true", help="print the version and stop")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", parser_class=Parser)

    def verb(name: str, help: str, epilog: str = "") -> Parser:
        p = verbs.add_parser(
            name,
            help=help,
            description=help[0].upper() + help[1:] + ".",
            epilog=f"{epilog}\nexamples:{EXAMPLES[name]}".lstrip(),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        p.add_argument(
            "--json", action="store_true", help="print one JSON object on standard output"
        )
        return p

    def on(p: Parser, task: str) -> None:
        p.add_argument("--task", default=None, help=task)
        p.add_argument(
            "--algorithm", default=None, help="the algorithm of a run where it is your own code"
        )

    p = verb("demo", "train, evaluate and report the main task, from nothing to a film")
    p.add_argument("--out", type=place, default=Path("runs/demo"), help="directory of the runs")
    p.add_argument(
        "--seeds", nargs="+", action=Once, default=["0"], help="training seeds (default 0)"
    )
    p.add_argument("--steps", type=number, default=None, help="environment steps of each")
    p.add_argument("--again", action="store_true", help="train anew what is there already")

    p = verb("train", "train a team, one run for each seed", OVERRIDES)
    known = "a name that `marlyap list` shows, or path/to/file.py:Name"
    p.add_argument("task", nargs="?", metavar="TASK", help=known)
    p.add_argument("algorithm", nargs="?", metavar="ALGORITHM", help=known)
    p.add_argument("--seeds", nargs="+", action=Once, help="training seeds (default 0)")
    p.add_argument("--steps", type=number, help="environment steps of each seed")
    p.add_argument(
        "--out", type=place, default=None, help="directory (default runs/TASK/ALGORITHM)"
    )
    p.add_argument("--preset", help="tuned (default) or paper")
    p.add_argument("--force", action="store_true", help="overwrite runs that are there")
    p.add_argument("--resume", type=place, nargs="+", metavar="RUN", help="resume these runs")
    own = "where a resumed run's is your own code"
    p.add_argument("--task", dest="own_task", help=f"the task, {own}")
    p.add_argument("--algorithm", dest="own_algorithm", help=f"the algorithm, {own}")
    p.add_argument("--parallel", default="auto", help="seeds: auto, process (one a core) or vmap")
    p.add_argument("--device", default=None, help="cpu or gpu (default: what JAX finds)")
    p.add_argument(
        "--on-nan", default="stop", help="when numbers diverge: stop (default) or rollback"
    )
    p.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)

    p = verb("evaluate", "measure runs or hand-written controllers on held-out starts", SUBJECT)
    p.add_argument("runs", nargs="+", metavar="RUN", help="run directories or controller names")
    on(p, "the task to measure on (default: that of each run; needed for controllers)")
    p.add_argument("--episodes", type=number, default=500, help="held-out starts (default 500)")
    p.add_argument("--seed", type=seed_of_starts, default=0, help=SEED)
    p.add_argument("--confidence", type=float, default=0.95, help="of the intervals")
    p.add_argument("--out", type=place, default=None, help="file for the figures, as JSON")

    p = verb("certify", "say what holds of a run or controller, with what evidence", SUBJECT)
    p.add_argument("run", metavar="RUN", help="a run directory or a controller name")
    on(p, "the task to measure on (default: that of each run; needed for controllers)")
    p.add_argument("--certificates", nargs="+", default=None, help="names (default: the sampled)")
    each = "fresh starts of each (default 10000; robustness 2000, theorem1 and composition 5000)"
    p.add_argument("--rollouts", type=number, default=None, help=each)
    p.add_argument("--confidence", type=float, default=0.999, help="of all claims together")
    p.add_argument("--seed", type=number, default=0, help="of the starts (default 0)")
    p.add_argument("--out", type=place, default=None, help="directory (default RUN/certificate)")
    p.add_argument("--force", action="store_true", help="overwrite a certificate that is there")

    p = verb("recheck", "derive every figure of a certificate again, without JAX")
    p.add_argument("certificate", type=place, metavar="CERTIFICATE", help="what certify wrote")

    p = verb(
        "check-task",
        "check a task against the laws that training and certificates rely on",
        ON_TASK,
    )
    p.add_argument("task", metavar="TASK", help="a name of `marlyap list`, or path/to/file.py:Name")
    p.add_argument("--seed", type=number, default=0, help="of the episodes it plays (default 0)")

    p = verb("report", "write one HTML file (and PNGs) about runs", SUBJECT)
    p.add_argument("runs", type=place, nargs="+", metavar="RUN", help="run directories")
    where = "HTML file (default: in the run; of several runs, ./report.html)"
    p.add_argument("--out", type=place, default=None, help=where)
    p.add_argument("--episodes", type=number, default=500, help="held-out starts (default 500)")
    p.add_argument("--seed", type=seed_of_starts, default=0, help=SEED)
    on(p, "the task to measure on (default: that of each run)")

    p = verb("watch", "film one episode of a run, as GIF and HTML", SUBJECT)
    p.add_argument("run", type=place, metavar="RUN", help="a run directory")
    p.add_argument("--episode", type=number, default=0, help="which of the evaluation starts")
    p.add_argument("--seed", type=seed_of_starts, default=0, help=SEED)
    p.add_argument(
        "--out", type=place, default=None, help="where to put the film (default: the run)"
    )
    on(p, "the task to measure on (default: that of each run)")

    p = verb("list", "list tasks, algorithms and controllers, or the fields of one")
    p.add_argument("name", nargs="?", help="what to show: any name in the lists, or file.py:Name")
    return top


def program() -> NoReturn:
    """`main` as a process of its own, which Ctrl-C ends at once and without a traceback."""
    on_interrupt_exit()
    code = main()
    with suppress(OSError, ValueError):
        sys.stdout.flush()
    if code == INTERRUPTED:
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
        tell_interrupted()
        return INTERRUPTED
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
        parser().print_help()
        return 0
    prepare(args)
    if getattr(args, "device", None):
        find_device(args.device)
    from marlyap.cli import verbs

    result, code = verbs.VERBS[args.verb](args, overrides)
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


INTERRUPTED = 128 + signal.SIGINT


def on_interrupt_exit() -> None:
    """Let Ctrl-C end this process at once, also while XLA compiles or computes.

    Python runs a handler only between two of its own instructions, and an exception that one
    raises within a callback of XLA is lost or crashes. So a thread is told of the signal too.
    Files are replaced whole, so none is lost. Training sets a handler of its own (workers.Stop).
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.signal(signal.SIGINT, exit_interrupted)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)

    def watch() -> None:
        while number := os.read(reader, 1):
            ours = signal.getsignal(signal.SIGINT) is exit_interrupted
            if number[0] == signal.SIGINT and ours:
                exit_interrupted()

    threading.Thread(target=watch, daemon=True).start()


ENDING = threading.Lock()


def exit_interrupted(*_: object) -> None:
    """One line and exit code 130, now. The first of the two threads that are told does it."""
    if not ENDING.acquire(blocking=False):
        time.sleep(1.0)  # the other one ends the process meanwhile
        return
    flush = threading.Thread(target=sys.stdout.flush, daemon=True)
    flush.start()
    flush.join(0.5)  # a full pipe must not keep us
    tell_interrupted()
    os._exit(INTERRUPTED)


def tell_interrupted() -> None:
    """Say what an interrupt left behind."""
    store = sys.modules.get("marlyap.store")
    wrote = store is not None and bool(store.WRITTEN)
    what = "the files written until now are complete" if wrote else "nothing was written"
    with suppress(OSError):
        os.write(2, f"\nmarlyap: interrupted; {what}.\n".encode())


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


PARTS = ("task", "algorithm", "schedule")


def prepare(args: Any) -> None:
    """Set what JAX reads when it is imported: the device, and one core where one is faster."""
    device = getattr(args, "device", None)
    if device not in (None, "cpu", "gpu"):
        raise UserError(f"device: '{device}' must be cpu or gpu.")
    if getattr(args, "parallel", "auto") not in ("auto", "process", "vmap"):
        raise UserError(f"parallel: '{args.parallel}' must be auto, process or vmap.")
    if getattr(args, "on_nan", "stop") not in ("stop", "rollback"):
        raise UserError(f"on-nan: '{args.on_nan}' must be stop or rollback.")
    if device:
        os.environ["JAX_PLATFORMS"] = {"cpu": "cpu", "gpu": "cuda"}[device]
    training = args.verb in ("demo", "train")
    if training:
        os.environ.setdefault("NPROC", "1")  # products this small lose time to a second thread
    if args.verb != "recheck" and (trouble := enable_cache(programs=training)):
        print(f"marlyap: {trouble}", file=sys.stderr)
    core = os.environ.get("MARLYAP_CORE")
    if core and core.isdigit() and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(core)})


def find_device(device: str) -> None:
    """Raise UserError where JAX does not see the device that was asked for."""
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # JAX asserts where the platform has no plugin
        raise UserError(
            f"device: JAX finds no {device} here; leave out --device, or install JAX for it, as "
            "in pip install 'jax[cuda13]'."
        ) from None
