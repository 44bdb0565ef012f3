"""Nothing is lost: a run that was stopped, killed or damaged ends as if nothing had happened."""

import dataclasses
import errno
import importlib
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import shrunk

from marlyap.cli import main
from marlyap.compute import export_cache
from marlyap.errors import UserError
from marlyap.games.dynamics import SingleIntegrator
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithms import ALGORITHMS, MASAC
from marlyap.learning.constraints import Lyapunov
from marlyap.learning.health import Health
from marlyap.learning.trainer import Schedule, Trainer
from marlyap.runs import config, events, launch as launching
from marlyap.runs.fit import Diverged, fit as fit_runs
from marlyap.runs.job import Job, Launch
from marlyap.runs.run import Run, begin
from marlyap.simulation.rollout import first_fault
from marlyap.storage import store
from marlyap.tasks import Rendezvous


FIT = importlib.import_module("marlyap.runs.fit")
NAMES = {"task": "rendezvous", "algorithm": "tiny", "preset": "tuned"}
GAME = Rendezvous(agents=2, horizon=4, dynamics=SingleIntegrator())
SCHEDULE = Schedule(
    steps=48,  # six iterations
    environments=2,
    steps_per_update=4,
    warmup=8,
    capacity=40,  # ten episodes: full after four iterations, overwritten from the fifth
    select_every=4,
    select_episodes=4,
)
SINGLE, PAIR = (5,), (5, 6)


def trainer(name, schedule=SCHEDULE):
    """A tiny one; `name` may go on with a reading of the Lyapunov constraint, after a colon."""
    name, _, reading = name.partition(":")
    algorithm = shrunk(ALGORITHMS[name], actor_width=4, critic_width=4, batch=4)
    if reading:
        function = "norm" if reading == "score" else "squares"
        constraint = Lyapunov(reading=reading, function=function)
        algorithm = dataclasses.replace(algorithm, constraint=constraint)
    return Trainer(GAME, algorithm, schedule)


def runs_in(place, name, seeds):
    return [Run.create(place / f"seed{s}", trainer(name), s, NAMES) for s in seeds]


def until(iterations):
    """A `stop` that says so after this many iterations."""
    asked = itertools.count()
    return lambda: next(asked) >= iterations


def fit(*args, **kwargs):
    """What `fit` tells, of a Progress its line of the log; checkpoints are read from disk."""
    for event in fit_runs(*args, **kwargs):
        if not isinstance(event, events.Saved):
            yield event.line if isinstance(event, events.Progress) else event


def final(run):
    """All that a run leaves, the time it took apart: arrays, their meta, policy and log."""
    saved, policy = run.checkpoints.latest(), store.read(run.directory / "policy", "policy")
    log = [{k: v for k, v in line.items() if k != "seconds"} for line in run.history()]
    return {
        "step": saved.step,
        "arrays": {k: (x.dtype, x.shape, x.tobytes()) for k, x in saved.arrays.items()},
        "policy": {k: (x.dtype, x.shape, x.tobytes()) for k, x in policy[0].items()},
        "about": policy[1],
        "log": log,
    }


def contents(directory):
    files = sorted(p for p in directory.rglob("*") if p.is_file() and p.name != ".lock")
    return {str(p.relative_to(directory)): p.read_bytes() for p in files}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """What uninterrupted runs leave; each is trained when it is first asked for."""
    known = {}

    def of(name, seeds):
        if (name, seeds) not in known:
            runs = runs_in(tmp_path_factory.mktemp("whole"), name, seeds)
            list(fit(runs))
            known[name, seeds] = [final(run) for run in runs]
        return known[name, seeds]

    return of


@pytest.fixture
def eager(monkeypatch):
    """A checkpoint after every iteration."""
    monkeypatch.setattr(FIT, "PATIENCE", 0.0)
    monkeypatch.setattr(FIT, "SHARE", 1e9)


# --- Stopped and resumed -------------------------------------------------------------------------


