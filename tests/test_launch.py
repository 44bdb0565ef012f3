"""Launching as a library: events as values and as JSON, settings that are refused, code to load."""

import dataclasses
import json

import jax
import pytest

from marlyap import Launch, Rendezvous, Run, Schedule, Trainer, UserError, launch
from marlyap.games.dynamics import SingleIntegrator
from marlyap.learning.algorithms import MASAC
from marlyap.runs import events, launch as launching
from marlyap.runs.job import Job
from marlyap.runs.stop import Stop


TINY = MASAC(actor_width=4, critic_width=4, batch=4)
PLAN = Schedule(
    steps=16, environments=2, steps_per_update=4, warmup=8, capacity=40, select_episodes=2
)
GAME = Rendezvous(agents=2, horizon=4, dynamics=SingleIntegrator())
EVENTS = [
    events.Started("a/seed0", 0),
    events.Progress("a/seed0", 0, {"iteration": 1, "return": -0.5}, 6),
    events.Warned("a/seed0", 0, "a \u201cquote\u201d\nand a line"),
    events.Diverged("a/seed0", 0, 3, "J_Q", "it diverged."),
    events.Saved("a/seed0", 0, 3),
    events.Finished("a/seed0", 0),
    events.Failed("a/seed0", 0, "it failed."),
]


def test_every_event_comes_back_from_its_line_of_json():
    assert {type(event) for event in EVENTS} == set(events.KINDS.values())
    for event in EVENTS:
        line = events.to_json(event)
        assert "\n" not in line and events.from_json(line) == event


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "3", '{"event": "Escaped"}', '{"event": "Saved", "run": "a"}', "null"]
)
def test_what_is_no_event_is_refused(text):
    with pytest.raises(ValueError):
        events.from_json(text)


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("parallel", "many", "parallel: 'many' must be auto, process or vmap."),
        ("on_nan", "ignore", "on-nan: 'ignore' must be stop or rollback."),
        ("device", "tpu", "device: 'tpu' must be cpu or gpu."),
        ("attempts", 0, "attempts: 0 is out of range; take 1 to 1000."),
    ],
)
def test_settings_are_refused_by_name(field, value, says):
    with pytest.raises(UserError) as refused:
        Launch(**{field: value})
    assert str(refused.value) == says


def test_a_job_is_one_line():
    job = Job("runs/a b/seed0", 3, Launch(on_nan="rollback", attempts=5, task="own.py:Mine"))
    assert "\n" not in job.to_json() and Job.from_json(job.to_json()) == job
    assert (job.how.tries, Launch().tries) == (5, 1)


def test_a_run_is_trained_and_told_in_order(tmp_path):
    run = Run.create(tmp_path / "seed3", Trainer(GAME, TINY, PLAN), 3, {})
    told = list(launch([run]))
    lines = [e.line for e in told if isinstance(e, events.Progress)]
    assert [type(e) for e in told] == [
        events.Started,
        *[events.Progress] * len(lines),
        events.Saved,
        events.Finished,
    ]
    assert lines == run.history() and lines[-1]["steps"] >= 16 and run.finished
    assert {(e.run, e.seed) for e in told} == {run.named}
    assert list(launch([run])) == []  # there is nothing left to do
    json.dumps([dataclasses.asdict(e) for e in told])


def test_a_device_that_jax_does_not_use_here_is_refused(tmp_path):
    run = Run.create(tmp_path / "seed3", Trainer(GAME, TINY, PLAN), 3, {})
    other = {"cpu": "gpu", "gpu": "cpu"}[jax.default_backend()]
    with pytest.raises(UserError, match="^device: JAX has started on"):
        list(launch([run], Launch(device=other)))
    assert run.untouched


class Here(Rendezvous):
    """A task in a file that a process can load."""


def test_code_is_found_by_the_file_of_its_class_or_refused(tmp_path):
    class Local(Rendezvous):
        pass

    places = {}
    for cls in (Rendezvous, Here, Local):
        run = Run.create(tmp_path / cls.__name__, Trainer(cls(), TINY, PLAN), 0, {})
        places[cls] = run
    found = lambda cls, how: launching._with_code(places[cls], how).task
    assert found(Rendezvous, Launch()) is None
    assert found(Here, Launch()) == f"{__file__}:Here"
    (tmp_path / "own.py").write_text("")
    named = f"{tmp_path}/own.py:Local"
    assert found(Local, Launch(task=named)) == named
    with pytest.raises(UserError, match=r"task: Local is code of your own.*take parallel='vmap'"):
        found(Local, Launch())


def test_the_second_request_to_stop_ends_at_once(monkeypatch):
    told, ended = [], []
    monkeypatch.setattr("os._exit", ended.append)
    stop = Stop(lambda: told.append("first"))
    assert not stop() and stop.code == 0
    stop.ask(2)
    assert stop() and stop.code == 130 and (told, ended) == (["first"], [])
    stop.ask(15)
    assert ended == [143]
