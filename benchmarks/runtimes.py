"""How long one robot of a bundle takes for a step: observation, network, limits and checks.

Every call is timed alone, over golden pairs without faults. C is compiled here with each of the
flags and times itself; without a compiler it is left out, as ONNX is without onnxruntime.

    python benchmarks/runtimes.py --core 0 --bundle bundle

Without a bundle, one of a random policy of the demo's size is made.
"""

import math
import subprocess
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import equinox as eqx
import harness
import jax
import numpy as np

from marlyap import MASAC, Rendezvous
from marlyap.deploy import bundle, contract as contracts
from marlyap.deploy.check import pairs_of
from marlyap.deploy.contract import GOLDEN, SOURCE
from marlyap.deploy.runtime import Role, read_arrays
from marlyap.deploy.verify import compiler
from marlyap.learning.source import shape
from marlyap.learning.trainer import Schedule, Trainer
from marlyap.runs.run import Run, flatten
from marlyap.storage import store


FLAGS = ["-O2", "-O3 -march=native"]
CLOCK = """#define _POSIX_C_SOURCE 199309L
#include "controller.h"
#include <stdio.h>
#include <time.h>

int main(void)
{
    float own[MARLYAP_STATE], goal[2], heard[MARLYAP_SLOTS * MARLYAP_MESSAGE];
    float flags[MARLYAP_SLOTS], command[MARLYAP_INPUTS];
    unsigned char present[MARLYAP_SLOTS];
    long k, j, count = %(count)d;
    if (fread(own, sizeof own, 1, stdin) + fread(goal, sizeof goal, 1, stdin) != 2) return 1;
    if (fread(heard, sizeof heard, 1, stdin) + fread(flags, sizeof flags, 1, stdin) != 2) return 1;
    for (j = 0; j < MARLYAP_SLOTS; j++) present[j] = flags[j] > 0.5f;
    for (k = 0; k < count; k++) {
        struct timespec a, b;
        clock_gettime(CLOCK_MONOTONIC, &a);
        for (j = 0; j < 10; j++) {
            own[0] += 1e-6f;
            marlyap_agent_0(own, 0.0f, goal, heard, present, command);
        }
        clock_gettime(CLOCK_MONOTONIC, &b);
        printf("%%.3f\\n", ((b.tv_sec - a.tv_sec) * 1e9 + (b.tv_nsec - a.tv_nsec)) / 1e4);
    }
    return command[0] > 1e30f;
}
"""


def made(folder: Path) -> Path:
    """The bundle of a random policy of the demo's size."""
    game, rule = Rendezvous(horizon=10), MASAC()
    run = Run.create(folder / "run", Trainer(game, rule, Schedule()), 0, {"task": "rendezvous"})
    networks = eqx.filter_jit(rule.init)(shape(game), jax.random.key(0))
    deployed = rule.policy(networks), rule.lyapunov(networks)
    store.write(run.directory / "policy", "policy", flatten(deployed), {})
    runtimes = [name for name in ("numpy", "onnx", "c") if name != "onnx" or find_spec("onnx")]
    bundle.write(run, folder / "bundle", runtimes, starts=0)
    return folder / "bundle"


def timed(step: Callable[[], Any], count: int) -> np.ndarray:
    """Microseconds of each of `count` calls."""
    found = np.empty(count)
    for k in range(count):
        begun = time.perf_counter_ns()
        step()
        found[k] = time.perf_counter_ns() - begun
    return found / 1e3


def numpy_step(place: Path, given: dict[str, np.ndarray]) -> Callable[[], Any]:
    robot = Role.load(place, "agent_0")
    asked = [given[k][0] for k in ("own", "goal", "neighbours", "present")]
    return lambda: robot.command(*asked, 0.0)


def onnx_step(place: Path, given: dict[str, np.ndarray]) -> Callable[[], Any]:
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    session = ort.InferenceSession(str(place / "agent_0.onnx"), options)
    shapes = {node.name: node.shape for node in session.get_inputs()}
    asked = {k: np.asarray(given[k][0], np.float32).reshape(s) for k, s in shapes.items()}
    return lambda: session.run(None, asked)


def c_times(place: Path, given: dict[str, np.ndarray], flags: str, count: int) -> np.ndarray:
    """Microseconds of each call, as the program timed itself: ten calls at a time."""
    with tempfile.TemporaryDirectory() as folder:
        main, program = Path(folder, "main.c"), Path(folder, "clock")
        main.write_text(CLOCK % {"count": count})
        words = [compiler() or "cc", "-std=c99", *flags.split(), f"-I{place}", str(main)]
        subprocess.run([*words, str(place / SOURCE), "-o", str(program), "-lm"], check=True)
        parts = [given[k][0].astype("<f4").tobytes() for k in ("own", "goal", "neighbours")]
        asked = b"".join([*parts, given["present"][0].astype("<f4").tobytes()])
        said = subprocess.run([str(program)], input=asked, capture_output=True, check=True)
    return np.array([float(line) for line in said.stdout.split()])


def main(argv=None):
    args = harness.arguments(argv, __doc__, bundle="", count=20_000)
    count = 50 if args.quick else args.count
    with tempfile.TemporaryDirectory() as folder:
        place = Path(args.bundle).resolve() if args.bundle else made(Path(folder))
        contract = contracts.load(place)
        given = pairs_of(read_arrays(place / GOLDEN), "agent_0")
        times = {"numpy": timed(numpy_step(place, given), count)}
        if find_spec("onnxruntime") and "onnx" in contracts.runtimes(contract):
            times["onnx"] = timed(onnx_step(place, given), count)
        if compiler():
            times |= {f"c {flags}": c_times(place, given, flags, count) for flags in FLAGS}
        size = sum(path.stat().st_size for path in place.iterdir())
    rows = [
        {"runtime": name, **{f"p{q} us": float(np.percentile(t, q)) for q in (1, 50, 99)}}
        for name, t in times.items()
    ]
    harness.report("runtimes", rows, args, **{"bundle KB": math.ceil(size / 1000)})


if __name__ == "__main__":
    main()
