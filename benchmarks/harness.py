"""What every benchmark shares: one core, fair turns, counts of arithmetic, a table and a JSON file.

A busy machine slows everything down by turns, so what is to be compared is measured in one process,
turn about, and a ratio of two medians (or of two minima) means more than either of them.
"""

import argparse
import json
import math
import os
import platform
import re
import resource
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from subprocess import PIPE
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from marlyap.games.game import AbstractGame
from marlyap.learning.off_policy import AbstractOffPolicy
from marlyap.learning.trainer import Schedule, Trainer


READY = "ready"
RESULTS = Path(__file__).parent / "results"
Row = dict[str, Any]


def arguments(argv: Sequence[str] | None, doc: str | None, **extra: Any) -> argparse.Namespace:
    """--quick, --out, --core, and one option for each of `extra` (its value is the default)."""
    p = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--quick", action="store_true", help="tiny sizes: only shows that it runs")
    p.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    p.add_argument("--core", type=int, default=None, help="run on this core alone")
    for name, default in extra.items():
        many = isinstance(default, (list, tuple))
        kind = type(default[0] if many else default)
        option = "--" + name.replace("_", "-")
        p.add_argument(option, type=kind, default=default, nargs="+" if many else None)
    args = p.parse_args(argv)
    core = os.environ.get("BENCHMARK_CORE") if args.core is None else args.core
    if core is not None:
        pin(int(core))
    return args


def pin(core: int) -> None:
    """Keep this process, and JAX's threads if it has not begun yet, on one core."""
    os.environ["NPROC"] = "1"
    os.sched_setaffinity(0, {core})


def last_core() -> int:
    """The core that the rest of the system is likeliest to leave alone."""
    return max(os.sched_getaffinity(0))


@dataclass(frozen=True)
class Timing:
    """Seconds of one call: the median and least by the clock, and the least of the processor."""

    median: float
    best: float
    cpu: float

    def per(self, count: float) -> "Timing":
        """The same for one of `count` equal parts."""
        return Timing(self.median / count, self.best / count, self.cpu / count)


def turns(jobs: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, Timing]:
    """Call every job once a round; the first call of each does not count."""
    for job in jobs.values():
        job()
    walls: dict[str, list[float]] = {name: [] for name in jobs}
    cpus: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, job in jobs.items():
            wall, cpu = time.perf_counter(), time.process_time()
            job()
            walls[name].append(time.perf_counter() - wall)
            cpus[name].append(time.process_time() - cpu)
    return {
        name: Timing(statistics.median(walls[name]), min(walls[name]), min(cpus[name]))
        for name in jobs
    }


@dataclass(frozen=True)
class Updates:
    """A compiled scan of `count` updates from a full memory."""

    run: Callable[[], Any]
    count: int
    xla: float  # XLA's own count of floating-point operations of one update
    products: Counter  # how often each matrix product is computed in one update
    memory: int  # bytes of scratch memory that XLA sets aside


def updates(
    game: AbstractGame, algorithm: AbstractOffPolicy, count: int, episodes: int = 64
) -> Updates:
    """`count` updates, a divisor of the horizon, from `episodes` random episodes, compiled."""
    trainer = Trainer(
        game,
        algorithm,
        Schedule(
            steps=episodes * game.horizon,
            environments=1,
            steps_per_update=game.horizon // count,
            warmup=episodes * game.horizon,
            capacity=1,
        ),
    )
    learner = eqx.filter_jit(trainer.begin)(jax.random.key(0))[0].learner
    dynamic, static = eqx.partition(learner.networks, eqx.is_array)
    updates = trainer.updates_per_iteration

    def several(dynamic, memory, key):
        networks = eqx.combine(dynamic, static)
        networks, _, _ = algorithm.improve(networks, memory, updates, key, jnp.ones(()))
        return eqx.filter(networks, eqx.is_array)

    key = jax.random.key(1)
    compiled = jax.jit(several).lower(dynamic, learner.memory, key).compile()
    return Updates(
        run=lambda: jax.block_until_ready(compiled(dynamic, learner.memory, key)),
        count=updates,
        xla=(compiled.cost_analysis() or {}).get("flops", math.nan),
        products=Counter({p: k for p, k in products(compiled.as_text()).items() if p.proper}),
        memory=compiled.memory_analysis().temp_size_in_bytes,
    )


