"""What is stored comes back bit for bit, or is refused in one sentence that says what to do."""

import ast
import errno
import hashlib
import json
import math
import os
import pickle
import random
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from conftest import put_anywhere
from hypothesis import HealthCheck, given, settings, strategies as st

from marlyap.errors import UserError
from marlyap.storage import store
from marlyap.storage.store import MANIFEST, PAYLOAD, Checkpoints, CorruptError


KILLS = int(os.environ.get("MARLYAP_KILLS", "15"))
TRIALS = 200
ROOT = Path(store.__file__).parents[2]
NUMBER = np.random.default_rng(0)
fuzz = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def sample(value: float = 1.5) -> dict[str, np.ndarray]:
    return {
        "actor/weight": np.full((32, 40), value, np.float32),
        "actor/bias": np.arange(40, dtype=np.float64),
        "key": np.array([7, 9], np.uint32),
        "step": np.array(3, np.int32),
    }


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    store.write(tmp_path / "policy", "policy", sample(), {"beta": 0.5, "task": "rendezvous"})
    return tmp_path / "policy"


def assert_same(found, wanted) -> None:
    assert found.keys() == wanted.keys()
    for key, array in wanted.items():
        assert found[key].dtype == array.dtype and found[key].shape == array.shape, key
        assert found[key].tobytes() == array.tobytes(), key


def refused(directory: Path, kind: str = "policy") -> str:
    """The one sentence with which the directory is refused."""
    with pytest.raises(CorruptError) as caught:
        store.read(directory, kind)
    return sentence(caught)


def sentence(caught) -> str:
    message = str(caught.value)
    assert message.endswith(".") and "\n" not in message and ";" in message, message
    return message


def forge(directory: Path, change=lambda manifest: None, payload: bytes | None = None) -> None:
    """Alter a stored directory as someone would who knows how to make every hash agree."""
    manifest = json.loads((directory / MANIFEST).read_bytes())
    if payload is not None:
        (directory / PAYLOAD).write_bytes(payload)
        facts = {"sha256": hashlib.sha256(payload).hexdigest(), "bytes": len(payload)}
        manifest["files"] = {PAYLOAD: facts}
    change(manifest)
    manifest.pop("sha256", None)
    (directory / MANIFEST).write_bytes(store.sealed(manifest))


def python(script: str, *arguments: object, **options) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", script, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=300, **options
    )


# --- Round trips ---------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [*store.DTYPES])
def test_every_dtype_and_shape_comes_back_bit_for_bit(tmp_path, dtype):
    arrays = {}
    for shape in [(), (0,), (1,), (7,), (0, 4), (3, 0, 2), (2, 3, 5), (1,) * 9]:
        raw = NUMBER.integers(0, 256, math.prod(shape) * np.dtype(dtype).itemsize, dtype=np.uint8)
        raw = raw % 2 if dtype == "bool" else raw
        arrays[f"x{shape}"] = raw.view(dtype).reshape(shape)
    store.write(tmp_path / "a", "kind", arrays, {})
    found, meta = store.read(tmp_path / "a", "kind")
    assert_same(found, arrays)
    assert meta == {}
    assert all(array.flags.aligned and array.flags.writeable for array in found.values())


def test_all_widths_together_are_aligned(tmp_path):
    arrays = {f"{i}{name}": np.ones(i, name) for i in (1, 3, 5) for name in store.DTYPES}
    store.write(tmp_path / "a", "kind", arrays, {})
    found, _ = store.read(tmp_path / "a", "kind")
    assert_same(found, arrays)
    assert all(array.flags.aligned for array in found.values())


def test_order_in_memory_does_not_matter(tmp_path):
    base = np.arange(24, dtype=np.float32).reshape(4, 6)
    odd = {
        "fortran": np.asfortranarray(base),
        "strided": base[::2, ::-1],
        "transposed": base.T,
        "big endian": base.astype(">f4"),
        "broadcast": np.broadcast_to(np.float32(2), (3, 3)),
        "scalar": np.float32(2),
    }
    store.write(tmp_path / "a", "kind", odd, {})
    found, _ = store.read(tmp_path / "a", "kind")
    assert_same(found, {k: np.asarray(v, np.float32, order="C") for k, v in odd.items()})


def test_no_arrays_at_all(tmp_path):
    store.write(tmp_path / "a", "kind", {}, {"only": ["meta", None, True, 1e-300, 2**70, "é"]})
    meta = {"only": ["meta", None, True, 1e-300, 2**70, "é"]}
    assert store.read(tmp_path / "a", "kind") == ({}, meta)


def test_safetensors_itself_reads_the_payload(stored):
    assert_same(safetensors.numpy.load_file(stored / PAYLOAD), sample())


def test_same_content_same_bytes(tmp_path, stored):
    shuffled = dict(reversed(sample().items()))
    store.write(tmp_path / "again", "policy", shuffled, {"beta": 0.5, "task": "rendezvous"})
    assert (stored / PAYLOAD).read_bytes() == (tmp_path / "again" / PAYLOAD).read_bytes()


def test_the_manifest_says_what_it_is(stored):
    manifest = json.loads((stored / MANIFEST).read_text())
    payload = (stored / PAYLOAD).read_bytes()
    assert manifest["schema"] == 1 and manifest["kind"] == "policy"
    assert manifest["files"][PAYLOAD]["sha256"] == hashlib.sha256(payload).hexdigest()
    bias = sample()["actor/bias"]
    facts = {"dtype": "float64", "shape": [40], "sha256": hashlib.sha256(bias).hexdigest()}
    assert manifest["arrays"]["actor/bias"] == facts
    assert manifest["versions"]["numpy"] == np.__version__