CUTS = {
    "before the first iteration": [0],
    "after the first iteration": [1],
    "in mid run": [3],
    "with the memory just full": [4],
    "with the memory overwritten": [5],
    "after each iteration": [1] * 5,
    "at the end": [6],
}


QUICK_CUTS = ("in mid run", "after each iteration")


@pytest.mark.parametrize("seeds", [SINGLE, PAIR], ids=["single", "vmapped pair"])
@pytest.mark.parametrize("name", ["masac-lyapunov", pytest.param("masac", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "cut", [c if c in QUICK_CUTS else pytest.param(c, marks=pytest.mark.slow) for c in CUTS]
)
def test_a_stopped_run_ends_bit_for_bit_like_an_uninterrupted_one(
    cut, name, seeds, uninterrupted, tmp_path
):
    made = runs_in(tmp_path, name, seeds)
    done = 0
    for iterations in CUTS[cut]:
        list(fit([Run.open(run.directory) for run in made], until(iterations)))
        done += iterations
        assert [run.checkpoints.latest().step for run in made] == [done] * len(seeds)
    runs = [Run.open(run.directory) for run in made]
    assert [run.finished for run in runs] == [done == 6] * len(seeds)
    lines = list(fit(runs))
    assert [e["iteration"] for e in lines if e["seed"] == 5] == [*range(done + 1, 7)]
    for run, whole in zip(runs, uninterrupted(name, seeds), strict=True):
        assert final(run) == whole
        assert [line["iteration"] for line in run.history()] == [1, 2, 3, 4, 5, 6]
        assert run.finished


EACH = sorted({*ALGORITHMS} - {"masac", "masac-lyapunov"})
EACH += [f"masac-lyapunov:{reading}" for reading in ("literal", "hinge", "score")]
QUICK = ("apg", "matd3")


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in EACH]
)
def test_each_algorithm_and_each_reading_resumes_bit_for_bit(
    name, uninterrupted, tmp_path, monkeypatch
):
    """Cut in mid-decay, when the memory has just been overwritten; with programs that are kept.

    The uninterrupted run traces its own, each once; the resumed one traces none.
    """
    traces = Counter()

    def counted(part):
        f = getattr(Trainer, part)

        def trace(self, *args):
            traces[part] += 1
            return f(self, *args)

        return trace

    with monkeypatch.context() as patched:
        for part in ("begin", "iterate", "select_best"):
            patched.setattr(Trainer, part, counted(part))
        whole = uninterrupted(name, SINGLE)
    assert traces == {"begin": 1, "iterate": 1, "select_best": 1}
    monkeypatch.setenv(export_cache.FOLDER, str(tmp_path / "programs"))
    (run,) = runs_in(tmp_path, name, SINGLE)
    list(fit([run], until(5)))
    assert run.checkpoints.latest().step == 5
    monkeypatch.setattr(Trainer, "iterate", None)
    list(fit([Run.open(run.directory)]))
    assert [final(run)] == whole


def test_the_whole_state_is_in_the_checkpoint(uninterrupted):
    (whole,) = uninterrupted("masac-lyapunov", SINGLE)
    parts = ("learner", "key", "iteration", "best", "score")
    for part in parts:
        assert any(key.startswith(f".{part}") for key in whole["arrays"]), part
    assert {key.split(".")[1].split("[")[0] for key in whole["arrays"]} == {*parts}
    for part in (".learner.networks", ".learner.memory"):
        assert any(key.startswith(part) for key in whole["arrays"]), part
    assert all(len(part) for part in ("arrays", "policy", "log"))


def test_seeds_differ_and_vmapping_changes_no_record(uninterrupted):
    one, (a, b) = uninterrupted("masac", SINGLE)[0], uninterrupted("masac", PAIR)
    assert a["arrays"].keys() == b["arrays"].keys() == one["arrays"].keys()
    assert a["arrays"] != b["arrays"]
    assert one["log"][0]["return"] == pytest.approx(a["log"][0]["return"], rel=1e-4)


def test_every_kind_of_end_is_a_checkpoint(eager, uninterrupted, tmp_path):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    list(fit([run]))
    assert run.checkpoints.steps() == [5, 6]
    assert final(run) == uninterrupted("masac", SINGLE)[0]


