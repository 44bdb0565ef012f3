"""No liar is believed, and every honest one is: `reliability/liars.py` in its quick form."""

import importlib.util
from pathlib import Path

import pytest


FILE = Path(__file__).parents[1] / "reliability" / "liars.py"


def load():
    spec = importlib.util.spec_from_file_location("liars", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules["liars"] = module
    spec.loader.exec_module(module)
    return module


liars = load()


def test_there_are_forty_liars_and_an_honest_twin_of_each_kind_that_has_one():
    assert sum(not one.honest for one in liars.CASES) >= 40
    honest = {one.kind for one in liars.CASES if one.honest}
    assert {"linearisation", "composition", "reach", "V", "information", "recheck"} <= honest


@pytest.mark.parametrize("kind", sorted({one.kind for one in liars.CASES}))
def test_no_liar_is_believed_and_every_honest_one_is(kind, capsys):
    for one, answer in liars.answers(400, {kind}):
        print(f"{one.kind} | {one.name} | {answer.says}")
        assert answer.believed == one.honest, (one.name, answer.says)
