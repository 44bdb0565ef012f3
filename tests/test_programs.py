"""A program that was traced once is found again, unless anything it was made from is another."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import marlyap
from marlyap.compute import export_cache
from marlyap.learning.optimiser import TrainState
from marlyap.runs import provenance
from marlyap.storage.store import MANIFEST, PAYLOAD
from marlyap.tasks import TASKS


GAME = TASKS["rendezvous"]
TRACES = []


def remember(game, carry):
    """Draws a start with the carried key, and adds what the agents' distances cost."""
    TRACES.append(game)
    (total, name), key = carry.value, carry.memory
    key, now = jax.random.split(key)
    cost = game.costs(game.reset(now), jnp.zeros((game.agents, game.dynamics.du)))
    return TrainState((total + jnp.sum(cost), name), key), {"cost": jnp.mean(cost)}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    TRACES.clear()
    monkeypatch.setenv(export_cache.FOLDER, str(tmp_path / "programs"))
    return tmp_path / "programs"


def start(shape=(3,), name="started"):
    """What a training carries, in small: an array, a random key, and what is neither."""
    return TrainState((jnp.zeros(shape), name), jax.random.key(7))


def compiled(game=GAME, memory=start, f=remember, **more):
    memory = memory()
    return export_cache.compiled(f, game, memory, lambda: memory, **more)


def same(a, b):
    bits = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    flat = lambda t: [np.asarray(bits(x)) for x in jax.tree.leaves(eqx.filter(t, eqx.is_array))]
    return all(np.array_equal(x, y) for x, y in zip(flat(a), flat(b), strict=True))


def test_a_second_start_traces_nothing_and_computes_the_same(folder, monkeypatch):
    first, cost = compiled()(start())
    assert len(TRACES) == 1 and len(list(folder.iterdir())) == 1
    again, cost_again = compiled()(start())
    assert len(TRACES) == 1
    monkeypatch.setenv(export_cache.FOLDER, "")
    plain, cost_plain = compiled()(start())
    assert len(TRACES) == 2
    assert same((first, cost), (again, cost_again)) and same((first, cost), (plain, cost_plain))
    assert first.value[1] == again.value[1] == "started" and isinstance(again, TrainState)
    onwards = compiled()
    assert not same(onwards(onwards(start())[0]), (first, cost))  # the key has moved on


def test_what_is_donated_is_used_up(folder):
    memory = start()
    compiled(donate=True)(memory)
    assert memory.value[0].is_deleted()
    kept = start()
    compiled()(kept)
    assert not kept.value[0].is_deleted() and len(list(folder.iterdir())) == 2


@pytest.mark.parametrize(
    "change",
    [
        {"game": replace(GAME, size=GAME.size + 0.5)},
        {"game": replace(GAME, dynamics=replace(GAME.dynamics, limits=(5.0, 4.0)))},
        {"memory": lambda: start(shape=(1, 3))},
        {"memory": lambda: start(name="resumed")},
        {"f": lambda game, memory: remember(game, memory)},
    ],
    ids=["a number", "a number within", "a shape", "a word", "the function"],
)
def test_another_program_is_traced(change, folder):
    compiled()
    compiled(**change)
    assert len(TRACES) == 2 and len(list(folder.iterdir())) == 2
    compiled(**change)
    assert len(TRACES) == 2


def copied(tmp_path):
    """A copy of the package's source."""
    return shutil.copytree(
        export_cache.SOURCE, tmp_path / "marlyap", ignore=shutil.ignore_patterns("__pycache__")
    )


def change(path):
    path.write_bytes(path.read_bytes() + b"\n")


def test_a_change_in_any_file_of_the_package_is_noticed(monkeypatch, tmp_path):
    package = Path(marlyap.__file__).parent
    assert export_cache.SOURCE == provenance.SOURCE == package
    monkeypatch.setattr(export_cache, "SOURCE", copied(tmp_path))
    digests, files = set(), [p for p in package.rglob("*.py") if "__pycache__" not in p.parts]
    try:
        for path in files:
            change(export_cache.SOURCE / path.relative_to(package))
            export_cache._surroundings.cache_clear()
            digests.add(export_cache._surroundings()[0])
    finally:
        export_cache._surroundings.cache_clear()
    assert len(digests) == len(files)


@pytest.mark.parametrize("what", ["source", "version", "setting", "device"])
def test_what_surrounds_a_program_belongs_to_its_name(what, folder, monkeypatch, tmp_path):
    compiled()
    export_cache._surroundings.cache_clear()
    if what == "source":
        monkeypatch.setattr(export_cache, "SOURCE", copied(tmp_path))
        change(next(export_cache.SOURCE.rglob("nets.py")))
    elif what == "version":
        monkeypatch.setattr(export_cache.store, "versions", lambda: {"jax": "0"})
    elif what == "device":
        device = SimpleNamespace(platform="abacus", device_kind="beads")
        monkeypatch.setattr(jax, "devices", lambda: [device])
    try:
        with jax.numpy_dtype_promotion("strict" if what == "setting" else "standard"):
            compiled()
    finally:
        export_cache._surroundings.cache_clear()
    assert len(TRACES) == 2 and len(list(folder.iterdir())) == 2


class Own(type(GAME)):
    """A task of the user's."""


def test_code_of_ones_own_is_traced_every_time(folder):
    mine = Own()
    for _ in range(2):
        compiled(game=mine)
    assert not folder.exists()
    for time in (1, 2):
        compiled(game=mine)(start())
        assert len(TRACES) == 1, time  # within one process compiled once, as by filter_jit


@pytest.mark.parametrize("part", [PAYLOAD, MANIFEST])
def test_a_damaged_program_is_made_anew(part, folder):
    sound, _ = compiled()(start())
    (place,) = folder.iterdir()
    content = bytearray((place / part).read_bytes())
    content[len(content) // 2] ^= 1
    (place / part).write_bytes(content)
    fixed, _ = compiled()(start())
    assert len(TRACES) == 2 and same(sound, fixed)
    compiled()
    assert (
        len(TRACES) == 2 and json.loads((place / MANIFEST).read_text())["kind"] == export_cache.KIND
    )


def test_where_nothing_can_be_kept_it_works_all_the_same(folder):
    folder.write_text("a file in the way")
    assert same(compiled()(start()), compiled()(start()))
    assert len(TRACES) == 2 and folder.read_text() == "a file in the way"


def test_those_used_last_are_kept(folder, monkeypatch):
    monkeypatch.setattr(export_cache, "MOST", 2)
    games = [replace(GAME, size=size) for size in (1.0, 2.0, 3.0)]
    for k in (0, 1, 0, 2):  # 1 is the one not used for longest when 2 comes
        compiled(game=games[k])
    assert len(list(folder.iterdir())) == 2 and len(TRACES) == 3
    compiled(game=games[0])
    assert len(TRACES) == 3
    compiled(game=games[1])
    assert len(TRACES) == 4
