"""The scripts that remove guards, make mutants and feed loaders fit what they are for."""

import ast
import importlib
import json
import re
from pathlib import Path

import pytest


ROOT = Path(__file__).parents[1]


@pytest.fixture
def scripts(monkeypatch):
    """Scripts see the folder they lie in, as when they are started by hand."""
    monkeypatch.syspath_prepend(str(ROOT / "reliability"))
    import guards
    import mutation
    import sandbox

    return guards, mutation, sandbox


def test_every_guard_stands_once_in_the_source_and_its_test_exists(scripts):
    guards, _, _ = scripts
    for guard in guards.GUARDS:
        source = (ROOT / guard.file).read_text()
        assert all(source.count(old) == 1 for old, _ in guard.changes), guard.kind
        file, _, name = guard.test.partition("::")
        assert f"def {name.partition('[')[0]}(" in (ROOT / file).read_text(), guard.kind
        for old, new in guard.changes:
            source = source.replace(old, new)
        ast.parse(source)


def test_every_kind_of_the_table_has_a_guard(scripts):
    kinds = {int(guard.kind.split()[0]) for guard in scripts[0].GUARDS}
    text = (ROOT / "docs" / "reliability.md").read_text()
    rows = {int(n) for n in re.findall(r"^\| (\d+) ", text, re.M)}
    assert rows == set(range(1, 26)) and kinds == rows - {25}  # 25 starts a process without a GPU


def test_mutants_differ_in_one_place_and_leave_messages_alone(scripts):
    _, mutation, _ = scripts
    source = '''
class A:
    rate: float = 3.0

    def f(self, x: Float[Array, "n 2"]):
        """At most 2."""
        if x < 1:
            raise ValueError(f"{x + 1} is less than 1")
        return -x * 2
'''
    made = list(mutation.mutants(source))
    changes = [what for _, what, _ in made]
    assert "x < 1 -> x <= 1" in changes and "-x * 2 -> -x / 2" in changes
    assert "1 -> 2" in changes and "2 -> 3" in changes and "-x -> x" in changes
    assert len(changes) == len({text for *_, text in made}) == 6
    assert all("rate: float=3.0" in text.replace(" = ", "=") for *_, text in made)
    assert all("is less than 1" in text and "At most 2." in text for *_, text in made)


def test_a_sandbox_is_a_copy_that_is_put_back(scripts):
    sandbox = scripts[2]
    with sandbox.sandbox() as place:
        name = "marlyap/errors.py"
        before = (place / name).read_text()
        with sandbox.changed(place, {name: "x = 1\n"}):
            assert (place / name).read_text() == "x = 1\n"
        assert (place / name).read_text() == before == (ROOT / name).read_text()
        assert (place / "tests" / "conftest.py").is_file()


@pytest.mark.slow
def test_the_fuzzer_feeds_every_loader(scripts, capsys):
    importlib.import_module("fuzz").main(["--minutes", "0.1"])
    said = capsys.readouterr().out.splitlines()[-1]
    seen = json.loads(said.removeprefix("fed and refused: "))
    assert len(seen) == 6 and all(fed > 0 for fed, _ in seen.values())