@dataclass(frozen=True)
class Product:
    """One matrix product: the shapes of its operands and which axes meet."""

    left: tuple[int, ...]
    right: tuple[int, ...]
    axes: Any  # lax.dot_general's dimension_numbers

    @property
    def flops(self) -> int:
        """Multiplications and additions."""
        (contract, _), (batch, _) = self.axes
        inner = math.prod(self.left[i] for i in contract)
        stack = math.prod(self.left[i] for i in batch)
        return 2 * math.prod(self.left) * math.prod(self.right) // (inner * stack)

    @property
    def proper(self) -> bool:
        """Not with a single row or column, as where a sum is written as a product with ones.

        The last layer of a critic with one value for the team goes with them.
        """
        (contract, other), (batch, beside) = self.axes
        free = lambda shape, gone: math.prod(n for i, n in enumerate(shape) if i not in gone)
        return min(free(self.left, contract + batch), free(self.right, other + beside)) > 1

    def job(self, repeats: int) -> Callable[[], Any]:
        """`repeats` such products one after the other, compiled."""
        x = jax.random.normal(jax.random.key(0), self.left)
        w = jax.random.normal(jax.random.key(1), self.right)

        def chain(x, w):  # a scalar of each result enters the next operand, the smaller one
            first = x.size <= w.size
            nudge = lambda a, s, yes: a + s if yes else a
            dot = lambda s: jax.lax.dot_general(
                nudge(x, s, first), nudge(w, s, not first), self.axes
            )
            step = lambda s, _: (1e-9 * dot(s).ravel()[0], None)
            return jax.lax.scan(step, jnp.zeros(()), None, length=repeats)[0]

        compiled = jax.jit(chain).lower(x, w).compile()
        return lambda: jax.block_until_ready(compiled(x, w))


def products(program: str) -> Counter:
    """How often each matrix product stands in a compiled program; a loop's body counts once."""
    name, shapes, found = r"%([\w.\-]+)", {}, Counter()
    for line in program.splitlines():
        if not (made := re.match(rf"\s*(?:ROOT )?{name} = \w+\[([\d,]*)\]", line)):
            continue
        shapes[made[1]] = tuple(int(d) for d in made[2].split(",") if d)
        if dot := re.search(rf" dot\({name}, {name}\)", line):
            contract, batch = (
                tuple(_braces(f"{side}_{kind}_dims", line) for side in ("lhs", "rhs"))
                for kind in ("contracting", "batch")
            )
            found[Product(shapes[dot[1]], shapes[dot[2]], (contract, batch))] += 1
    return found


def _braces(key: str, line: str) -> tuple[int, ...]:
    inside = re.search(rf"{key}={{([\d,]*)}}", line)
    return tuple(int(i) for i in inside[1].split(",")) if inside else ()


def flops(products: Counter) -> float:
    """Multiplications and additions in matrix products."""
    return sum(p.flops * count for p, count in products.items())


# Without its newer library XLA computes large products, and only these, up to half faster.
KERNELS = {"XLA's default": {}, "XLA's Eigen": {"xla_cpu_experimental_ynn_fusion_type": ""}}


def ceilings(size: int = 2048) -> tuple[dict[str, Callable[[], Any]], float]:
    """One product of two large square matrices, by each kernel there is, and its operations.

    The fastest says what the machine can do.
    """
    x = jax.random.normal(jax.random.key(0), (size, size))
    square, found = jax.jit(lambda x: x @ x).lower(x), {}
    for name, options in KERNELS.items():
        try:
            compiled = square.compile(compiler_options=options)
        except jax.errors.JaxRuntimeError:  # another version of XLA, without the option
            continue
        found[name] = lambda compiled=compiled: jax.block_until_ready(compiled(x))
    return found, 2.0 * size**3