@pytest.mark.parametrize(
    "array", [np.ones(2, np.float16), np.ones(2, complex), np.array(["a"]), np.array([{}]), None]
)
def test_other_dtypes_are_refused_by_name(tmp_path, array):
    with pytest.raises(UserError, match="'odd' has dtype"):
        store.write(tmp_path / "a", "kind", {"odd": array}, {})
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("key", ["__metadata__", "\ud800"])
def test_other_names_are_refused(tmp_path, key):
    with pytest.raises(UserError):
        store.write(tmp_path / "a", "kind", {key: np.ones(2)}, {})
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "value", [math.nan, -math.inf, {1}, object(), b"x", np.float32(1), {1: 2, "1": 3}, "\udc00"]
)
def test_meta_that_would_not_come_back_is_refused(tmp_path, value):
    with pytest.raises(UserError, match="meta is not JSON"):
        store.write(tmp_path / "a", "kind", {}, {"value": value})
    assert os.listdir(tmp_path) == []


def test_meta_too_deep_or_too_large_is_refused(tmp_path):
    deep: list = []
    for _ in range(100_000):
        deep = [deep]
    with pytest.raises(UserError, match="meta is not JSON"):
        store.write(tmp_path / "a", "kind", {}, {"deep": deep})
    with pytest.raises(UserError, match="too many"):
        store.write(tmp_path / "a", "kind", {}, {"long": "x" * store.JSON_LIMIT})
    assert os.listdir(tmp_path) == []


# --- Replacing -----------------------------------------------------------------------------------


def test_nothing_is_replaced_unasked(stored):
    with pytest.raises(UserError, match="already exists"):
        store.write(stored, "policy", sample(9.0), {})
    assert_same(store.read(stored, "policy")[0], sample())


def test_replacing_leaves_only_the_new(stored):
    store.write(stored, "policy", sample(9.0), {"new": 1}, replace=True)
    arrays, meta = store.read(stored, "policy")
    assert_same(arrays, sample(9.0))
    assert meta == {"new": 1} and os.listdir(stored.parent) == ["policy"]


def test_alien_directories_links_and_files_are_never_replaced(tmp_path, stored):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    (tmp_path / "link").symlink_to(stored)
    (tmp_path / "file").write_text("notes")
    for name in ("home", "link", "file"):
        with pytest.raises(UserError):
            store.write(tmp_path / name, "policy", sample(), {}, replace=True)
    assert (tmp_path / "home" / "thesis.tex").read_text() == "years of work"
    assert (tmp_path / "file").read_text() == "notes"
    assert sorted(os.listdir(tmp_path)) == ["file", "home", "link", "policy"]


def test_a_reader_never_sees_a_replacement_half_done(stored):
    stop = threading.Event()

    def writer() -> None:
        value = 0.0
        while not stop.is_set():
            value += 1
            store.write(stored, "policy", sample(value), {"value": value}, replace=True)

    store.write(stored, "policy", sample(0.0), {"value": 0.0}, replace=True)
    thread = threading.Thread(target=writer)
    thread.start()
    seen, end = set(), time.monotonic() + 1.0
    try:
        while time.monotonic() < end:
            arrays, meta = store.read(stored, "policy")
            assert_same(arrays, sample(meta["value"]))
            seen.add(meta["value"])
    finally:
        stop.set()
        thread.join()
    assert len(seen) > 1


# --- Accidents: every one is detected ------------------------------------------------------------


@pytest.mark.parametrize("name", [PAYLOAD, MANIFEST])
def test_truncation_at_any_place_is_detected(stored, name):
    whole = (stored / name).read_bytes()
    places = np.unique(np.linspace(0, len(whole) - 1, TRIALS, dtype=int))
    for place in [*places, 8, 7, 9]:
        (stored / name).write_bytes(whole[:place])
        assert name in refused(stored)


@pytest.mark.parametrize("name", [PAYLOAD, MANIFEST])
def test_a_flipped_bit_at_any_place_is_detected(stored, name):
    whole, dice = (stored / name).read_bytes(), random.Random(1)
    for _ in range(TRIALS):
        place = dice.randrange(len(whole))
        altered = bytearray(whole)
        altered[place] ^= 1 << dice.randrange(8)
        (stored / name).write_bytes(altered)
        refused(stored)


@pytest.mark.parametrize("name", [PAYLOAD, MANIFEST])
def test_one_byte_more_is_detected(stored, name):
    for extra in (b"\0", b"\n", b" ", b"x"):
        whole = (stored / name).read_bytes()
        (stored / name).write_bytes(whole + extra)
        refused(stored)
        (stored / name).write_bytes(whole)
    store.read(stored, "policy")


def test_a_zeroed_block_is_detected_and_the_array_named(tmp_path):
    arrays = {"first": np.full(2048, 1.0), "second": np.full(2048, 2.0)}
    store.write(tmp_path / "a", "kind", arrays, {})
    whole = (tmp_path / "a" / PAYLOAD).read_bytes()
    for start in range(0, len(whole) - 4095, 4096):
        block = whole[:start] + bytes(4096) + whole[start + 4096 :]
        (tmp_path / "a" / PAYLOAD).write_bytes(block)
        message = refused(tmp_path / "a", "kind")
    assert "damaged in array 'second'" in message


@pytest.mark.parametrize(
    "name, other", [(PAYLOAD, "damaged in array 'actor/weight'"), (MANIFEST, "damaged in array")]
)
def test_a_file_of_another_checkpoint_is_detected(tmp_path, stored, name, other):
    store.write(tmp_path / "other", "policy", sample(2.5), {})
    (stored / name).write_bytes((tmp_path / "other" / name).read_bytes())
    assert other in refused(stored)


@pytest.mark.parametrize("name", [PAYLOAD, MANIFEST])
def test_a_missing_file_is_named(stored, name):
    (stored / name).unlink()
    assert f"{name} is missing" in refused(stored)


@pytest.mark.parametrize("name", ["notes.txt", "policy.pkl", ".hidden"])
def test_an_alien_file_is_named(stored, name):
    (stored / name).write_text("x")
    assert f"{name} does not belong there" in refused(stored)


