"""Every benchmark runs in its quick form and says what it was made to say."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest


FOLDER = Path(__file__).parents[1] / "benchmarks"
OTHERS = ("harness", "peer_benchmarl", "house")
SCRIPTS = sorted(p.stem for p in FOLDER.glob("*.py") if p.stem not in OTHERS)
COLUMNS = {
    "agents": {"agents", "updates/s", "growth"},
    "checkpoint": {"agents", "transitions", "save s", "share %"},
    "environment": {"agents", "environments", "steps/s"},
    "memory": {"agents", "peak MB"},
    "peer": {"agents", "who", "steps and updates/s"},
    "runtimes": {"runtime", "p50 us", "p99 us"},
    "seeds": {"way", "seeds", "seeds/hour", "to one"},
    "startup": {"what", "cpu s"},
    "sweep": {"what", "cpu s"},
    "update": {"updates/s", "needed MFLOP", "done MFLOP", "of floor", "to plain"},
}


def test_every_benchmark_is_known():
    assert SCRIPTS == sorted(COLUMNS)


@pytest.fixture
def benchmarks(monkeypatch):
    """Scripts see the folder they lie in, as when they are started by hand."""
    monkeypatch.syspath_prepend(str(FOLDER))
    return lambda name: runpy.run_path(str(FOLDER / f"{name}.py"))


SLOW = [
    pytest.param(name, marks=pytest.mark.slow)
    for name in ("agents", "peer", "runtimes", "startup", "sweep")
]


@pytest.mark.parametrize("name", ["checkpoint", "environment", "update", *SLOW])
def test_quick(name, benchmarks, tmp_path, capsys):
    benchmarks(name)["main"](["--quick", "--out", str(tmp_path)])
    written = json.loads((tmp_path / f"{name}-quick.json").read_text())
    assert written["benchmark"] == name and written["machine"]["jax"]
    assert written["rows"] and all(COLUMNS[name] <= row.keys() for row in written["rows"])
    assert str(max(COLUMNS[name])) in capsys.readouterr().out
    if name == "update":  # no matrix product is computed twice, and none for nothing
        for row in written["rows"]:
            assert row["done MFLOP"] <= 1.001 * row["needed MFLOP"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["memory", "seeds"])
def test_quick_with_processes(name, tmp_path):
    command = [sys.executable, str(FOLDER / f"{name}.py"), "--quick", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True)
    written = json.loads((tmp_path / f"{name}-quick.json").read_text())
    assert written["rows"] and all(COLUMNS[name] <= row.keys() for row in written["rows"][1:])


def test_products_of_a_program(benchmarks):
    """Two products in a loop and one outside; the body of the loop counts once."""
    import jax
    import jax.numpy as jnp

    harness = benchmarks("harness")

    def f(w, x):
        x = jax.lax.fori_loop(0, 7, lambda _, x: jnp.tanh(w @ jnp.tanh(w @ x)), x)
        return jnp.einsum("oi,nib->nob", w, jnp.stack([x, x + 1]))

    w, x = jnp.ones((48, 48)), jnp.ones((48, 40))
    found = harness["products"](jax.jit(f).lower(w, x).compile().as_text())
    assert harness["flops"](found) == (2 + 2) * 2 * 48 * 48 * 40


def test_needed_is_counted_by_hand(benchmarks):
    """The smallest of all updates, written out."""
    from marlyap import MASAC
    from marlyap.nets.nets import Shape

    needed = benchmarks("update")["needed"]
    one = MASAC(batch=1, actor_width=1, critic_width=1, heads="team")
    actor = 2 * (2 + 1 + 2)  # 2-1-1-2
    critic = 2 * (4 + 1 + 1)  # 4-1-1-1
    want = (3 * actor - 2 * 2) + actor + 2 * (critic + (3 * critic - 2 * 4) + 2 * critic)
    assert needed(one, Shape(agents=1, obs=2, features=3, errors=2, du=1)) == want


def test_the_layout_is_counted(benchmarks):
    files = {
        "marlyap/__init__.py": "from marlyap.games.game import play\n",
        "marlyap/errors.py": "import os\n",
        "marlyap/games/__init__.py": "",
        "marlyap/games/plant.py": "from marlyap import errors\n",
        "marlyap/games/game.py": "def play():\n    import marlyap.games.plant\n    return 1\n",
        "marlyap/runs/run.py": "from marlyap.games import game\nfrom marlyap.errors import x, y\n",
    }
    assert benchmarks("house")["counts"](files) == {
        "folders": 2,
        "modules beside the folders": 1,
        "files": 5,
        "lines": 8,
        "arrows between units": 3,  # games to errors, runs to games and to errors
        "depth of imports": 3,
        "longest file": "marlyap/games/game.py (3)",
        "longest function": "marlyap/games/game.py: play (3)",
        "functions of more than 40 lines": 0,
    }