def test_a_generator_that_is_dropped_leaves_a_run_to_go_on_with(eager, uninterrupted, tmp_path):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    lines = fit_runs([run])
    while next(lines) != events.Saved(*run.named, 3):
        pass
    progress = next(lines)
    assert isinstance(progress, events.Progress) and progress.line["iteration"] == 4
    lines.close()  # pyright: ignore  # as a raised exception would; the fourth iteration is not yet saved
    assert run.checkpoints.latest().step == 3
    list(fit([run]))  # and the lock is free
    assert final(run) == uninterrupted("masac", SINGLE)[0]


# --- Damage --------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def unhurried(monkeypatch):
    """However slow the machine, a run is saved where it stops and nowhere else."""
    monkeypatch.setattr(FIT, "PATIENCE", 1e9)


def spoil(run, step):
    path = run.checkpoints.path(step) / store.PAYLOAD
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


def test_the_newest_checkpoint_damaged_costs_its_iterations_and_a_warning(uninterrupted, tmp_path):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    for _ in range(2):
        list(fit([run], until(2)))
    spoil(run, 4)
    first, *lines = fit([Run.open(run.directory)])
    assert "Checkpoint 4 was passed over" in first.says and first.seed == 5
    assert [e["iteration"] for e in lines] == [3, 4, 5, 6]
    assert final(run) == uninterrupted("masac", SINGLE)[0]


def test_all_checkpoints_damaged_is_refused_and_nothing_is_written(tmp_path):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    for _ in range(2):
        list(fit([run], until(2)))
    spoil(run, 2)
    spoil(run, 4)
    before = contents(run.directory)
    with pytest.raises(UserError, match="no checkpoint to load"):
        list(fit([Run.open(run.directory)]))
    assert contents(run.directory) == before


def test_one_of_a_pair_falling_back_does_not_mislead_the_other(uninterrupted, tmp_path):
    runs = runs_in(tmp_path, "masac", PAIR)
    for _ in range(2):
        list(fit(runs, until(2)))
    spoil(runs[1], 4)
    warned, *lines = fit([Run.open(run.directory) for run in runs])
    assert isinstance(warned, events.Warned) and warned.run == str(runs[1].directory)
    assert [e["iteration"] for e in lines if e["seed"] == 5] == [5, 6]
    assert [e["iteration"] for e in lines if e["seed"] == 6] == [3, 4, 5, 6]
    for run, whole in zip(runs, uninterrupted("masac", PAIR), strict=True):
        assert run.checkpoints.latest().step == 6
        assert [line["iteration"] for line in run.history()] == [1, 2, 3, 4, 5, 6]
        assert final(run)["step"] == whole["step"]


def test_a_log_ahead_of_the_checkpoint_or_cut_short_is_mended(uninterrupted, tmp_path):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    list(fit([run], until(3)))
    with open(run.directory / "log.jsonl", "a") as file:  # as a kill leaves it
        file.write('{"iteration": 4, "seed": 5}\n{"iteration": 5, "se')
    list(fit([Run.open(run.directory)]))
    assert final(run) == uninterrupted("masac", SINGLE)[0]


def test_a_directory_that_vanishes_in_mid_run_is_said(tmp_path):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    lines = fit([run])
    next(lines)
    shutil.rmtree(run.directory)
    with pytest.raises(UserError, match="could not be written .*; make sure"):
        list(lines)
    assert not run.directory.exists()


def test_a_disk_that_fills_up_costs_what_was_not_saved(uninterrupted, tmp_path, monkeypatch):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    list(fit([run], until(2)))
    write = store._write_file

    def full(path, chunks):
        if path.name == store.PAYLOAD:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(path, chunks)

    monkeypatch.setattr(store, "_write_file", full)
    with pytest.raises(UserError, match="No space left on device.*; free some disk space"):
        list(fit([run]))
    monkeypatch.undo()
    assert run.checkpoints.latest().step == 2 and run.checkpoints.steps() == [2]
    list(fit([run]))
    assert final(run) == uninterrupted("masac", SINGLE)[0]


