"""Re-run a bundle's golden pairs in each of its runtimes. No JAX is needed.

What is run is the bundle's own code: `runtime.py` in a process that can import neither JAX nor
marlyap, `controller.c` compiled here. The seal finds accidents and is no signature, so verify only
what you would put on a robot.
"""

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marlyap.deploy import c_source, contract as contracts
from marlyap.deploy.check import Agreement, Answer, Answers, agreement
from marlyap.deploy.contract import GOLDEN, RUNTIMES, SOURCE, Contract
from marlyap.deploy.extras import needs
from marlyap.deploy.runtime import read_arrays
from marlyap.errors import UserError


CFLAGS = "-O2"
LONGEST = 120  # s, of a compiler or a runtime
ALONE = """
import sys
sys.modules.update(dict.fromkeys(("jax", "marlyap", "onnx"), None))
sys.path.insert(0, sys.argv[1])
import runtime
golden = runtime.read_arrays(sys.argv[1] + "/golden.safetensors")
for name in sys.argv[2:]:
    head = name + "."
    given = {k[len(head):]: v for k, v in golden.items() if k.startswith(head)}
    command, fallback = runtime.answers(runtime.Role.load(sys.argv[1], name), given)
    sys.stdout.buffer.write(command.astype("<f4").tobytes() + fallback.astype("u1").tobytes())
"""
MAIN = """#include "controller.h"
#include <stdio.h>

#define READ(a, n) (fread(a, sizeof(float), n, stdin) == (size_t)(n))

int main(void)
{
    float count, which, command[MARLYAP_INPUTS];
%(arrays)s
    while (READ(&which, 1) && READ(&count, 1)) {
        long k, j;
        for (k = 0; k < (long)count; k++) {
            unsigned char fallback = 0;
%(reads)s
            switch ((int)which) {
%(cases)s            }
            (void)j;
            fwrite(command, sizeof(float), MARLYAP_INPUTS, stdout);
            fwrite(&fallback, 1, 1, stdout);
        }
    }
    return 0;
}
"""
ROBOT_ARRAYS = """
    float own[MARLYAP_STATE], age, goal[2], told, heard[%(slots)d], flags[%(slots)d];
    unsigned char present[%(slots)d];"""
ROBOT_READS = """
            if (!READ(own, MARLYAP_STATE) || !READ(&age, 1)) return 1;
            if (!READ(goal, 2) || !READ(&told, 1)) return 1;
            if (!READ(heard, MARLYAP_SLOTS * MARLYAP_MESSAGE) || !READ(flags, MARLYAP_SLOTS))
                return 1;
            for (j = 0; j < MARLYAP_SLOTS; j++) present[j] = flags[j] > 0.5f;"""
ROBOT_CALL = "(own, age, told > 0.5f ? goal : NULL, heard, present, command)"


class Found(NamedTuple):
    """What one runtime said."""

    runtime: str
    pairs: int
    worst: float  # the largest difference of an action
    fault: str  # empty: it agrees
    left_out: str = ""  # why it was not run


def verify(
    directory: Path, runtimes: Sequence[str] | None = None, cflags: str = CFLAGS
) -> list[Found]:
    """What each runtime of a bundle answers to the golden pairs.

    Arguments: runtimes, by default all that the bundle has; those whose tools are missing here are
    then left out, with the reason. cflags, for the C compiler.
    Raises UserError for a bundle that was altered, and for a runtime asked for that cannot be run.
    """
    contract = contracts.load(directory)
    there = contracts.runtimes(contract)
    for name in runtimes or ():
        if name not in there:
            raise UserError(f"with: {directory} has no {name}; it has {', '.join(there)}.")
    golden, found = read_arrays(directory / GOLDEN), []
    for name in runtimes or there:
        if missing := _missing(name):
            if runtimes:
                raise UserError(f"with: {name} needs {missing}.")
            found.append(Found(name, 0, 0.0, "", missing))
            continue
        match name:
            case "numpy":
                says = agreement(contract, golden, _numpy(directory, contract))
            case "onnx":
                says = agreement(contract, golden, _onnx(directory))
            case _:
                says = compiled(directory, contract, golden, cflags)
        found.append(Found(name, *says))
    return found


def compiler() -> str | None:
    """The C compiler: $CC, or cc or gcc where there is one."""
    return os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc")


def _missing(runtime: str) -> str:
    """What is not here to run it, and the mend; empty where all is."""
    if runtime == "onnx" and find_spec("onnxruntime") is None:
        return "onnxruntime, which pip install onnxruntime brings"
    if runtime == "c" and compiler() is None:
        return "a C compiler on PATH, or its name in CC"
    return ""


def _numpy(directory: Path, contract: Contract) -> Answers:
    """runtime.py in a process of its own."""
    names = [role["name"] for role in contract["roles"]]
    command = [sys.executable, "-I", "-B", "-c", ALONE, str(directory.resolve()), *names]
    raw = _run(command, "runtime.py")
    return _unpacked(raw, len(contract["action"]["channels"]), "command first")