@pytest.mark.parametrize("name", [PAYLOAD, MANIFEST])
def test_links_pipes_and_directories_are_not_files(tmp_path, stored, name):
    whole = stored / name
    os.rename(whole, tmp_path / "elsewhere")
    whole.symlink_to(tmp_path / "elsewhere")
    assert f"{name} cannot be read (it is a link)" in refused(stored)
    whole.unlink()
    os.mkfifo(whole)
    assert name in refused(stored)
    whole.unlink()
    whole.mkdir()
    assert name in refused(stored)


def test_an_edited_manifest_is_detected(stored):
    text = (stored / MANIFEST).read_text()
    for old, new in [("0.5", "0.6"), ('"schema"', ' "schema"'), ("rendezvous", "formation")]:
        (stored / MANIFEST).write_text(text.replace(old, new))
        assert "altered" in refused(stored)


def test_what_is_not_a_stored_directory(tmp_path):
    (tmp_path / "actor.pkl").write_bytes(pickle.dumps({"w": 1}))
    (tmp_path / "empty").mkdir()
    for name in ("actor.pkl", "empty", "nowhere"):
        assert name in refused(tmp_path / name)


# --- Malice: every hash agrees, and yet ----------------------------------------------------------


class Trap:
    """Leaves a mark if it is ever unpickled."""

    def __reduce__(self):
        return os.mkdir, ("/tmp/marlyap-was-unpickled",)


def test_a_pickle_in_disguise_is_refused_unopened(stored):
    whole = (stored / PAYLOAD).read_bytes()
    forge(stored, payload=pickle.dumps(Trap()))
    assert "does not hold what its manifest describes" in refused(stored)
    forge(stored, payload=whole)
    store.read(stored, "policy")
    (stored / MANIFEST).write_bytes(pickle.dumps(Trap()))
    assert "not sound JSON" in refused(stored)
    assert not os.path.exists("/tmp/marlyap-was-unpickled")


def headers():
    """Payloads with a bad header, by what is wrong with it."""
    size = sum(array.nbytes for array in sample().values())

    def payload(header: bytes | dict, length: int | None = None) -> bytes:
        text = header if isinstance(header, bytes) else json.dumps(header).encode()
        return struct.pack("<Q", len(text) if length is None else length) + text + bytes(size)

    entry = {"dtype": "F32", "shape": [32, 40], "data_offsets": [0, 5120]}
    yield "length 2**63", payload({"actor/weight": entry}, 2**63)
    yield "length 2**40", payload({"actor/weight": entry}, 2**40)
    yield "length 0", payload({"actor/weight": entry}, 0)
    yield "100 MB of nothing", payload(b"{" + b" " * 100_000 + b"}")
    yield "overlap", payload({"actor/weight": entry, "actor/bias": entry})
    yield "beyond the end", payload({"actor/weight": entry | {"data_offsets": [2**40, 2**41]}})
    yield "negative", payload({"actor/weight": entry | {"data_offsets": [-5120, 0]}})
    yield "key twice", payload(b'{"a": 1, "a": 2}')
    yield "deep", payload(b"[" * 50_000)
    yield "metadata", payload({"__metadata__": {"a": "b"}, "actor/weight": entry})
    yield "nothing", b""
    yield "seven bytes", b"1234567"


@pytest.mark.parametrize("what, payload", [pytest.param(*case, id=case[0]) for case in headers()])
def test_a_bad_header_is_refused(stored, what, payload):
    forge(stored, payload=payload)
    assert PAYLOAD in refused(stored)


@pytest.mark.parametrize("change", [lambda x: x + b"x", lambda x: x[:-1], lambda x: x + bytes(40)])
def test_a_good_header_before_a_body_of_another_size_is_refused(stored, change):
    forge(stored, payload=change((stored / PAYLOAD).read_bytes()))
    assert "does not hold what its manifest describes" in refused(stored)


@pytest.mark.parametrize(
    "files",
    [
        {"../../etc/passwd": {}},
        {"/etc/passwd": {}},
        {PAYLOAD: {}, "..": {}},
        {PAYLOAD: {}, "sub/arrays.safetensors": {}},
        {},
        [],
        None,
    ],
)
def test_no_path_leads_out_of_the_directory(stored, files):
    forge(stored, lambda manifest: manifest.update(files=files))
    assert "lists other files" in refused(stored)


@pytest.mark.parametrize(
    "fact",
    [
        {"dtype": "float16"},
        {"dtype": "object"},
        {"dtype": "O"},
        {"dtype": ["float32"]},
        {"dtype": None},
        {"shape": [-32, -40]},
        {"shape": [32.0, 40]},
        {"shape": [True, 40]},
        {"shape": "32"},
        {"shape": [2**62, 2**62, 0]},
        {"shape": [1] * 33},
        {"shape": [10**4000]},
        {"sha256": None},
    ],
)
def test_an_array_that_cannot_be_is_refused(stored, fact):
    forge(stored, lambda manifest: manifest["arrays"]["actor/weight"].update(fact))
    assert "malformed entry" in refused(stored)


@pytest.mark.parametrize(
    "fact", [{"dtype": "int32"}, {"dtype": "float64"}, {"shape": [40, 32]}, {"shape": [2**40]}]
)
def test_an_array_that_is_not_there_is_refused(stored, fact):
    forge(stored, lambda manifest: manifest["arrays"]["actor/weight"].update(fact))
    assert "does not hold what its manifest describes" in refused(stored)


@pytest.mark.parametrize(
    "change",
    [{"meta": []}, {"arrays": []}, {"arrays": {"a": 1}}, {"files": {PAYLOAD: {"bytes": "1"}}}],
)
def test_a_malformed_manifest_is_refused(stored, change):
    forge(stored, lambda manifest: manifest.update(change))
    assert "malformed entry" in refused(stored)


@pytest.mark.parametrize("size", [-1, 0, 2**62])
def test_a_false_size_is_refused(stored, size):
    forge(stored, lambda manifest: manifest["files"][PAYLOAD].update(bytes=size))
    assert PAYLOAD in refused(stored)


