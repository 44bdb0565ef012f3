"""How long until something happens: help, import, the first update, and the same a second time.

Each is a fresh process, the least of several. The first start has an empty cache of compiled
programs; the second finds there what the first put in.

    python benchmarks/startup.py
"""

import sys
import tempfile
from pathlib import Path

import harness


TRAIN = "train rendezvous masac-lyapunov --seeds 0 --steps"


def main(argv=None):
    args = harness.arguments(argv, __doc__, repeats=3)
    if args.quick:
        args.repeats = 1
    python = [sys.executable]
    rows = []

    def add(name, command, environment=None, repeats=args.repeats):
        harness.note(name)
        runs = [harness.usage([*python, *command], environment) for _ in range(repeats)]
        least = {k: min(r[k] for r in runs) for k in ("wall s", "cpu s")}
        rows.append({"what": name} | least)

    add("python", ["-c", "pass"])
    add("marlyap --help", ["-m", "marlyap", "--help"])
    add("import marlyap", ["-c", "import marlyap"])
    if not args.quick:
        add("import JAX and all of marlyap", ["-c", "import marlyap.commands"])
        with tempfile.TemporaryDirectory() as folder:
            cache = {"JAX_COMPILATION_CACHE_DIR": str(Path(folder, "cache"))}
            train = lambda n: ["-m", "marlyap", *TRAIN.split(), "2560", "--out", f"{folder}/{n}"]
            add("first training, one iteration", train(0), cache, 1)
            add("the same, programs kept", train(1), cache, 1)
            add("the same again", train(2), cache, 1)
    return harness.report("startup", rows, args)


if __name__ == "__main__":
    main()
