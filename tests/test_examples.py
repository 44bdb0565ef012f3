"""The examples run as they are, on fewer steps, and are as short as they should be."""

import importlib.util
import json
from pathlib import Path

import pytest

from marlyap import MASAC, Schedule, evaluate, train


EXAMPLES = sorted(Path(__file__).parents[1].glob("examples/*.py"))
# The README's block is shortened to the same, so that they share what is compiled.
SMALL = dict(steps=640, environments=4, warmup=160, select_episodes=20)


def load(name):
    (path,) = (p for p in EXAMPLES if p.stem == name)
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return load("05_resume").main(tmp_path_factory.mktemp("example"), **SMALL)


def test_there_are_five_and_they_are_short():
    assert [path.stem[:2] for path in EXAMPLES] == ["01", "02", "03", "04", "05"]
    assert all(len(path.read_text().splitlines()) <= 40 for path in EXAMPLES)


def test_train(capsys):
    result = load("01_train").main(**SMALL)
    assert result["episodes"] == 500 and 0 <= result["success_rate"] <= 1
    assert "640 steps: success" in capsys.readouterr().out


def test_own_task():
    game = load("02_own_task").Corner()
    schedule = Schedule(steps=320, environments=2, warmup=80, select_episodes=4)
    small = MASAC(actor_width=4, critic_width=4, batch=4)
    trained = train(game, small, schedule)
    assert evaluate(game, trained.controller, 4).final.shape == (4,)


def test_compare():
    found = load("03_compare").main(episodes=20, **SMALL)
    assert set(found) == {"tree-pursuit", "gradient-consensus", "point-offset"}
    # Tree pursuit succeeds from every start; a policy from 640 steps does not.
    assert found["tree-pursuit"]["only_b"] > 10 and found["tree-pursuit"]["only_a"] == 0


def test_evaluate_and_draw(run, tmp_path):
    summary = load("04_evaluate_and_draw").main(run.directory, tmp_path)
    assert summary.episodes == 500
    assert (tmp_path / "film.gif").read_bytes()[:3] == b"GIF"
    assert (tmp_path / "starts.png").stat().st_size > 1000
    assert "<canvas" in (tmp_path / "report.html").read_text()


def test_resume(run):
    assert run.finished and run.steps_done == 640
    assert [line["iteration"] for line in run.history()] == [1, 2, 3, 4]


@pytest.mark.slow
def test_the_notebook(tmp_path, monkeypatch):
    """Its cells in their order, as Jupyter runs them, on fewer steps."""
    monkeypatch.chdir(tmp_path)
    book = json.loads((Path(__file__).parents[1] / "examples/06_sweep.ipynb").read_text())
    code = ["".join(cell["source"]) for cell in book["cells"] if cell["cell_type"] == "code"]
    assert not any(cell.get("outputs") for cell in book["cells"])
    few = '"schedule.steps": 640, "schedule.environments": 4, "schedule.warmup": 160'
    names: dict = {"__name__": "notebook"}
    for k, source in enumerate(code):
        source = source.replace('"schedule.steps": STEPS', few)
        exec(compile(source, f"notebook[{k}]", "exec"), names)
    assert {status.state for status in names["statuses"]} == {"finished"}
    assert (tmp_path / "rates.png").stat().st_size > 1000
