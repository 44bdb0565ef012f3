"""Where a figure was made: the machine, its processor, and the commit of the source."""

import platform
import subprocess
from functools import cache
from pathlib import Path


SOURCE = Path(__file__).parents[1]  # all of the package


@cache
def provenance() -> dict[str, str]:
    """Machine, processor and commit as text; empty where one is not known.

    A commit ends in + where files that it holds have been changed since. Training is repeated to
    the bit on the same kind of machine alone, so a figure of a trained policy is one of these.
    """
    return {"machine": platform.machine(), "cpu": _cpu(), "commit": _commit()}


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor()


def _commit() -> str:
    def git(*words: str) -> str:
        return subprocess.check_output(
            ["git", "-C", str(SOURCE), *words], text=True, stderr=subprocess.DEVNULL, timeout=10
        ).strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ".")
        return git("rev-parse", "HEAD") + "+" * bool(changed)
    except (OSError, subprocess.SubprocessError):
        return ""
