"""What a run tells beside its log: a CSV, TensorBoard's event files, and trackers on request."""

import csv
import struct
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from marlyap.errors import UserError
from marlyap.runs import sinks
from marlyap.runs.curves import columns, framed
from marlyap.runs.job import Job, Launch
from marlyap.runs.sinks import About, Csv, TensorBoard
from marlyap.storage import tensorboard


LINES = [
    {"seed": 3, "iteration": 1, "steps": 20, "updates": 5, "seconds": 0.5, "J_Q": 1.25},
    {"seed": 3, "iteration": 2, "steps": 40, "updates": 10, "seconds": 0.9, "J_Q": 0.75},
    {"seed": 3, "iteration": 3, "steps": 60, "updates": 15, "seconds": 1.1, "success": 0.1},
]


@pytest.fixture
def about(tmp_path):
    return About(tmp_path, "rendezvous masac seed 3", {"task": {"kind": "Rendezvous"}})


def test_the_checksum_is_that_of_rfc_3720():
    assert tensorboard.crc32c(b"") == 0 and tensorboard.crc32c(bytes(32)) == 0x8A9136AA
    assert tensorboard.crc32c(b"123456789") == 0xE3069283


def test_a_csv_gains_columns_and_begins_anew(about):
    sink = Csv(about, LINES[:1])
    for line in LINES[1:]:
        sink.line(line)
    read = lambda: [*csv.DictReader((about.directory / "log.csv").open())]
    assert [row["success"] for row in read()] == ["", "", "0.1"]
    assert [row["J_Q"] for row in read()] == ["1.25", "0.75", ""]
    Csv(about, LINES[:2])  # taken up again further back
    assert [row["iteration"] for row in read()] == ["1", "2"]
    Csv(about, [])
    assert read() == []


def messages(path):
    """The messages of an event file, their checksums verified."""
    data, found = path.read_bytes(), []
    while data:
        (length,) = struct.unpack("<Q", data[:8])
        assert data[: 16 + length] == tensorboard.record(data[12 : 12 + length])[: 16 + length]
        found.append(data[12 : 12 + length])
        data = data[16 + length :]
    return found


def test_an_event_file_is_records_of_every_line_and_begins_anew(about):
    sink = TensorBoard(about, LINES[:2])
    sink.line(LINES[2])
    (path,) = about.directory.glob("events.out.tfevents.*")
    first, *rest = messages(path)
    assert b"brain.Event:2" in first and len(rest) == 3
    assert b"\x10\x14" in rest[0] and b"J_Q\x15" + struct.pack("<f", 1.25) in rest[0]
    content = path.read_bytes()
    assert TensorBoard(about, LINES).path == path and path.read_bytes() == content
    assert TensorBoard(about, LINES[:1]).path == path and len(messages(path)) == 2


def test_tensorboard_reads_every_tag_and_step(about):
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    lines = [line | {"wild": 1e300, "none": float("nan")} for line in LINES]
    sink = TensorBoard(about, lines[:1])
    for line in lines[1:]:
        sink.line(line)
    found = reader.EventAccumulator(str(about.directory))
    found.Reload()
    assert found.Tags()["scalars"] == ["J_Q", "wild", "success"]
    read = {tag: [(e.step, e.value) for e in found.Scalars(tag)] for tag in ("J_Q", "success")}
    assert read["J_Q"] == [(20, 1.25), (40, 0.75)]
    assert read["success"] == [(60, pytest.approx(0.1))]


def test_a_tracker_that_is_unknown_or_missing_is_one_sentence(monkeypatch):
    with pytest.raises(UserError, match="^log: 'notes' must be wandb, mlflow, trackio.$"):
        Launch(log=("notes",))
    monkeypatch.setattr(sinks, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="^log: wandb is not installed; install it with pip"):
        Launch(log=("wandb",))


def test_a_tracker_is_told_every_line_and_closed(about, monkeypatch):
    told = []
    run = SimpleNamespace(
        log=lambda values, step: told.append((step, values)), finish=lambda: told.append("end")
    )
    module = SimpleNamespace(init=lambda **given: (told.append(given["name"]), run)[1])
    for name in ("wandb", "trackio"):
        told.clear()
        monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setattr(sinks, "find_spec", lambda name: name)
        job = Job("runs/a", None, Launch(log=(name,)))
        assert Job.from_json(job.to_json()) == job
        every = sinks.Sinks(about, [], (name,))
        every.line(LINES[0])
        every.close()
        assert told[0].startswith("rendezvous masac seed 3") and told[-1] == "end"
        assert told[1] == (20, {"J_Q": 1.25}) and (about.directory / "log.csv").exists()


@pytest.mark.parametrize("name", sinks.TRACKERS)
@pytest.mark.slow
def test_the_trackers_themselves_take_it(name, about, monkeypatch):
    pytest.importorskip(name)
    monkeypatch.chdir(about.directory)
    for variable, value in (("WANDB_MODE", "offline"), ("TRACKIO_DIR", str(about.directory))):
        monkeypatch.setenv(variable, value)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{about.directory}/mlflow.db")
    for again in range(2):
        every = sinks.Sinks(about, LINES[:again], (name,))
        every.line(LINES[again])
        every.close()


def test_rows_become_columns():
    found = columns([{"a": 1, "b": 0.5, "c": "x"}, {"a": 2, "c": None}])
    assert found["a"].dtype.kind == "i" and np.isnan(found["b"][1])
    assert found["c"].tolist() == ["x", None] and columns([]) == {}


def test_pandas_is_used_where_it_is_there(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    assert isinstance(framed(columns([{"a": 1}])), dict)
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda found: [found]))
    assert isinstance(framed(columns([{"a": 1}])), list)