@pytest.mark.parametrize("field, value", [("actor_width", 5), ("batch", 4.5)])
def test_a_checkpoint_of_another_config_is_refused(field, value, tmp_path):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    list(fit([run], until(1)))
    about = json.loads((run.directory / "run.json").read_text())
    about["algorithm"][field] = value
    (run.directory / "run.json").write_text(json.dumps(about))
    with pytest.raises(UserError):
        list(fit([Run.open(run.directory)]))
    assert run.checkpoints.steps() == [1]


# --- Numbers that are not finite -----------------------------------------------------------------


def poison(monkeypatch, seeds):
    """Give the runs of these seeds a temperature that is not a number when they are loaded."""
    load = Run.load

    def poisoned(self):
        carry, seconds, warnings = load(self)
        if self.seed in seeds:
            nan = jnp.full((), jnp.nan, jnp.float32)
            carry = eqx.tree_at(lambda c: c.learner.networks.log_alpha.value, carry, nan)
        return carry, seconds, warnings

    monkeypatch.setattr(Run, "load", poisoned)


def test_a_diverged_seed_does_not_touch_its_neighbour(uninterrupted, tmp_path, monkeypatch):
    runs = runs_in(tmp_path, "masac", PAIR)
    list(fit(runs, until(2)))
    before = contents(runs[1].directory)
    poison(monkeypatch, {6})
    told = list(fit(runs))
    (fault,) = [e for e in told if isinstance(e, events.Diverged)]
    assert (fault.run, fault.seed, fault.iteration) == (*runs[1].named, 3)
    assert fault.quantity in ("J_Q", "J_pi", "alpha")
    assert re.search(r"\(seed 6\), first in the .* in update 1 of iteration 3;", fault.says)
    assert [(e["seed"], e["iteration"]) for e in told if e is not fault] == [
        (5, 3),
        (5, 4),
        (5, 5),
        (5, 6),
    ]
    assert final(runs[0]) == uninterrupted("masac", PAIR)[0]
    assert contents(runs[1].directory) == before and not runs[1].finished

    monkeypatch.undo()  # what was saved is sound, so the fallen seed can be resumed
    list(fit([Run.open(runs[1].directory)]))
    assert runs[1].checkpoints.latest().step == 6


def test_when_all_diverge_training_stops_and_the_checkpoints_stay(tmp_path, monkeypatch):
    runs = runs_in(tmp_path, "masac", PAIR)
    list(fit(runs, until(2)))
    before = [contents(run.directory) for run in runs]
    poison(monkeypatch, {5, 6})
    told = []
    with pytest.raises(Diverged, match=r"iteration 3 \(seed \d\).*lower the learning rates"):
        for event in fit(runs):
            told.append(event)
    assert [e.seed for e in told] == [5, 6]
    assert [contents(run.directory) for run in runs] == before


def test_a_run_rolls_back_and_tries_other_random_numbers(uninterrupted, tmp_path, monkeypatch):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    list(fit([run], until(2)))
    sound, loads = Run.load, itertools.count()
    poison(monkeypatch, {5})
    bad = Run.load
    monkeypatch.setattr(Run, "load", lambda run: (sound if next(loads) else bad)(run))
    fault, warned, *lines = fit([run], attempts=2)
    assert isinstance(fault, events.Diverged) and fault.iteration == 3
    assert isinstance(warned, events.Warned) and "with other random numbers" in warned.says
    assert [line["iteration"] for line in lines] == [3, 4, 5, 6]
    assert [line["iteration"] for line in run.history()] == [1, 2, 3, 4, 5, 6]
    found, whole = final(run), uninterrupted("masac", SINGLE)[0]
    assert found["log"][:2] == whole["log"][:2] and found["log"][2] != whole["log"][2]
    assert all(np.isfinite(line["J_Q"]) for line in found["log"])


def test_what_fails_every_time_is_given_up(tmp_path, monkeypatch):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    list(fit([run], until(2)))
    before = contents(run.directory)
    poison(monkeypatch, {5})
    with pytest.raises(Diverged, match="lower the learning rates"):
        list(fit([run], attempts=3))
    assert contents(run.directory) == before


