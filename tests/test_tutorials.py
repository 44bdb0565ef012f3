"""Tutorials run as written, each is a notebook too, and everyone can read them."""

import importlib.util
import json
import re
from pathlib import Path

import jax
import pytest


ROOT = Path(__file__).parents[1]
TUTORIALS = sorted((ROOT / "docs/tutorials").glob("*.md"))
BLOCK = re.compile(r"^```python\n(.*?)^```", re.S | re.M)
QUICK = {
    r"steps=[\d_]+": "steps=640, environments=4, warmup=160, select_episodes=20",
    r"ROLLOUTS = [\d_]+": "ROLLOUTS = 200",
    r"episodes=\d+": "episodes=20",
}
LONGEST = 35  # words of a sentence


def ids(page: Path) -> str:
    return page.stem


def run(page: Path) -> dict:
    """Every block of a page in its quick form."""
    names: dict = {"__name__": f"tutorial_{page.stem}"}
    for k, block in enumerate(BLOCK.findall(page.read_text())):
        for pattern, short in QUICK.items():
            block = re.sub(pattern, short, block)
        with jax.numpy_rank_promotion("allow"):  # as in a user's program
            exec(compile(block, f"{page.name}[{k}]", "exec"), names)
    return names


@pytest.mark.slow
def test_my_own_game(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(ROOT / "docs/tutorials/own-game.md")
    assert names["broken"] == []
    assert (tmp_path / "rooms.gif").read_bytes()[:3] == b"GIF"
    assert "temperature (degrees)" in (tmp_path / "rooms.html").read_text()


@pytest.mark.slow
def test_certify(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(ROOT / "docs/tutorials/certify.md")
    assert {*names["result"]["verdicts"]} | {*names["result"]["left_out"]} == {*names["asked"]}
    assert (tmp_path / "worst.gif").read_bytes()[:3] == b"GIF"


def maker():
    spec = importlib.util.spec_from_file_location("notebooks", ROOT / "docs/make_notebooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", TUTORIALS, ids=ids)
def test_each_is_a_notebook(page):
    text = page.read_text()
    if not BLOCK.search(text):
        pytest.skip("it has no Python")
    made = maker().notebook(text)
    assert page.with_suffix(".ipynb").read_text() == made, "run docs/make_notebooks.py"
    code = ["".join(c["source"]) for c in json.loads(made)["cells"] if c["cell_type"] == "code"]
    assert code == [block.strip("\n") for block in BLOCK.findall(text)]


# ---- plain language ----


def sentences(text: str) -> list[str]:
    """The sentences of a page; an item, a cell of a table and a heading end one."""
    text = re.sub(r"^```.*?^```", "\n\n", text, flags=re.S | re.M)
    text = re.sub(r"^(    |\t).*$", "", text, flags=re.M)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"^\|[-| :]+\|$", "", text, flags=re.M)
    text = re.sub(r"^\s*(#+ .*|[-*] |\d+\. )", lambda m: "\n\n" + m[0], text, flags=re.M)
    text = re.sub(r"^(#+ .*)$", r"\1\n", text, flags=re.M)
    parts = [
        cell for block in re.split(r"\n\s*\n", text) for cell in re.split(r"\||\n(?=\|)", block)
    ]
    return [
        s.strip() for part in parts for s in re.split(r"(?<=[.!?])[*\"')]*\s+", part) if s.strip()
    ]


def words(sentence: str) -> list[str]:
    return re.findall(r"\S*\w\S*", sentence)


@pytest.mark.parametrize("page", [ROOT / "README.md", *TUTORIALS], ids=ids)
def test_sentences_are_short(page):
    long = [s for s in sentences(page.read_text()) if len(words(s)) > LONGEST]
    assert long == [], f"{page.name}: at most {LONGEST} words a sentence"


def test_long_sentences_are_noticed():
    text = f"# Head\n\n{'word ' * 36}end.\n\n* {'item ' * 20}\n* {'item ' * 20}\n"
    assert [len(words(s)) for s in sentences(text)] == [2 - 1, 37, 20, 20]
