"""A copy of the package in which a line may be changed, to see whether the tests notice.

One process imports what is heavy and forks for every change, so that a change costs little more
than its tests. Nothing of marlyap is imported before the fork, and JAX starts no device.
"""

import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


ROOT = Path(__file__).parent.parent
PARTS = ("marlyap", "tests", "docs", "pyproject.toml", "README.md")


@contextmanager
def sandbox() -> Iterator[Path]:
    """A fresh copy of the package and its tests."""
    with tempfile.TemporaryDirectory() as place:
        for name in PARTS:
            source = ROOT / name
            if source.is_dir():
                ignore = shutil.ignore_patterns("__pycache__")
                shutil.copytree(source, Path(place, name), ignore=ignore)
            elif source.is_file():
                shutil.copy(source, Path(place, name))
        yield Path(place)


@contextmanager
def changed(place: Path, texts: dict[str, str]) -> Iterator[None]:
    """Other texts for some files, while it lasts."""
    before = {name: (place / name).read_text() for name in texts}
    try:
        for name, text in texts.items():
            (place / name).write_text(text)
        yield
    finally:
        for name, text in before.items():
            (place / name).write_text(text)


def run(place: Path, tests: list[str], limit: float = 600.0) -> tuple[str, float, str]:
    """pytest in a fork: ("passed" | "failed" | "time", seconds of CPU, the end of what it said)."""
    import equinox
    import jax
    import numpy
    import optax
    import pytest
    import scipy.special

    assert equinox and jax and numpy and optax and scipy
    assert not any(name.split(".")[0] == "marlyap" for name in sys.modules)
    said = place / "said.txt"
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        out = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(out, 1)
        os.dup2(out, 2)
        os.chdir(place)
        os.environ["PYTHONPATH"] = str(place)
        sys.path.insert(0, str(place))
        sys.dont_write_bytecode = True
        words = ["-c", "pyproject.toml", "--rootdir", ".", "-x", "-q", "-n", "0", "--tb=line"]
        os._exit(int(pytest.main([*words, "-p", "no:cacheprovider", *tests])))
    end, killed = time.monotonic() + limit, False
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid:
            break
        if time.monotonic() > end and not killed:
            killed = True
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.05)
    code = os.waitstatus_to_exitcode(status)
    tail = said.read_text(errors="replace").strip().splitlines()[-4:]
    verdict = "time" if killed else {0: "passed", 1: "failed"}.get(code, "failed")
    if code in (3, 4, 5):
        verdict = "broken"  # no test was run, or pytest itself failed; killed by a signal is failed
    return verdict, usage.ru_utime + usage.ru_stime, "\n".join(tail)