class Faulty(MASAC):
    """In the third update the bias of agent 1 becomes infinite: as an overflow would have it."""

    def update(self, learner, b, decay):
        learner, info = super().update(learner, b, decay)
        bias = lambda l: l.pi.value.net.layers[1].bias
        third = learner.pi.memory.count == 3
        value = bias(learner).at[1, 2].add(jnp.where(third, jnp.inf, 0.0))
        return eqx.tree_at(bias, learner, value), info


def test_the_array_the_agent_and_the_update_are_named(tmp_path):
    small = trainer("masac").algorithm
    algorithm = Faulty(actor_width=4, critic_width=4, batch=4, constraint=small.constraint)
    run = Run.create(tmp_path / "seed5", Trainer(GAME, algorithm, SCHEDULE), 5, NAMES)
    says = (
        r"\(seed 5\), first in the parameter pi\.net\.layers\[1\]\.bias of agent 1 "
        r"in update 1 of iteration 2; lower the learning rates"
    )
    with pytest.raises(Diverged, match=says):
        list(fit([run]))


class Holed(Rendezvous):
    def rewards(self, state, action):
        hole = (state.t == 2) & (jnp.arange(self.agents) == 1)
        return jnp.where(hole, jnp.nan, super().rewards(state, action))


def test_the_agent_and_the_step_of_a_bad_reward_are_named():
    game = Holed(agents=2, horizon=4, dynamics=SingleIntegrator())
    says = r"reward: .* in the warm-up \(seed 0\), first for agent 1 at step 2; correct the task"
    with pytest.raises(UserError, match=says):
        begin(Trainer(game, trainer("masac").algorithm, SCHEDULE), 0)
    line, sound = {"seed": 0, "iteration": 7, "J_Q": np.nan}, Health.sound()
    fault = lambda health: FIT._fault(line, health, 2)
    found = fault(sound._replace(reward=jnp.asarray(5), negative=jnp.asarray(1)))
    says = "in iteration 7 (seed 0), first for agent 1 at step 2; correct the task"
    assert found.name == "reward" and says in found.says()
    found = fault(sound._replace(negative=jnp.asarray(0)))
    assert found.says().startswith("cost: the task returned a negative number in iteration 7")
    assert fault(sound).name == "J_Q"
    line["J_Q"] = 0.0
    assert fault(sound) is None
    assert fault(sound._replace(action=jnp.asarray(0))).name == "action"
    found = fault(sound._replace(networks=jnp.asarray(1)))
    assert found.name == "networks" and "training made" in found.says()


def test_the_first_fault_of_an_episode():
    x = np.zeros((3, 4, 2, 5), np.float32)
    assert int(first_fault(jnp.asarray(x))) == -1
    x[2, 3, 0, 1], x[0, 3, 1, 4], x[1, 2, 1, 0] = np.nan, np.inf, -np.inf
    assert divmod(int(first_fault(jnp.asarray(x))), 2) == (2, 1)


LOUD = """
from marlyap.games.dynamics import SingleIntegrator
from marlyap.tasks import Rendezvous

class Loud(Rendezvous):
    agents: int = 2
    horizon: int = 4
    dynamics: SingleIntegrator = SingleIntegrator()

    def costs(self, state, action):
        print("loud")
        return super().costs(state, action)
"""


def test_a_process_that_fails_leaves_the_other_seeds_alone(tmp_path, monkeypatch):
    """Seed 5 ends at once with an error, seed 6 goes on; then the error is told."""
    five, six = runs = runs_in(tmp_path, "masac", PAIR)
    fault, done = events.Failed(*five.named, "J_Q: it diverged."), events.Finished(*six.named)
    answers = {5: (0.0, events.to_json(fault), 2), 6: (0.5, events.to_json(done), 0)}
    script = "import json, sys, time; job = json.loads(sys.stdin.readline())\n"
    script += f"wait, text, code = {answers}[int(job['run'][-1])]\n"
    script += "time.sleep(wait); print(text); sys.exit(code)"
    monkeypatch.setattr(launching, "WORKER", (sys.executable, "-c", script))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    told = []
    with pytest.raises(UserError, match="^J_Q: it diverged.$"):
        for event in launching.launch(runs, Launch("process")):
            told.append(event)
    assert told == [events.Started(*five.named), events.Started(*six.named), fault, done]