def test_a_future_schema_asks_for_an_upgrade(stored):
    forge(stored, lambda manifest: manifest.update(schema=2))
    assert "newer marlyap (schema 2)" in refused(stored)


@pytest.mark.parametrize("schema", [0, -1, None, "1", 1.5, [1]])
def test_an_unknown_schema_is_refused(stored, schema):
    forge(stored, lambda manifest: manifest.update(schema=schema))
    refused(stored)


def test_another_kind_is_refused(stored):
    assert "of kind 'policy', not 'checkpoint'" in refused(stored, "checkpoint")


@pytest.mark.parametrize(
    "text",
    [b"", b"[]", b"3", b"null", b'{"schema": 1}', b'{"schema": 1, "schema": 1}', b"[" * 10**5],
)
def test_what_is_no_manifest_is_refused(stored, text):
    (stored / MANIFEST).write_bytes(text)
    assert MANIFEST in refused(stored)


def test_a_key_written_twice_is_refused(stored):
    text = (stored / MANIFEST).read_text()
    (stored / MANIFEST).write_text(text.replace('"kind"', '"kind": "policy", "kind"', 1))
    assert "a key is written twice" in refused(stored)


def test_a_huge_manifest_is_refused_unread(stored):
    os.truncate(stored / MANIFEST, 2**40)  # sparse: a terabyte that takes no space
    assert "not a file of at most" in refused(stored)


@fuzz
@given(manifest=st.binary(max_size=400), payload=st.binary(max_size=400))
def test_random_bytes_are_refused(tmp_path, manifest, payload):
    (tmp_path / "a").mkdir(exist_ok=True)
    (tmp_path / "a" / MANIFEST).write_bytes(manifest)
    (tmp_path / "a" / PAYLOAD).write_bytes(payload)
    refused(tmp_path / "a")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda child: st.lists(child, max_size=3) | st.dictionaries(st.text("abé/"), child, max_size=3),
    max_leaves=6,
)  # fmt: skip


@fuzz
@given(data=st.data(), value=JSON)
def test_any_value_anywhere_in_a_sealed_manifest(tmp_path, data, value):
    """Refused, or read to the same arrays: never another exception, never other numbers."""
    if not (tmp_path / "a").exists():
        store.write(tmp_path / "a", "policy", sample(), {"beta": 0.5})
        (tmp_path / "sound").write_bytes((tmp_path / "a" / MANIFEST).read_bytes())
    manifest = json.loads((tmp_path / "sound").read_bytes())
    del manifest["sha256"]
    put_anywhere(data, value, manifest)
    (tmp_path / "a" / MANIFEST).write_bytes(store.sealed(manifest))
    try:
        arrays, _ = store.read(tmp_path / "a", "policy")
    except CorruptError:
        return
    assert_same(arrays, sample())


# --- What was expected ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change, message",
    [
        ({"actor/bias": None}, "'actor/bias' is missing"),
        ({"critic": np.ones(2)}, "'critic' is unexpected"),
        ({"key": np.ones(2, np.int32)}, "'key' is int32[2], not uint32[2]"),
        ({"actor/weight": np.ones((8, 40), np.float32)}, "float32[8, 40], not float32[32, 40]"),
    ],
)
def test_expect_names_the_first_array_that_differs(change, message):
    found = {key: array for key, array in (sample() | change).items() if array is not None}
    with pytest.raises(UserError) as caught:
        store.expect(found, sample(), "runs/x")
    assert message in sentence(caught) and "runs/x" in sentence(caught)


def test_expect_is_silent_when_all_is_well():
    store.expect(sample(1.0), sample(2.0), "runs/x")


def test_the_hash_is_of_the_content_alone():
    base = store.hash_arrays(sample())
    assert base == store.hash_arrays(dict(reversed(sample().items())))
    weight = sample()["actor/weight"]
    assert base == store.hash_arrays(sample() | {"actor/weight": np.asfortranarray(weight)})
    nudged = weight.copy()
    nudged[3, 4] = np.nextafter(nudged[3, 4], np.float32(9))
    changes = [nudged, weight.reshape(40, 32), weight.view(np.int32), weight[None]]
    others = [store.hash_arrays(sample() | {"actor/weight": change}) for change in changes]
    others.append(store.hash_arrays({k + "x": v for k, v in sample().items()}))
    assert len({base, *others}) == 6


def test_the_hash_never_changes_between_versions():
    digest = store.hash_arrays({"b": np.arange(3, dtype=np.float32), "a": np.array(True)})
    a, b = (
        hashlib.sha256(b"\1").hexdigest(),
        hashlib.sha256(struct.pack("<3f", 0, 1, 2)).hexdigest(),
    )
    text = (
        f'{{"a":{{"dtype":"bool","sha256":"{a}","shape":[]}},'
        f'"b":{{"dtype":"float32","sha256":"{b}","shape":[3]}}}}'
    )
    assert digest == hashlib.sha256(text.encode()).hexdigest()


# --- Checkpoints ---------------------------------------------------------------------------------


def fill(directory: Path, *steps: int) -> Checkpoints:
    checkpoints = Checkpoints(directory)
    for step in steps:
        checkpoints.save(step, sample(step), {"step": step})
    return checkpoints


def damage(directory: Path) -> None:
    whole = bytearray((directory / PAYLOAD).read_bytes())
    whole[-1] ^= 1
    (directory / PAYLOAD).write_bytes(whole)


def test_the_last_two_remain_and_the_last_is_loaded(tmp_path):
    checkpoints = fill(tmp_path / "c", 1, 2, 30)
    assert sorted(os.listdir(tmp_path / "c")) == ["step-000000002", "step-000000030"]
    saved = checkpoints.latest()
    assert saved.step == 30 and saved.meta == {"step": 30} and saved.warnings == ()
    assert_same(saved.arrays, sample(30))


