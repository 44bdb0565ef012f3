"""How long until something happens: help, import, the first update, and the same a second time.

Each is a fresh process, the least of several. The first start has an empty cache of programs; the
second finds there what the first put in. For the first update a training that makes one update an
iteration is started, and ended when the line of its first iteration is in its log.

    python benchmarks/startup.py
"""

import sys
import tempfile
from pathlib import Path

import harness

from marlyap.compute.export_cache import FOLDER


TRAIN = "train rendezvous masac-lyapunov --seeds 0 --steps"


def main(argv=None):
    args = harness.arguments(argv, __doc__, repeats=3)
    if args.quick:
        args.repeats = 1
    python = [sys.executable]
    rows = []

    def add(name, command, environment=None, repeats=args.repeats, until=None):
        """`until` is a file that the command writes: it is timed to its first line, and ended."""
        harness.note(name)
        there = (lambda: until.is_file() and until.stat().st_size > 0) if until else None
        runs = []
        for _ in range(repeats):
            if until:
                until.unlink(missing_ok=True)
            runs.append(harness.usage([*python, *command], environment, there))
        least = {k: min(r[k] for r in runs) for k in ("wall s", "cpu s")}
        rows.append({"what": name} | least)

    add("python", ["-c", "pass"])
    add("marlyap --help", ["-m", "marlyap", "--help"])
    add("import marlyap", ["-c", "import marlyap"])
    if not args.quick:
        add(
            "import JAX and all of marlyap",
            ["-c", "import marlyap.cli.training, marlyap.cli.claims, marlyap.film"],
        )
        with tempfile.TemporaryDirectory() as folder:
            cache = {"JAX_COMPILATION_CACHE_DIR": str(Path(folder, "cache"))}
            train = lambda n: ["-m", "marlyap", *TRAIN.split(), "2560", "--out", f"{folder}/{n}"]
            add("first training, one iteration", train(0), cache, 1)
            add("the same, programs kept", train(1), cache, 1)
            add("the same again", train(2), cache, 1)
            one = ["5120", "--schedule.steps_per_update", "2560", "--force", "--out"]
            first = ["-m", "marlyap", *TRAIN.split(), *one, f"{folder}/one"]
            log = Path(folder, "one/seed0/log.jsonl")
            for name, settings in (("", cache), (", traced anew", cache | {FOLDER: ""})):
                harness.usage([*python, *first], settings)
                add(f"until its first update{name}", first, settings, args.repeats, log)
    return harness.report("startup", rows, args)


if __name__ == "__main__":
    main()