def _unpacked(raw: bytes, inputs: int, order: str) -> Answers:
    """Answers that were written one role after the other."""
    at = 0

    def answer(role: dict[str, Any], given: Any) -> Answer:
        nonlocal at
        n = len(given["own"])
        size = n * (4 * inputs + 1)
        part, at = np.frombuffer(raw[at : at + size], np.uint8), at + size
        if len(part) != size:
            return np.zeros((0, inputs), np.float32), np.zeros(0, bool)
        if order == "command first":
            return part[: 4 * n * inputs].view("<f4").reshape(n, inputs), part[-n:].astype(bool)
        rows = part.reshape(n, 4 * inputs + 1)
        return np.ascontiguousarray(rows[:, :-1]).view("<f4"), rows[:, -1].astype(bool)

    return answer


def _onnx(directory: Path) -> Answers:
    """The ONNX files in onnxruntime."""
    ort = needs("onnxruntime", "verify --with onnx")
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3

    def answer(role: dict[str, Any], given: Any) -> Answer:
        path = str(directory / f"{role['name']}.onnx")
        session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        wanted = {node.name: node.shape for node in session.get_inputs()}
        named = {**given, "observation": given["own"]}
        rows = {k: np.asarray(named[k], np.float32) for k in wanted}
        asked = (
            {k: v[n].reshape(wanted[k]) for k, v in rows.items()} for n in range(len(given["own"]))
        )
        pairs = [session.run(["command", "fallback"], ask) for ask in asked]
        return np.stack([u for u, _ in pairs]), np.array([bool(f[0]) for _, f in pairs])

    return answer


def compiled(directory: Path, contract: Contract, golden: Any, cflags: str) -> Agreement:
    """The C source, compiled with these flags, in a process of its own.

    A source that does not compile disagrees, in the compiler's words.
    """
    with tempfile.TemporaryDirectory() as folder:
        main, program = Path(folder, "main.c"), Path(folder, "check")
        main.write_text(_main(contract))
        words = [compiler() or "cc", "-std=c99", *shlex.split(cflags), f"-I{directory.resolve()}"]
        words += [str(main), str(directory / SOURCE), "-o", str(program), "-lm"]
        built = subprocess.run(words, capture_output=True, text=True, timeout=LONGEST)
        if built.returncode:
            said = next((x for x in built.stderr.splitlines() if "error" in x), "no reason given")
            return Agreement(0, np.inf, f"{SOURCE} does not compile with {cflags}: {said}")
        asked = b"".join(_asked(contract, k, golden) for k in range(len(contract["roles"])))
        raw = _run([str(program)], SOURCE, asked)
    return agreement(contract, golden, _unpacked(raw, len(contract["action"]["channels"]), "rows"))


def _asked(contract: Contract, k: int, golden: Any) -> bytes:
    """The golden pairs of the k-th role as the C program reads them: floats, row by row."""
    name = contract["roles"][k]["name"]
    pick = lambda what: golden[f"{name}.{what}"].astype("<f4")
    own = pick("own")
    parts = [own, pick("age")[:, None]]
    if contract["sight"] is not None:
        parts += [pick("goal"), pick("told")[:, None]]
        parts += [pick("neighbours").reshape(len(own), -1), pick("present")]
    rows = np.concatenate(parts, axis=1)
    return np.array([k, len(own)], "<f4").tobytes() + rows.astype("<f4").tobytes()


def _main(contract: Contract) -> str:
    n, robots = c_source.sizes(contract), contract["sight"] is not None
    call = ROBOT_CALL if robots else "(own, age, command)"
    cases = "".join(
        f"            case {k}: fallback = (unsigned char)marlyap_{r['name']}{call}; break;\n"
        for k, r in enumerate(contract["roles"])
    )
    room = {"slots": max(1, n["slots"] * max(1, n["message"]))}
    plain = "            if (!READ(own, MARLYAP_OBSERVATION) || !READ(&age, 1)) return 1;"
    arrays = ROBOT_ARRAYS % room if robots else "    float own[MARLYAP_OBSERVATION], age;"
    return MAIN % {"arrays": arrays, "reads": ROBOT_READS if robots else plain, "cases": cases}


def _run(words: list[str], what: str, given: bytes | None = None) -> bytes:
    """The standard output of a process. Raises UserError where it fails."""
    alone = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    try:
        done = subprocess.run(words, input=given, capture_output=True, timeout=LONGEST, env=alone)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UserError(f"verify: {what} could not be run ({error}).") from None
    if done.returncode:
        said = (done.stderr.decode(errors="replace").strip().splitlines() or ["no reason given"])[
            -1
        ]
        raise UserError(f"verify: {what} failed: {said}.")
    return done.stdout


__all__ = ["CFLAGS", "RUNTIMES", "Found", "compiled", "compiler", "verify"]