def test_steps_are_numbers_not_names(tmp_path):
    checkpoints = fill(tmp_path / "c", 999_999_999, 1_000_000_000)
    for foreign in ("step-1", "step-00000000x", "notes", "damaged-step-000000009-aa"):
        (tmp_path / "c" / foreign).mkdir()
    assert checkpoints.steps() == [999_999_999, 1_000_000_000]
    assert checkpoints.latest().step == 1_000_000_000


@pytest.mark.parametrize("fault", ["flip", "missing", "empty", "foreign", "newer"])
def test_a_bad_newest_falls_back_with_a_warning(tmp_path, fault):
    checkpoints = fill(tmp_path, 1, 2)
    newest = checkpoints.path(2)
    if fault == "flip":
        damage(newest)
    elif fault == "foreign":
        (newest / "core").write_text("x")
    elif fault == "newer":
        forge(newest, lambda manifest: manifest.update(schema=2))
    else:
        (newest / PAYLOAD).unlink()
        if fault == "empty":
            (newest / MANIFEST).unlink()
    saved = checkpoints.latest()
    assert saved.step == 1
    assert_same(saved.arrays, sample(1))
    (warning,) = saved.warnings
    assert "Checkpoint 2 was passed over" in warning and str(newest) in warning


def test_nothing_to_load_is_said(tmp_path):
    with pytest.raises(UserError, match="no checkpoint to load .there is none"):
        Checkpoints(tmp_path / "nowhere").latest()
    checkpoints = fill(tmp_path, 1, 2)
    damage(checkpoints.path(1))
    damage(checkpoints.path(2))
    with pytest.raises(UserError, match="damaged in array") as caught:
        checkpoints.latest()
    sentence(caught)


def test_the_same_step_may_be_saved_again(tmp_path):
    checkpoints = fill(tmp_path, 1, 2)
    checkpoints.save(2, sample(7), {})
    assert_same(checkpoints.latest().arrays, sample(7))
    assert checkpoints.steps() == [1, 2]


def test_a_good_later_checkpoint_is_never_abandoned(tmp_path):
    checkpoints = fill(tmp_path, 1, 5)
    with pytest.raises(UserError, match="step 3 is behind") as caught:
        checkpoints.save(3, sample(3), {})
    sentence(caught)
    assert checkpoints.steps() == [1, 5]


@pytest.mark.parametrize("step", [3, 5])
def test_a_bad_later_checkpoint_steps_aside(tmp_path, step):
    checkpoints = fill(tmp_path, 1, 5)
    damage(checkpoints.path(5))
    checkpoints.save(step, sample(step), {})
    saved = checkpoints.latest()
    assert saved.step == step and saved.warnings == () and checkpoints.steps() == [1, step]
    assert sum(name.startswith("damaged-step-000000005-") for name in os.listdir(tmp_path)) == 1


# --- Dead and living writers ---------------------------------------------------------------------


def dead_pid() -> int:
    process = subprocess.Popen(["true"])
    process.wait()
    return process.pid


def scratch_names() -> tuple[list[str], list[str]]:
    """What dead writers left, and what is still in the hands of living ones."""
    mine, other = os.getpid(), os.getppid()
    stale = [f".step-000000007.{dead_pid()}-00000000-00000000.tmp"]
    stale += [f".step-000000007.{mine}-00000000-00000000.tmp"]  # our number, another process
    alive = [f".step-000000007.{mine}-{store.SESSION}-00000000.tmp"]
    alive += [f".step-000000007.{other}-00000000-00000000.tmp"]
    foreign = [".step-000000007.tmp", "step-000000007.tmp", ".x.1-2-3.tmp", ".git"]
    return stale, alive + foreign


def test_what_the_dead_left_goes_and_what_the_living_hold_stays(tmp_path):
    stale, kept = scratch_names()
    for name in stale + kept:
        (tmp_path / name).mkdir()
        (tmp_path / name / PAYLOAD).write_bytes(b"half")
    fill(tmp_path, 1)
    assert sorted(os.listdir(tmp_path)) == sorted([*kept, "step-000000001"])


def test_a_write_sweeps_its_own_name_only(tmp_path):
    pid = dead_pid()
    for name in (f".mine.{pid}-00000000-00000000.tmp", f".other.{pid}-00000000-00000000.tmp"):
        (tmp_path / name).write_bytes(b"half")
    store.write(tmp_path / "mine", "kind", {}, {})
    assert sorted(os.listdir(tmp_path)) == [f".other.{pid}-00000000-00000000.tmp", "mine"]


def test_reading_changes_nothing(tmp_path):
    fill(tmp_path, 1)
    stale, kept = scratch_names()
    for name in stale + kept:
        (tmp_path / name).mkdir()
    before = sorted(os.listdir(tmp_path))
    Checkpoints(tmp_path).latest()
    assert sorted(os.listdir(tmp_path)) == before


def test_a_replacement_cut_in_two_is_read_and_put_back(tmp_path):
    checkpoints = fill(tmp_path, 1, 2)
    old = tmp_path / f".step-000000002.{dead_pid()}-00000000-00000000.old"
    os.rename(checkpoints.path(2), old)
    assert checkpoints.latest().step == 2 and old.exists()
    checkpoints.save(3, sample(3), {})
    assert not old.exists() and checkpoints.steps() == [2, 3]
    assert store.read(checkpoints.path(2), "checkpoint")[1] == {"step": 2}


def test_a_directory_between_two_renames_is_looked_for_again(stored, monkeypatch):
    losses, system_open = [stored] * 3, os.open

    def unlucky(path, *arguments, **options):
        if path in losses:
            losses.remove(path)
            raise FileNotFoundError(errno.ENOENT, "No such file or directory")
        return system_open(path, *arguments, **options)

    monkeypatch.setattr(os, "open", unlucky)
    assert_same(store.read(stored, "policy")[0], sample())
    assert not losses


def test_a_replacement_cut_in_two_may_be_damaged_as_well(stored):
    damage(stored)
    os.rename(stored, stored.parent / f".policy.{dead_pid()}-00000000-00000000.old")
    assert "damaged in array 'step'" in refused(stored)