def test_a_process_that_is_killed_is_told_with_its_last_words(tmp_path, monkeypatch):
    """However much it says on standard error: nobody reads that before it has ended."""
    runs = runs_in(tmp_path, "masac", PAIR)
    script = "import os, sys; print('x' * 200_000 + '\\nthe end', file=sys.stderr, flush=True); "
    script += "os.kill(os.getpid(), 9)"
    monkeypatch.setattr(launching, "WORKER", (sys.executable, "-c", script))
    says = f"^{runs[0].directory}: its process ended with code -9 \\(the end\\); resume it"
    with pytest.raises(UserError, match=says):
        list(launching.launch(runs, Launch("process")))


WAITS = """
import sys
from marlyap.runs import events
from marlyap.runs.job import Job
job = Job.from_json(sys.stdin.readline())
for line in sys.stdin:
    if line == "stop\\n":
        sys.exit(143)
    raise AssertionError(line)
open(job.run + "/orphan", "w").close()  # the end of the input: the parent is gone
"""


def test_processes_are_asked_to_stop_and_waited_for(tmp_path, monkeypatch):
    runs = runs_in(tmp_path, "masac", PAIR)
    monkeypatch.setattr(launching, "WORKER", (sys.executable, "-c", WAITS))
    started = [events.Started(*run.named) for run in runs]
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    assert list(launching.launch(runs, Launch("process"), until(4))) == started
    happening = launching.launch(runs, Launch("process"))
    assert [next(happening) for _ in runs] == started
    happening.close()  # pyright: ignore
    assert not list(tmp_path.rglob("orphan"))


def test_a_process_hears_that_its_parent_was_killed(tmp_path):
    runs = runs_in(tmp_path, "masac", PAIR)
    script = "import os, sys; from marlyap import Run; from marlyap.runs import launch as l; "
    script += f"l.WORKER = (sys.executable, '-c', {WAITS!r}); "
    script += "l.os.sched_getaffinity = lambda _: {0, 1}; "
    script += "happening = l.launch([Run.open(p) for p in sys.argv[1:]], l.Launch('process')); "
    script += "next(happening); next(happening); os.kill(os.getpid(), 9)"
    places = [str(run.directory) for run in runs]
    subprocess.run([sys.executable, "-c", script, *places], timeout=120)
    deadline = time.monotonic() + 60
    while len(list(tmp_path.rglob("orphan"))) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_worker_does_its_job_and_obeys(tmp_path):
    """The real one: a job on its input, events on its output, and what a task prints elsewhere."""
    (tmp_path / "own.py").write_text(LOUD)
    game = config.load(f"{tmp_path}/own.py:Loud", AbstractGame)
    small = dataclasses.replace(trainer("masac"), game=game)
    run = Run.create(tmp_path / "seed5", small, 5, {"task": "Loud"})
    how = launching._with_code(run, Launch())
    assert how.task == f"{tmp_path}/own.py:Loud" and how.algorithm is None
    with subprocess.Popen(
        launching.WORKER, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env=os.environ | {"JAX_PLATFORMS": "cpu"},
    ) as child:  # fmt: skip
        assert child.stdin is not None and child.stdout is not None
        child.stdin.write(Job(str(run.directory), None, how).to_json() + "\n")
        child.stdin.flush()
        told = [events.from_json(child.stdout.readline())]
        child.stdin.write("stop\n")
        child.stdin.flush()
        told += [events.from_json(line) for line in child.stdout]
        assert child.stderr is not None and "loud" in child.stderr.read()
        code = child.wait()
    done = max(e.line["iteration"] for e in told if isinstance(e, events.Progress))
    assert code == (143 if done < 6 else 0) and run.checkpoints.latest().step == done
    assert events.Saved(*run.named, done) in told
    assert (events.Finished(*run.named) in told) == (done == 6)