def children(commands: Sequence[Sequence[str]], cores: Sequence[int]) -> list[Row]:
    """Run Python programs at once, one a core; each says it is ready, is told to go, and answers.

    Such a program calls `ready` and prints one JSON object.
    """
    started = []
    for command, core in zip(commands, cores, strict=True):
        core_env = os.environ | {"NPROC": "1", "BENCHMARK_CORE": str(core)}
        started.append(
            subprocess.Popen(
                [sys.executable, *command], stdin=PIPE, stdout=PIPE, text=True, env=core_env
            )
        )
    for child in started:
        if child.stdout.readline().strip() != READY:
            raise SystemExit(f"{' '.join(child.args)} failed.")
    for child in started:
        child.stdin.write("go\n")
        child.stdin.flush()
    return [json.loads(child.communicate()[0].splitlines()[-1]) for child in started]


def ready() -> None:
    """In a child: wait for the others."""
    print(READY, flush=True)
    sys.stdin.readline()


def usage(
    command: Sequence[str],
    environment: Mapping[str, str] | None = None,
    until: Callable[[], bool] | None = None,
) -> Row:
    """Wall and processor seconds of a whole process, or until something is there, and its words."""
    wall = time.perf_counter()
    child = subprocess.Popen(
        command, env=os.environ | dict(environment or {}), stdout=PIPE, stderr=PIPE, text=True
    )
    # Whether it runs is asked without reaping it: its times are read below.
    runs = lambda: not os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    while until and runs():
        if until():
            child.kill()
            break
        time.sleep(0.005)
    said, wrong = child.stdout.read(), child.stderr.read()
    _, status, used = os.wait4(child.pid, 0)
    if status and not (until and until()):
        raise SystemExit(f"{' '.join(command)} failed:\n{wrong}")
    return {
        "wall s": time.perf_counter() - wall,
        "cpu s": used.ru_utime + used.ru_stime,
        "said": said,
    }


def report(name: str, rows: list[Row], args: argparse.Namespace, **about: Any) -> Row:
    """Print the rows as a table, write everything to NAME.json and return it."""
    result = {"benchmark": name, "quick": args.quick, **about, "machine": machine(), "rows": rows}
    print(f"\n{name}" + "".join(f"\n  {k}: {_show(v)}" for k, v in about.items()))
    print(table(rows))
    args.out.mkdir(parents=True, exist_ok=True)
    place = args.out / f"{name}{'-quick' if args.quick else ''}.json"
    place.write_text(json.dumps(result, indent=1) + "\n")
    return result


def table(rows: list[Row]) -> str:
    """Rows with the same keys as aligned columns."""
    heads = list(dict.fromkeys(k for row in rows for k in row))
    cells = [heads, *([_show(row.get(h, "")) for h in heads] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(heads))]
    return "\n".join(
        "  ".join(
            c.rjust(w) if j else c.ljust(w) for j, (c, w) in enumerate(zip(l, widths, strict=True))
        )
        for l in cells
    )


def _show(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)


def machine() -> Row:
    """What the figures were taken on, and how busy it was."""
    model = ""
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((l.split(":")[1].strip() for l in lines if l.startswith("model name")), "")
    return {
        "processor": model or platform.processor(),
        "cores": os.cpu_count(),
        "on_cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "device": jax.devices()[0].device_kind,
        "load": [round(x, 2) for x in os.getloadavg()],
        "python": platform.python_version(),
        "jax": jax.__version__,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
    }


def peak() -> float:
    """The most memory this process has had (MB); getrusage would count its parent's too."""
    status = Path("/proc/self/status")
    if status.exists():
        return int(re.search(r"VmHWM:\s+(\d+)", status.read_text())[1]) / 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def note(text: str) -> None:
    """Progress, for the person."""
    print(text, file=sys.stderr, flush=True)