HOLDER = """
import sys, time
from pathlib import Path
from marlyap.storage import store
with store.lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_two_writers_the_second_is_told_who_is_first(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout is not None and holder.stdout.readline() == "held\n"
            with pytest.raises(UserError, match=f"in use by process {holder.pid};") as caught:
                with store.lock(tmp_path):
                    pytest.fail("two writers")
            sentence(caught)
        finally:
            holder.send_signal(signal.SIGKILL)
    with store.lock(tmp_path):  # the system freed it
        with pytest.raises(UserError, match=f"process {os.getpid()};"):
            with store.lock(tmp_path):
                pytest.fail("two writers")
    with store.lock(tmp_path):
        pass


def test_the_lock_leaves_the_errors_of_its_body_alone(tmp_path):
    with pytest.raises(FileNotFoundError):
        with store.lock(tmp_path):
            open(tmp_path / "nowhere")
    with pytest.raises(UserError, match="could not be written"):
        with store.lock(tmp_path / "nowhere"):
            pass


# --- Failing writes ------------------------------------------------------------------------------


class Failing:
    """Lets some calls of `os` pass, then fails once."""

    def __init__(self, monkeypatch, after: int, error: BaseException):
        self.left, self.error = after, error
        for name in ("fsync", "rename", "replace", "mkdir"):
            monkeypatch.setattr(os, name, self.wrap(getattr(os, name)))

    def wrap(self, function):
        def call(*arguments, **options):
            self.left -= 1
            if self.left == -1:
                raise self.error
            return function(*arguments, **options)

        return call


FAULTS = [OSError(n, os.strerror(n)) for n in (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS)]


@pytest.mark.parametrize("error", [*FAULTS, KeyboardInterrupt()], ids=repr)
@pytest.mark.parametrize("after", range(6))
def test_a_failed_replacement_leaves_the_old_and_no_litter(stored, error, after):
    with pytest.MonkeyPatch.context() as monkeypatch:
        Failing(monkeypatch, after, error)
        with pytest.raises(
            UserError if isinstance(error, OSError) else KeyboardInterrupt
        ) as caught:
            store.write(stored, "policy", sample(9.0), {}, replace=True)
    if isinstance(error, OSError):
        assert str(error.strerror) in sentence(caught)
    assert_same(store.read(stored, "policy")[0], sample())
    assert os.listdir(stored.parent) == ["policy"]


def test_what_is_renamed_is_on_the_disk_before_and_its_name_after(tmp_path, monkeypatch):
    log, fsync, rename, replace = [], os.fsync, os.rename, os.replace

    def record(action, function):
        def call(*arguments):
            log.append(action(*arguments))
            return function(*arguments)

        return call

    def name(handle: int) -> str:
        found = Path(os.readlink(f"/proc/self/fd/{handle}")).name
        return "scratch" if found.startswith(".") else found

    monkeypatch.setattr(os, "fsync", record(name, fsync))
    monkeypatch.setattr(os, "rename", record(lambda _, new: f"> {new.name}", rename))
    monkeypatch.setattr(os, "replace", record(lambda _, new: f"> {new.name}", replace))
    store.write(tmp_path / "a", "kind", {}, {})
    assert [x for x in log if not x.startswith("> .")] == [
        PAYLOAD, MANIFEST, "scratch", "> a", tmp_path.name]  # fmt: skip
    log.clear()
    store.write_text_atomic(tmp_path / "b", "text")
    assert log == ["scratch", "> b", tmp_path.name]


@pytest.mark.parametrize("after", range(4))
def test_older_checkpoints_go_only_after_the_new_is_durable(tmp_path, after):
    checkpoints = fill(tmp_path, 1, 2)
    with pytest.MonkeyPatch.context() as monkeypatch:
        Failing(monkeypatch, after + 1, OSError(errno.ENOSPC, "No space left on device"))
        with pytest.raises(UserError, match="free some disk space"):
            checkpoints.save(3, sample(3), {})
    assert checkpoints.steps() == [1, 2] and sorted(os.listdir(tmp_path))[0] == "step-000000001"


FULL = """
import resource, sys
from pathlib import Path
import numpy as np
from marlyap.storage import store
from marlyap.errors import UserError
checkpoints = store.Checkpoints(Path(sys.argv[1]))
checkpoints.save(1, {"x": np.ones(1000)}, {})
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
for attempt in (lambda: checkpoints.save(2, {"x": np.ones(100_000)}, {}),
                lambda: store.write_text_atomic(Path(sys.argv[2]), "x" * 200_000),
                lambda: store.append_line(Path(sys.argv[2]), "x" * 200_000)):
    try:
        attempt()
    except UserError as error:
        print(error)
"""


def test_a_full_disk_costs_nothing_that_was_there(tmp_path):
    (tmp_path / "log").write_text("first\n")
    result = python(FULL, tmp_path / "c", tmp_path / "log")
    assert result.returncode == 0, result.stderr
    messages = result.stdout.splitlines()
    assert len(messages) == 3 and all("free some disk space" in line for line in messages)
    assert "step-000000002" in messages[0]
    assert os.listdir(tmp_path / "c") == ["step-000000001"]
    assert sorted(os.listdir(tmp_path)) == ["c", "log"]
    assert (tmp_path / "log").read_text() == "first\n"
    assert Checkpoints(tmp_path / "c").latest().step == 1


FORBIDDEN = """
import os, sys
from pathlib import Path
from marlyap.storage import store
from marlyap.errors import UserError
store.versions()  # what it imports may be in a home that nobody else can read
if os.getuid() == 0:
    os.setuid(65534)
here = Path(sys.argv[1])
for attempt in (lambda: store.write(here / "a", "kind", {}, {}),
                lambda: store.Checkpoints(here).save(1, {}, {}),
                lambda: store.write_text_atomic(here / "run.json", "{}"),
                lambda: store.append_line(here / "log", "{}"),
                lambda: store.lock(here).__enter__()):
    try:
        attempt()
    except UserError as error:
        print(error)
