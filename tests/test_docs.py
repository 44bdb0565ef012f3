"""Every Python block of the README and the docs runs as written; long trainings are shortened."""

import importlib.util
import re
from pathlib import Path

import jax
import pytest


ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHORT = {r"steps=[\d_]+": "steps=640, environments=4, warmup=160, select_episodes=20"}
SHORT[r"range\(4\)"] = "range(1)"  # training seeds: each is a process


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.S | re.M)


WITH_CODE = [page for page in PAGES if blocks(page)]


def test_there_are_pages_with_code():
    assert {"README.md", "add-a-task.md", "paper.md"} <= {page.name for page in WITH_CODE}


@pytest.mark.parametrize("page", WITH_CODE, ids=lambda page: page.name)
def test_code_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some blocks write runs
    names: dict = {"__name__": f"docs_{page.stem}"}
    for k, block in enumerate(blocks(page)):
        if "Schedule(steps=960" not in block:
            for pattern, short in SHORT.items():
                block = re.sub(pattern, short, block)
        with jax.numpy_rank_promotion("allow"):  # as in a user's program
            exec(compile(block, f"{page.name}[{k}]", "exec"), names)


def maker(name: str):
    spec = importlib.util.spec_from_file_location(name, ROOT / f"docs/{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_is_what_the_docstrings_say():
    made = maker("make_reference")
    assert made.PAGE.read_text() == made.page(), "run docs/make_reference.py"


def test_the_pages_of_the_games_are_what_docstrings_and_bench_say():
    made = maker("make_games")
    for name, text in made.pages().items():
        assert (made.FOLDER / name).read_text() == text, "run docs/make_games.py"


def test_links_in_the_pages_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert "://" in target or (page.parent / target).exists(), f"{page.name}: {target}"
