"""The tutorial of docs/robots.md runs as written: from train to three processes that meet."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest


PAGE = Path(__file__).parents[1] / "docs/robots.md"


def commands():
    """The commands of the tutorial."""
    tutorial = PAGE.read_text().partition("## Tutorial")[2].partition("\n## ")[0]
    return re.findall(r"^    marlyap (.*)$", tutorial, re.M)


def test_the_tutorial_is_whole():
    verbs = [words.split()[0] for words in commands()]
    assert verbs == ["train", "export", "verify", "swarm", "swarm", "bag"]


@pytest.mark.slow
def test_the_tutorial_runs(tmp_path):
    for package in ("onnx", "zenoh", "rosbags"):
        pytest.importorskip(package)
    plain = {k: v for k, v in os.environ.items() if k != "JAX_DISABLE_MOST_OPTIMIZATIONS"}
    for words in commands():
        command = [sys.executable, "-m", "marlyap", *shlex.split(words)]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=plain)
        assert done.returncode == 0, (words, done.stderr)
    result = json.loads((tmp_path / "swarm/swarm.json").read_text())
    assert result["episodes"] == 3 and result["successes"] >= 2
    assert (tmp_path / "swarm/film.gif").is_file() and (tmp_path / "episode.mcap").is_file()
    size = sum(path.stat().st_size for path in (tmp_path / "bundle").iterdir())
    assert size <= 800_000