"""


def test_a_directory_one_may_not_write_in(tmp_path):
    (tmp_path / "shut").mkdir(mode=0o555)
    result = python(FORBIDDEN, tmp_path / "shut")
    assert result.returncode == 0, result.stderr
    messages = result.stdout.splitlines()
    assert len(messages) == 5, result.stdout
    assert all("choose a directory you may write in" in line for line in messages)
    assert os.listdir(tmp_path / "shut") == []


@pytest.mark.parametrize("parent", ["nowhere", "file"])
def test_a_parent_that_is_no_directory(tmp_path, parent):
    (tmp_path / "file").write_text("x")
    for attempt in (
        lambda: store.write(tmp_path / parent / "a", "kind", {}, {}),
        lambda: Checkpoints(tmp_path / parent / "c").save(1, {}, {}),
        lambda: store.write_text_atomic(tmp_path / parent / "run.json", "{}"),
        lambda: store.append_line(tmp_path / parent / "log", "{}"),
    ):
        with pytest.raises(UserError, match="its parent is a directory") as caught:
            attempt()
        sentence(caught)


def test_a_file_in_place_of_the_checkpoints(tmp_path):
    (tmp_path / "c").write_text("x")
    with pytest.raises(UserError, match="move away what is already there"):
        Checkpoints(tmp_path / "c").save(1, {}, {})


# --- Death at any moment -------------------------------------------------------------------------

KILLED = """
import os, random, signal, sys, time
from pathlib import Path
import numpy as np
from marlyap.storage import store

root, trials = Path(sys.argv[1]), int(sys.argv[2])
checkpoints = store.Checkpoints(root / "c")


def arrays(step):
    return {"w": np.full((200, 500), step, np.float32), "step": np.array(step)}


def work(step, pipe):
    while True:
        step += 1
        checkpoints.save(step, arrays(step), {"step": step})
        store.write(root / "policy", "policy", arrays(step), {"step": step}, replace=True)
        store.append_line(root / "log", str(step))
        store.write_text_atomic(root / "run.json", '{"step": %d}' % step)
        os.write(pipe, b".")


def check(found, meta):
    assert (found["w"] == meta["step"]).all() and found["step"] == meta["step"]


step = sure = saves = 0
for trial in range(trials):
    reader, pipe = os.pipe()
    child = os.fork()
    if child == 0:
        work(step, pipe)
    os.close(pipe)
    first = b""
    if trial == 0:  # something to lose, and a measure of how long it takes
        began = time.monotonic()
        first = os.read(reader, 1)
        took = time.monotonic() - began
    time.sleep(random.Random(trial).uniform(0, 2 * took))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    done = len(first)
    while chunk := os.read(reader, 4096):
        done += len(chunk)
    os.close(reader)
    sure = step + done if done else sure  # the last step of which everything was written
    saved = checkpoints.latest()
    check(saved.arrays, saved.meta)
    assert not saved.warnings and step + done <= saved.step <= step + done + 1, (step, done, saved)
    found, meta = store.read(root / "policy", "policy")
    check(found, meta)
    text = store.read_json(root / "run.json")
    lines = store.read_jsonl(root / "log")
    for last in (meta["step"], text["step"], lines[-1]):
        assert sure <= last <= saved.step, (sure, last, saved.step)
    assert lines == sorted(set(lines))
    saves += saved.step - step
    step = saved.step
checkpoints.save(step + 1, arrays(step + 1), {"step": step + 1})
store.write(root / "policy", "policy", arrays(step + 1), {"step": step + 1}, replace=True)
store.write_text_atomic(root / "run.json", "{}")
assert sorted(os.listdir(root)) == ["c", "log", "policy", "run.json"], os.listdir(root)
assert len(os.listdir(root / "c")) == 2, os.listdir(root / "c")
print(trials, "kills,", saves, "saves,", round(1000 * took), "ms each")
"""


def test_kill_9_at_a_random_moment_costs_at_most_the_save_under_way(tmp_path):
    result = python(KILLED, tmp_path, KILLS)
    assert result.returncode == 0, result.stderr
    print(result.stdout)
    assert result.stdout.startswith(f"{KILLS} kills")


CRASHED = """
import os, shutil, sys
from pathlib import Path
import numpy as np
from marlyap.storage import store

EVENTS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate", "os.listdir"}
root = Path(sys.argv[1])


def arrays(value):
    return {"w": np.full(1000, value)}


def save(here):
    store.Checkpoints(here).save(3, arrays(3), {"value": 3})


def again(here):
    store.Checkpoints(here).save(2, arrays(3), {"value": 3})


def replace(here):
    store.write(here / "policy", "policy", arrays(3), {"value": 3}, replace=True)


def sound(here):
    saved = store.Checkpoints(here).latest()
    found, meta = store.read(here / "policy", "policy")
    assert not saved.warnings and (saved.arrays["w"] == saved.meta["value"]).all()
    assert (found["w"] == meta["value"]).all() and saved.meta["value"] >= 2
    for step in store.Checkpoints(here).steps():  # none is half removed
        store.read(store.Checkpoints(here).path(step), "checkpoint")


def crash(action, here, at):
    count = 0

    def hook(event, _):
        nonlocal count
        count += event in EVENTS
        if event in EVENTS and count == at:
            os._exit(9)

    child = os.fork()
    if child == 0:
        sys.addaudithook(hook)
        action(here)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


base = root / "base"
base.mkdir()
for value in (1, 2):
    store.Checkpoints(base).save(value, arrays(value), {"value": value})
store.write(base / "policy", "policy", arrays(2), {"value": 2})
points = 0
for action in (save, again, replace):
    for at in range(1, 1000):
        here = root / f"{action.__name__}{at}"
        shutil.copytree(base, here)
        code = crash(action, here, at)
        assert code in (0, 9), code
        sound(here)
        action(here)  # life goes on
        sound(here)
        assert not [name for name in os.listdir(here) if name.startswith(".")], os.listdir(here)
        assert len(os.listdir(here)) == 3, os.listdir(here)
        shutil.rmtree(here)
        if code == 0:
            break
        points += 1