def test_runs_side_by_side_go_by_their_settings_and_faults_are_told_at_the_end(monkeypatch):
    """On a GPU: one program for runs that differ in their seed alone, the next one after it."""

    class Named(str):
        side_by_side = True

    class Known(Run):
        finished = property(lambda self: self.done)

        def __init__(self, name, seed, done=True):
            trainer = Named(name)
            vars(self).update(
                trainer=trainer, seed=seed, done=done, directory=Path(f"{trainer}{seed}")
            )

    run = Known
    groups = []
    monkeypatch.setattr(launching, "program", lambda trainer: trainer)

    def fit(group, stop, attempts, log):
        groups.append([(r.trainer, r.seed) for r in group])
        for r in group:
            event = events.Progress(*r.named, {"steps": 8}, 1)
            yield event if r.finished else events.Diverged(*r.named, 1, "J_Q", f"{r.directory}!")
        if not any(r.finished for r in group):
            raise Diverged("all of c!")

    monkeypatch.setattr(launching, "fit", fit)
    together = lambda runs: list(launching.together(runs, Launch(), lambda: False))
    kinds = [events.Progress, events.Progress, events.Finished, events.Finished]
    told = together([run("a", 0), run("b", 0), run("a", 1)])
    assert [type(e) for e in told] == [*kinds, events.Progress, events.Finished]
    assert [e.run for e in told] == ["a0", "a1", "a0", "a1", "b0", "b0"]
    assert groups == [[("a", 0), ("a", 1)], [("b", 0)]]
    with pytest.raises(UserError, match="^b1!$"):
        together([run("b", 1, False), run("b", 2), run("c", 3, False), run("d", 4)])
    assert groups[2:] == [[("b", 1), ("b", 2)], [("c", 3)], [("d", 4)]]


# --- Two at once, signals and kills --------------------------------------------------------------


def test_a_run_in_use_is_refused(tmp_path):
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    before = contents(run.directory)
    with store.lock(run.directory):
        with pytest.raises(UserError, match=f"in use by process {os.getpid()}"):
            next(fit([run]))
    assert contents(run.directory) == before


def test_a_pair_is_refused_when_one_of_them_is_in_use(tmp_path):
    a, b = runs_in(tmp_path, "masac", PAIR)
    with store.lock(b.directory), pytest.raises(UserError, match="in use"):
        next(fit([a, b]))
    with store.lock(a.directory):  # was given back
        pass


ENDLESS = dataclasses.replace(SCHEDULE, steps=10**9, select_every=10**9)
EAGER = """
import sys
import marlyap.runs.fit as f
f.PATIENCE, f.SHARE = 0.0, 1e9
from marlyap.cli import main
sys.exit(main(sys.argv[1:]))
"""


def as_users_have_it(env):
    """Programs are kept, and XLA fuses as it does by default.

    With the older fusion of the tests a program that was kept rounds otherwise than one that has
    just been traced.
    """
    return {k: v for k, v in env.items() if not k.startswith("MARLYAP") and k != "XLA_FLAGS"}


UNTIL = """
import itertools, sys
from marlyap.runs.environment import prepare
prepare()
from marlyap.runs.fit import fit
from marlyap.runs.run import Run
asked = itertools.count()
list(fit([Run.open(sys.argv[1])], lambda: next(asked) >= int(sys.argv[2])))
"""


class Child:
    """A training process that goes on with `run`."""

    def __init__(self, run, *python):
        self.run, self.says = run, run.directory.parent / f"{time.monotonic_ns()}.txt"
        self.lines = len(run.history())
        self.log = run.directory / "log.jsonl"
        env = os.environ | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1"}
        command = [*(python or ["-m", "marlyap"]), "train", "--resume", str(run.directory)]
        with open(self.says, "w") as file:
            self.process = subprocess.Popen(
                [sys.executable, *command],
                stdout=file,
                stderr=file,
                env=as_users_have_it(env),
                start_new_session=True,
            )

    def until_it_trains(self):
        deadline = time.monotonic() + 400
        while not self.log.is_file() or self.log.read_bytes().count(b"\n") < self.lines + 3:
            assert self.process.poll() is None, self.says.read_text()
            assert time.monotonic() < deadline, "it does not train"
            time.sleep(0.02)

    def end(self, *signals):
        for number in signals:
            self.process.send_signal(number)
        code = self.process.wait(120)
        return code, self.says.read_text()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


