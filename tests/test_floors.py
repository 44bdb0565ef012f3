"""The house stands: imports only go down, and what is dangerous or heavy stays where it belongs."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import marlyap


# Bottom first. A folder, or a module beside the folders, may import those above it in this table
# only. Within a folder imports must not go in circles. A new folder needs one line here.
FLOORS = """
    errors
    types
    seeds
    statistics
    threefry
    graph
    recheck
    storage
    compute
    games
    tasks
    hosts
    simulation
    nets
    controllers
    shields
    learning
    certificates
    conformance
    runs
    sweeps
    report
    deploy
    outside
    pettingzoo
    gymnasium
    cli
    __main__
""".split()

ROOT = Path(marlyap.__file__).parent
FILES = sorted(p for p in ROOT.rglob("*.py") if "__pycache__" not in p.parts)
NAMES = {
    ".".join(("marlyap", *p.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
    for p in FILES
}
TREES = {p: ast.parse(p.read_text()) for p in FILES}
each_file = pytest.mark.parametrize("file", FILES, ids=lambda p: str(p.relative_to(ROOT)))


def module(file):
    """The dotted name of a file."""
    return ".".join(("marlyap", *file.relative_to(ROOT).with_suffix("").parts)).removesuffix(
        ".__init__"
    )


def imported(file, tree=None):
    """Every module that a file imports, wherever in it, `from package import module` included."""
    found = set()
    package = module(file).split(".") if file.stem == "__init__" else module(file).split(".")[:-1]
    for node in ast.walk(tree or TREES[file]):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            start = ".".join([*base, *([node.module] if node.module else [])])
            below = {f"{start}.{alias.name}" for alias in node.names} & NAMES
            whole = len(below) < len(node.names)
            found |= below | ({start} if whole else set())
    return found


def own(file):
    return {name for name in imported(file) if name.split(".")[0] == "marlyap"}


def floor(name):
    """The line of the table a module is on; a module without one counts as the lowest."""
    return FLOORS.index(name.split(".")[1]) if name.split(".")[1] in FLOORS else -1


@each_file
def test_every_module_has_a_floor(file):
    name = module(file).split(".")
    assert len(name) == 1 or name[1] in FLOORS, f"add {name[1]} to FLOORS in {__file__}"


@each_file
def test_imports_only_go_down(file):
    here = module(file)
    if here == "marlyap" or here.split(".")[1] not in FLOORS:  # public names; told above
        return
    for name in own(file):
        assert name != "marlyap", f"{here} imports the package itself"
        same_package = (
            name.split(".")[1] == here.split(".")[1] and (ROOT / here.split(".")[1]).is_dir()
        )
        assert same_package or floor(name) < floor(here), f"{here} imports {name}"


def test_no_circles():
    uses = {module(f): own(f) - {module(f)} for f in FILES}
    done = {"marlyap"}
    while rest := {m: u - done for m, u in uses.items() if m not in done}:
        free = {m for m, u in rest.items() if not u}
        assert free, f"imports go in a circle among {sorted(rest)}"
        done |= free


def test_the_walk_sees_every_form_of_import():
    source = """
import marlyap.storage.store as s
from marlyap import graph as graphs, errors
from marlyap.types import Key
def later():
    from ..simulation import evaluation
    from ..learning.algorithms.masac import MASAC
    import os.path
"""
    found = imported(ROOT / "learning/trainer.py", ast.parse(source))
    assert found == {
        "marlyap.storage.store", "marlyap.graph", "marlyap.errors", "marlyap.types",
        "marlyap.simulation.evaluation", "marlyap.learning.algorithms.masac", "os.path",
    }  # fmt: skip


def test_an_upward_import_is_noticed(monkeypatch):
    file = ROOT / "games/game.py"
    bad = ast.parse("def f():\n    from marlyap.learning.trainer import Trainer\n")
    monkeypatch.setitem(TREES, file, bad)
    with pytest.raises(
        AssertionError, match=re.escape("marlyap.games.game imports marlyap.learning.trainer")
    ):
        test_imports_only_go_down(file)


@each_file
def test_only_pictures_import_matplotlib(file):
    """Matplotlib and Pillow stay out of training: their modules are imported when one draws."""
    names = ("bench", "curves", "gif", "interactive", "mp4", "page", "paper", "plot", "png")
    drawing = {f"marlyap.report.{name}" for name in names}
    if module(file) not in drawing:
        assert not {
            name for name in imported(file) if name.split(".")[0] in ("matplotlib", "PIL", "bokeh")
        }
        first = [node for node in TREES[file].body if isinstance(node, ast.Import | ast.ImportFrom)]
        assert not imported(file, ast.Module(first, [])) & drawing, "import it where one draws"
    text = file.read_text()
    assert not re.search(r"import_module|__import__", text) or "matplotlib" not in text


def test_what_is_told_of_runs_needs_no_matplotlib():
    code = "import sys, marlyap.report.contents; print({'PIL', 'matplotlib'} & {*sys.modules})"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "set()"


@each_file
def test_nothing_runs_what_it_reads(file):
    unsafe = {"pickle", "cloudpickle", "dill", "marshal", "shelve", "joblib"}
    assert not {name.split(".")[0] for name in imported(file)} & unsafe
    for node in ast.walk(TREES[file]):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            assert name not in ("eval", "exec", "compile"), f"line {node.lineno}"
            allows = {k.arg: k.value for k in node.keywords}.get("allow_pickle")
            assert allows is None or ast.unparse(allows) == "False", f"line {node.lineno}"


def test_annotations_are_executed():
    from marlyap.games.sensing import into_frame

    with pytest.raises(Exception, match="(?i)type-check|beartype"):
        into_frame(jnp.ones(3), jnp.ones((4, 2)))


def test_rank_promotion_raises():
    with pytest.raises(ValueError, match="rank_promotion"):
        jax.jit(lambda x, y: x + y)(jnp.ones(3), jnp.ones((2, 3)))