print(points)
"""


def test_a_crash_before_any_system_call_leaves_all_loadable(tmp_path):
    result = python(CRASHED, tmp_path)
    assert result.returncode == 0, result.stderr
    print(result.stdout, "crash points")
    assert int(result.stdout) > 40


# --- Text ----------------------------------------------------------------------------------------


def test_text_is_replaced_whole(tmp_path):
    path = tmp_path / "run.json"
    store.write_text_atomic(path, '{"a": "é"}')
    store.write_text_atomic(path, '{"a": 2}')
    assert store.read_json(path) == {"a": 2} and os.listdir(tmp_path) == ["run.json"]


@pytest.mark.parametrize("error", [*FAULTS, KeyboardInterrupt()], ids=repr)
@pytest.mark.parametrize("after", range(2))
def test_failing_text_leaves_the_old(tmp_path, error, after):
    store.write_text_atomic(tmp_path / "a", "old")
    with pytest.MonkeyPatch.context() as monkeypatch:
        Failing(monkeypatch, after, error)
        with pytest.raises((UserError, KeyboardInterrupt)):
            store.write_text_atomic(tmp_path / "a", "new")
    assert (tmp_path / "a").read_text() == "old" and os.listdir(tmp_path) == ["a"]


@pytest.mark.parametrize(
    "text",
    [
        '{"a": 1, "a": 2}',
        '{"b": {"a": 1, "a": 1}}',
        '{"a": NaN}',
        "[Infinity]",
        "-Infinity",
        "1e999",
        "-1e999",
        "9" * 5000,
        "[" * 65 + "]" * 65,
        '{"a":' * 65 + "1" + "}" * 65,
        "[" * 100_000,
        r'"\ud800"',
        '{"\\udfff": 1}',
        "{'a': 1}",
        "[1,]",
        "",
        "\ufeff{}",
        "{} {}",
    ],
)
def test_unsound_json_is_refused(tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(CorruptError, match="run.json is not sound JSON") as caught:
        store.read_json(tmp_path / "run.json")
    sentence(caught)


def test_sound_json_is_read(tmp_path):
    for value in ({"a": [1, 2.5, None, True, "é\ud83d\ude00".encode("utf-16", "surrogatepass")
                         .decode("utf-16")]}, [], 3, "x", [[[]]], 1e308):  # fmt: skip
        (tmp_path / "a").write_text(json.dumps(value))
        assert store.read_json(tmp_path / "a") == value
    nested = "[" * 64 + "]" * 64
    (tmp_path / "a").write_text(nested)
    assert json.dumps(store.read_json(tmp_path / "a")) == nested


def test_json_files_that_cannot_be_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "big").write_text(" " * 101)
    (tmp_path / "utf16").write_bytes('{"a": 1}'.encode("utf-16"))
    for name in ("nowhere", "pipe", "big", "utf16", "."):
        with pytest.raises(CorruptError, match=str(tmp_path)) as caught:
            store.read_json(tmp_path / name, 100)
        sentence(caught)
    with pytest.raises(CorruptError, match="pipe is not a file"):
        store.read_jsonl(tmp_path / "pipe")


@fuzz
@given(raw=st.binary(max_size=200) | st.text('[]{}",:1e9\\u dN', max_size=40).map(str.encode))
def test_any_bytes_are_json_or_refused(tmp_path, raw):
    (tmp_path / "a").write_bytes(raw)
    for reader in (store.read_json, store.read_jsonl):
        try:
            value = reader(tmp_path / "a")
        except CorruptError:
            continue
        json.dumps(value, allow_nan=False, ensure_ascii=False).encode()


@fuzz
@given(value=JSON)
def test_any_sound_value_comes_back(tmp_path, value):
    store.write_text_atomic(tmp_path / "a", json.dumps(value))
    assert store.read_json(tmp_path / "a") == value
    (tmp_path / "log").unlink(missing_ok=True)
    store.append_line(tmp_path / "log", json.dumps(value))
    store.append_line(tmp_path / "log", json.dumps(value))
    assert store.read_jsonl(tmp_path / "log") == [value, value]


def test_a_line_cut_short_is_left_out_then_dropped(tmp_path):
    path = tmp_path / "log.jsonl"
    store.append_line(path, '{"step": 1}')
    store.append_line(path, '{"step": 2}')
    whole = path.read_bytes()
    for cut in range(12, 24):
        path.write_bytes(whole[:cut])
        assert store.read_jsonl(path) == [{"step": 1}]
        store.append_line(path, '{"step": 3}')
        assert path.read_text() == '{"step": 1}\n{"step": 3}\n'
    path.write_bytes(b'{"st')
    assert store.read_jsonl(path) == []
    store.append_line(path, "1")
    assert path.read_text() == "1\n"


def test_a_bad_line_in_the_middle_is_named(tmp_path):
    (tmp_path / "log").write_text("1\n{\n3\n")
    with pytest.raises(CorruptError, match="log, line 2 is not sound JSON"):
        store.read_jsonl(tmp_path / "log")
    with pytest.raises(ValueError, match="line break"):
        store.append_line(tmp_path / "log", "a\nb")


# --- The module itself ---------------------------------------------------------------------------


def test_it_needs_neither_jax_nor_anything_that_executes_data():
    script = "import sys, marlyap.storage.store; "
    script += "print({'jax', 'equinox', 'safetensors'} & {*sys.modules})"
    assert python(script).stdout == "set()\n"
    tree = ast.parse(Path(store.__file__).read_text())
    words = {getattr(node, name, "") for node in ast.walk(tree) for name in ("id", "attr", "arg")}
    words |= {alias.name for node in ast.walk(tree) for alias in getattr(node, "names", [])}
    assert "sha256" in words
    assert not words & {"pickle", "marshal", "shelve", "eval", "exec", "allow_pickle", "load"}