@pytest.mark.slow
@pytest.mark.usefixtures("full_compilation")
def test_signals_and_kills_lose_nothing(tmp_path, capsys):
    endless = trainer("masac", ENDLESS)
    run = Run.create(tmp_path / "seed5", endless, 5, NAMES)

    with Child(run) as child:
        child.until_it_trains()
        capsys.readouterr()
        assert main(["train", "--resume", str(run.directory)]) == 2  # a second trainer
        assert f"in use by process {child.process.pid}" in capsys.readouterr().err
        code, said = child.end(signal.SIGINT)
    assert code == 130 and "Traceback" not in said
    assert f"marlyap train --resume {run.directory}" in said
    first = run.checkpoints.latest()
    assert first.step == len(run.history()) >= 3 and first.warnings == ()

    with Child(run) as child:
        child.until_it_trains()
        code, said = child.end(signal.SIGTERM)
    assert code == 143 and f"marlyap train --resume {run.directory}" in said
    second = run.checkpoints.latest()
    assert second.step == len(run.history()) > first.step

    with Child(run) as child:
        child.until_it_trains()
        code, said = child.end(signal.SIGINT, signal.SIGINT)
    assert code == 130 and "Traceback" not in said
    third = run.checkpoints.latest()
    assert third.step >= second.step and third.warnings == ()

    with Child(run, "-c", EAGER) as child:  # saves all the time, so the kill falls into a save
        child.until_it_trains()
        code, said = child.end(signal.SIGKILL)
    assert code == -signal.SIGKILL and "Traceback" not in said
    carry, _, warnings = Run.open(run.directory).load()
    assert int(carry.iteration) > third.step and warnings == ()

    list(fit([run], lambda: True))  # opens it, cleans up, saves
    names = [p.name for p in run.directory.rglob("*")]
    assert not [n for n in names if n.endswith((".tmp", ".old"))]
    assert len(run.history()) == int(carry.iteration)

    # four processes on, it is where one that was never stopped would be
    whole = Run.create(tmp_path / "whole", endless, 5, NAMES)
    words = [sys.executable, "-c", UNTIL, str(whole.directory), str(int(carry.iteration))]
    subprocess.run(words, check=True, env=as_users_have_it(os.environ))
    one, found = whole.checkpoints.latest(), run.checkpoints.latest()
    assert found.step == one.step and found.arrays.keys() == one.arrays.keys()
    for key, value in one.arrays.items():
        np.testing.assert_array_equal(found.arrays[key], value, err_msg=key, strict=True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["INT", "TERM"])
def test_what_is_stopped_says_how_to_go_on(number, tmp_path, capsys, monkeypatch):
    """The first signal is remembered until the end of the iteration; the handler is put back."""
    (run,) = runs_in(tmp_path, "masac", SINGLE)
    line, before = Run.log, signal.getsignal(number)

    def interrupted(self, entry):
        whole = line(self, entry)
        if entry["iteration"] == 2:
            os.kill(os.getpid(), number)
        return whole

    monkeypatch.setattr(Run, "log", interrupted)
    assert main(["train", "--resume", str(run.directory), "--json"]) == 128 + number
    said = capsys.readouterr()
    assert f"Resume with: marlyap train --resume {run.directory}" in said.err
    assert "Stopping at the next checkpoint; once more to stop at once." in said.err
    state = {"run": str(run.directory), "seed": 5, "steps": 16, "finished": False}
    assert json.loads(said.out) == {"runs": [state]}
    assert signal.getsignal(number) == before
    assert Path(run.checkpoints.path(2)).is_dir()
