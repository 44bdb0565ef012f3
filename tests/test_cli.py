"""The command line: help at once, one sentence for bad input, one JSON object for machines."""

import contextlib
import importlib
import io
import json
import os
import re
import resource
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.cli import main
from marlyap.cli.parser import VERBS as TABLE, parser
from marlyap.games.game import AbstractGame
from marlyap.runs import config
from marlyap.runs.run import Run
from marlyap.storage import store


FIT = importlib.import_module("marlyap.runs.fit")
TINY = """--task.agents 2 --task.horizon 4 --task.dynamics single-integrator --steps 48
--schedule.environments 2 --schedule.steps_per_update 4 --schedule.warmup 8 --schedule.capacity 40
--schedule.select_every 4 --schedule.select_episodes 4
--algorithm.actor_width 4 --algorithm.critic_width 4 --algorithm.batch 4""".split()
VERBS = sorted(TABLE)


def call(capsys, *argv):
    """Exit code, standard output and standard error of one command, in this process."""
    capsys.readouterr()
    code = main([str(word) for word in argv])
    said = capsys.readouterr()
    return code, said.out, said.err


def refused(capsys, *argv, parts=()):
    """The sentence with which a command is refused."""
    code, out, err = call(capsys, *argv)
    assert code == 2 and out == ""
    lines = err.strip().splitlines()
    assert lines and lines[-1].startswith("marlyap: ") and "Traceback" not in err
    for part in parts:
        assert part in lines[-1], lines[-1]
    return err


def strict(text):
    """The one JSON object that `text` is, without NaN or infinity."""

    def no(constant):
        raise AssertionError(f"{constant} is not JSON")

    found = json.loads(text, parse_constant=no)
    assert isinstance(found, dict)
    return found


def contents(directory):
    """Every file below `directory` with its bytes."""
    files = sorted(p for p in directory.rglob("*") if p.is_file())
    return {str(p.relative_to(directory)): p.read_bytes() for p in files}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Each test works in a directory of its own."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """(directory, standard output) of one tiny run, with a checkpoint at every iteration."""
    out = tmp_path_factory.mktemp("cli") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FIT, "PATIENCE", 0.0)
        patch.setattr(FIT, "SHARE", 1e9)
        command = ["train", "rendezvous", "masac-lyapunov", "--out", str(out), "--json", *TINY]
        text = io.StringIO()
        with contextlib.redirect_stdout(text):
            assert main(command) == 0
    return out, text.getvalue()


@pytest.fixture
def run(trained, tmp_path):
    """A copy of the tiny run, to be spoilt."""
    return shutil.copytree(trained[0], tmp_path / "copy") / "seed0"


@pytest.fixture
def unfinished(run):
    """The same as it was one iteration before its end."""
    newest = sorted((run / "checkpoints").iterdir())[-1]
    shutil.rmtree(newest)
    return run


# --- Help ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("argv", [[], *([verb] for verb in VERBS)], ids=lambda a: a and a[0] or "-")
def test_help_comes_at_once_and_without_jax(argv):
    def cpu():
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    before = cpu()
    command = [sys.executable, "-X", "importtime", "-m", "marlyap", *argv, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    seconds = cpu() - before
    imported = {line.split("|")[-1].strip().split(".")[0] for line in done.stderr.splitlines()}
    assert done.returncode == 0 and done.stdout.startswith("usage: marlyap")
    assert not imported & {"jax", "equinox", "numpy", "scipy", "rich", "matplotlib"}
    assert seconds < 0.5


def test_every_verb_is_in_the_help():
    told = parser().format_help()
    assert all(verb in told for verb in VERBS)


def test_the_version(capsys):
    from importlib.metadata import version

    assert call(capsys, "--version") == (0, version("marlyap") + "\n", "")


# --- Bad input -----------------------------------------------------------------------------------


TRAIN = ["train", "rendezvous", "masac"]
TOO_LONG = "x" * 300
BAD = [
    (["trian"], ["VERB", "'trian'", "train"]),
    (["train"], ["name a task and an algorithm"]),
    (["train", "rendezvous"], ["name a task and an algorithm"]),
    (["train", "rendevous", "masac"], ["task:", "did you mean 'rendezvous'?"]),
    (["train", "rendezvous", "masca"], ["algorithm:", "did you mean 'masac'?"]),
    (["train", "masac", "rendezvous"], ["task: no task is called 'masac'"]),
    (["train", "nowhere.py:Task", "masac"], ["task: there is no file nowhere.py"]),
    (["train", "rendezvous", "nowhere.py:Rule"], ["algorithm: there is no file nowhere.py"]),
    ([*TRAIN, "--sedes", "1"], ["--sedes"]),
    ([*TRAIN, "--step", "9"], ["--step"]),
    ([*TRAIN, "--tsk.agents", "3"], ["--tsk.agents"]),
    ([*TRAIN, "--steps", "many"], ["--steps", "'many'"]),
    ([*TRAIN, "--steps", "1.5"], ["--steps", "'1.5'"]),
    ([*TRAIN, "--steps", "0"], ["steps: 0 is out of range"]),
    ([*TRAIN, "--steps=-1"], ["steps: -1 is out of range"]),
    ([*TRAIN, "--task.agents", "0"], ["--task.agents: 0 is out of range"]),
    ([*TRAIN, "--task.agents", "two"], ["--task.agents: 'two' is not a whole number"]),
    ([*TRAIN, "--task.agnets", "3"], ["--task.agnets", "did you mean 'agents'?"]),
    ([*TRAIN, "--task.agents"], ["--task.agents: it needs a value"]),
    ([*TRAIN, "--task.agents=3", "--task.agents", "4"], ["--task.agents: it is given twice"]),
    ([*TRAIN, "--task.", "3"], ["--task."]),
    ([*TRAIN, "--task.leaders", "3"], ["--task.leaders: (3,)", "from 0 to 2"]),
    ([*TRAIN, "--task.leaders", "0,1,2,3"], ["--task.leaders"]),
    ([*TRAIN, "--task.leaders", "0,0"], ["--task.leaders", "twice"]),
    ([*TRAIN, "--task.graph", "0-1"], ["--task.graph: '0-1' is not connected"]),
    ([*TRAIN, "--task.graph", "0-1,1-7"], ["--task.graph: edge 1-7"]),
    ([*TRAIN, "--task.graph", "disk:0"], ["--task.graph: 'disk:0'"]),
    ([*TRAIN, "--task.radius", "nan"], ["--task.radius: 'nan'"]),
    ([*TRAIN, "--task.dynamics.limits", "5"], ["--task.dynamics.limits"]),
    ([*TRAIN, "--algorithm.constraint", "lyapnov"], ["--algorithm.constraint: 'lyapnov'"]),
    ([*TRAIN, "--algorithm.constraint.reading", "han"], ["--algorithm.constraint.reading"]),
    ([*TRAIN, "--schedule.environments", "0"], ["--schedule.environments: 0 is out of range"]),
    ([*TRAIN, "--seeds", "0", "1", "0"], ["seeds:", "twice"]),
    ([*TRAIN, "--seeds", "1,1"], ["seeds:", "twice"]),
    ([*TRAIN, "--seeds", "01", "1"], ["seeds:", "twice"]),
    ([*TRAIN, "--seeds", "-1"], ["seeds: -1 must lie between"]),
    ([*TRAIN, "--seeds", str(2**31)], ["seeds:", "must lie between"]),
    ([*TRAIN, "--seeds", "one"], ["seeds: 'one'"]),
    ([*TRAIN, "--seeds"], ["--seeds"]),
    ([*TRAIN, "--preset", "papr"], ["preset: 'papr' is unknown", "did you mean 'paper'?"]),
    ([*TRAIN, "--device", "tpu"], ["device: 'tpu' must be cpu or gpu"]),
    ([*TRAIN, "--out", "/proc/nowhere"], ["out: /proc/nowhere/seed0"]),
    (["train", "--resume", "nowhere"], ["run: nowhere is not a run"]),
    (["train", "--resume", "."], ["run: . is not a run and holds none"]),
    (["train", "--resume"], ["--resume"]),
    (["evaluate"], ["RUN"]),
    (["evaluate", "nowhere"], ["no run or controller 'nowhere'"]),
    (["evaluate", "point-ofset"], ["did you mean 'point-offset'?"]),
    (["evaluate", "point-offset"], ["point-offset needs --task"]),
    (["evaluate", "point-offset", "--task", "rendevous"], ["did you mean 'rendezvous'?"]),
    (["evaluate", "point-offset", "--task", "rendezvous", "--episodes", "0"], ["episodes: 0"]),
    (["evaluate", "point-offset", "--task", "rendezvous", "--episodes", "x"], ["--episodes"]),
    (["evaluate", "point-offset", "--confidence", "1"], ["confidence: 1.0 must lie between"]),
    (["evaluate", "point-offset", "--confidence", "nan"], ["confidence: nan"]),
    (["evaluate", "."], ["run: . is not a run and holds none"]),
    (["report", "nowhere"], ["run: nowhere is not a run"]),
    (["watch", "nowhere"], ["run: nowhere is not a run"]),
    (["watch"], ["RUN"]),
    (["list", "rendevous"], ["did you mean 'rendezvous'?"]),
    (["demo", "--seeds", "0", "0"], ["seeds:", "twice"]),
    (["demo", "--steps", "-3"], ["steps: -3 is out of range"]),
    ([*TRAIN, "--parallel", "many"], ["parallel: 'many' must be"]),
    ([*TRAIN, "--out", TOO_LONG], ["out:"]),
    (["evaluate", "point-offset", "--task", "rendezvous", "--seed", str(10**22)], ["seed"]),
]


@pytest.mark.parametrize("argv, parts", BAD, ids=lambda x: " ".join(x)[:60])
def test_bad_input_is_one_sentence_and_leaves_nothing(argv, parts, capsys, tmp_path):
    err = refused(capsys, *argv, parts=parts)
    assert len(err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("argv", [["trian"], [*TRAIN, "--task.agents", "0"]])
def test_the_process_exits_with_2_and_no_traceback(argv, tmp_path):
    command = [sys.executable, "-m", "marlyap", *argv]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("marlyap: ") and done.stderr.count("\n") == 1


def test_what_is_quoted_in_a_message_cannot_break_its_line(capsys):
    code, out, line = call(capsys, *TRAIN, "--task.graph", "a\nb\x1b[2J")
    assert code == 2 and out == "" and line.count("\n") == 1 and "\x1b" not in line


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_said(tmp_path):
    command = [sys.executable, "-m", "marlyap", *TRAIN, "--device", "gpu", *TINY]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.startswith("marlyap: device") and not list(tmp_path.iterdir())


def test_a_demo_of_no_steps_is_refused(capsys, monkeypatch):
    from marlyap.cli import training

    monkeypatch.setattr(training, "follow", lambda runs, how: 130)
    refused(capsys, "demo", "--steps", "0", parts=["steps: 0 is out of range"])


@pytest.mark.parametrize("what", ["--task.agents", "--schedule.steps", "--preset"])
def test_resume_refuses_what_it_would_ignore(what, unfinished, capsys, monkeypatch):
    from marlyap.cli import training

    monkeypatch.setattr(training, "follow", lambda runs, how: 0)
    value = "paper" if what == "--preset" else "3"
    refused(capsys, "train", "--resume", unfinished, what, value, parts=[what])


# --- The output directory ------------------------------------------------------------------------


def test_a_run_is_never_overwritten_without_force(run, capsys):
    before = contents(run)
    said = ["already exists", f"--resume {run}", "--force"]
    refused(capsys, *TRAIN, "--out", run.parent, *TINY, parts=said)
    assert contents(run) == before


def test_nor_is_anything_else_and_force_does_not_help(tmp_path, capsys):
    place = tmp_path / "mine" / "seed0"
    place.mkdir(parents=True)
    (place / "thesis.tex").write_text("years of work")
    refused(capsys, *TRAIN, "--out", place.parent, parts=["already exists"])
    refused(capsys, *TRAIN, "--out", place.parent, "--force", parts=["is not a run"])
    assert contents(place) == {"thesis.tex": b"years of work"}


def test_a_file_in_the_way(tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    refused(capsys, *TRAIN, "--out", "file", parts=["out: file/seed0"])
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "seed0").write_text("mine")
    refused(capsys, *TRAIN, "--out", "out", parts=["already exists"])
    refused(capsys, *TRAIN, "--out", "out", "--force", parts=["is not a run"])
    assert contents(tmp_path) == {"file": b"mine", "out/seed0": b"mine"}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_directory_one_may_not_write_in(tmp_path, capsys):
    (tmp_path / "locked").mkdir(mode=0o500)
    refused(capsys, *TRAIN, "--out", "locked/out", parts=["out: locked/out/seed0"])


def test_force_makes_the_run_anew(run, capsys, monkeypatch):
    from marlyap.cli import training

    monkeypatch.setattr(training, "follow", lambda runs, how: 0)
    code, _, _ = call(capsys, *TRAIN, "--out", run.parent, "--force", *TINY)
    assert code == 0 and sorted(contents(run)) == ["run.json"]


def test_all_places_are_checked_before_any_is_made(run, capsys):
    refused(capsys, *TRAIN, "--out", run.parent, "--seeds", "1", "0", parts=["already exists"])
    assert not (run.parent / "seed1").exists()


def test_force_does_not_destroy_a_run_in_use(run, capsys, monkeypatch):
    from marlyap.cli import training

    monkeypatch.setattr(training, "follow", lambda runs, how: 0)
    before = contents(run)
    with store.lock(run):
        refused(capsys, *TRAIN, "--out", run.parent, "--force", *TINY, parts=["in use"])
    assert contents(run).keys() >= before.keys()


# --- Runs that are damaged or not ours -----------------------------------------------------------


def put(field, value):
    def spoil(about):
        *outer, last = field.split(".")
        holder = about
        for name in outer:
            holder = holder[name]
        holder[last] = value
        return json.dumps(about)

    return spoil


def drop(field):
    return lambda about: json.dumps({k: v for k, v in about.items() if k != field})


SPOILT = {
    "empty": (lambda a: "", ["run.json"]),
    "cut short": (lambda a: json.dumps(a)[:200], ["run.json", "not sound JSON"]),
    "not JSON": (lambda a: "hello", ["run.json", "not sound JSON"]),
    "a list": (lambda a: "[]", ["lacks some of its fields"]),
    "NaN": (lambda a: json.dumps(a | {"seed": float("nan")}), ["not sound JSON"]),
    "deep": (lambda a: "[" * 10_000, ["nested too deeply"]),
    "a key twice": (lambda a: '{"seed": 0, "seed": 1}', ["twice"]),
    "of another program": (lambda a: '{"name": "x", "version": 3}', ["lacks some of its fields"]),
    "without its task": (drop("task"), ["lacks some of its fields"]),
    "newer": (put("schema", 99), ["schema 99"]),
    "older": (put("schema", 1), ["schema 1", "train it again"]),
    "seed of the wrong kind": (put("seed", "0"), ["seed or names of the wrong kind"]),
    "names of the wrong kind": (put("names", []), ["seed or names of the wrong kind"]),
    "unknown task": (put("task.kind", "Mine"), ["task: 'Mine'", "--task path/to/file.py:Mine"]),
    "unknown algorithm": (put("algorithm.kind", "PPO"), ["algorithm: 'PPO'", "--algorithm"]),
    "kinds exchanged": (put("task", {"kind": "MASAC"}), ["MASAC in the wrong place"]),
    "unknown field": (put("task.agnets", 3), ["task.agnets", "did you mean 'agents'?"]),
    "agents of the wrong kind": (put("task.agents", "2"), ["task.agents: '2'"]),
    "no agents": (put("task.agents", 0), ["task.agents: 0 is out of range"]),
    "bad graph": (put("task.graph", "0-9"), ["task.graph"]),
    "another width": (put("algorithm.actor_width", 5), ["array", "check that the config"]),
    "another team": (put("task.agents", 3), ["array", "check that the config"]),
}


@pytest.mark.parametrize("how", SPOILT)
def test_a_spoilt_run_json_is_refused(how, run, capsys):
    spoil, parts = SPOILT[how]
    about = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(spoil(about))
    refused(capsys, "evaluate", run, "--episodes", "20", parts=parts)


@pytest.mark.parametrize(
    "field, value, part",
    [
        ("task.dynamics", {"kind": "Schedule"}, "task.dynamics"),
        ("seed", -1, "seed"),
        ("seed", 10**30, "seed"),
        ("task.radius", 10**400, "task.radius"),
    ],
)
def test_a_run_json_that_only_looks_right_is_refused(field, value, part, run, capsys):
    about = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(put(field, value)(about))
    refused(capsys, "evaluate", run, "--episodes", "20", parts=[part])


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


DAMAGE = {
    "bit": lambda d: flip(d / store.PAYLOAD),
    "bit in the manifest": lambda d: flip(d / store.MANIFEST),
    "cut": lambda d: os.truncate(d / store.PAYLOAD, 100),
    "emptied": lambda d: os.truncate(d / store.MANIFEST, 0),
    "file gone": lambda d: (d / store.PAYLOAD).unlink(),
    "foreign file": lambda d: (d / "extra").write_text("x"),
    "link": lambda d: (
        (d / store.PAYLOAD).rename(d.parent / "away"),
        (d / store.PAYLOAD).symlink_to(d.parent / "away"),
    ),
}


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_policy_is_refused(how, run, capsys):
    DAMAGE[how](run / "policy")
    refused(capsys, "evaluate", run, "--episodes", "20", parts=["policy"])


def test_a_policy_of_another_kind_is_refused(run, capsys):
    shutil.rmtree(run / "policy")
    store.write(run / "policy", "checkpoint", {"a": np.zeros(3)}, {})
    refused(capsys, "evaluate", run, parts=["is of kind 'checkpoint', not 'policy'"])


def test_a_run_without_a_policy_is_refused(run, capsys):
    shutil.rmtree(run / "policy")
    refused(capsys, "evaluate", run, parts=["has no policy yet; train it first"])


def test_checkpoints_that_are_all_damaged_are_refused_and_kept(unfinished, capsys):
    for saved in (unfinished / "checkpoints").iterdir():
        DAMAGE["bit"](saved)
    before = contents(unfinished)
    refused(capsys, "train", "--resume", unfinished, parts=["no checkpoint to load"])
    assert contents(unfinished).items() >= {k: v for k, v in before.items() if k != ".lock"}.items()


def test_a_finished_run_is_left_as_it_is(run, capsys):
    before = contents(run)
    code, out, _ = call(capsys, "train", "--resume", run, "--json")
    assert code == 0 and strict(out)["runs"][0]["finished"] is True
    assert contents(run) == before


def test_the_same_run_twice_is_refused(run, capsys):
    for verb in (["train", "--resume"], ["report"]):
        refused(capsys, *verb, run, run, parts=["given twice"])


def test_the_same_run_twice_is_refused_by_evaluate(run, capsys):
    refused(capsys, "evaluate", run, run, "--episodes", "20", parts=["given twice"])


# --- Numbers that are not finite -----------------------------------------------------------------


OWN = '''
"""A task of one's own that goes wrong: everywhere, or for some targets."""
import jax.numpy as jnp
from marlyap.tasks import Rendezvous

class Poisoned(Rendezvous):
    bad: str = "costs"  # costs or observe
    far: float = 9.0  # targets beyond this are bad (m)

    def poison(self, state, value, what):
        return jnp.where((self.bad == what) & (self.goals(state)[0, 0] > self.far), jnp.nan, value)

    def observe(self, state, links):
        return self.poison(state, super().observe(state, links), "observe")

    def costs(self, state, action):
        return self.poison(state, super().costs(state, action), "costs")
'''


@pytest.fixture
def own(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    return f"{tmp_path}/own.py:Poisoned"


def test_nan_from_a_users_task_is_named_and_the_last_checkpoint_is_intact(
    own, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(FIT, "PATIENCE", 0.0)
    monkeypatch.setattr(FIT, "SHARE", 1e9)
    command = ["train", own, "masac", "--out", "out", *TINY, "--task.far", "0.6"]
    err = refused(
        capsys, *command, parts=["the task returned a number", "(seed 0)", "correct the task"]
    )
    assert "marlyap: cost" in err or "marlyap: reward" in err
    run = tmp_path / "out" / "seed0"
    at = int(err.split("in iteration ")[1].split()[0])
    assert at >= 2, "choose a seed whose first starts are sound"
    assert [line["iteration"] for line in store.read_jsonl(run / "log.jsonl")] == [*range(1, at)]

    opened = Run.open(run, config.load(own, AbstractGame))
    saved = opened.checkpoints.latest()
    assert saved.step == at - 1 and saved.warnings == ()
    numbers = [x for x in saved.arrays.values() if x.dtype.kind == "f"]
    assert numbers and all(np.isfinite(x).all() for x in numbers)
    leaves = jax.tree.leaves(opened.deployed()[0])
    assert all(jnp.isfinite(x).all() for x in leaves if isinstance(x, jax.Array))

    before = contents(run)
    again = refused(capsys, "train", "--resume", run, "--task", own, parts=["(seed 0)"])
    assert f"in iteration {at} " in again
    assert contents(run) == before


def test_nan_in_the_warm_up_is_blamed_on_the_task(own, capsys):
    command = ["train", own, "masac", "--out", "out", *TINY, "--task.far", "0.6"]
    refused(capsys, *command, "--seeds", "3", parts=["the task returned a number"])


def test_nan_in_what_a_task_observes_is_named_in_the_warm_up(own, tmp_path, capsys):
    command = ["train", own, "masac", "--out", "out", *TINY]
    bad = ["--task.bad", "observe", "--task.far", "-9"]
    refused(capsys, *command, *bad, parts=["obs: the task returned", "in the warm-up (seed 0)"])
    assert not (tmp_path / "out").exists()


# --- JSON ----------------------------------------------------------------------------------------


SHARE = {"episodes", "successes", "success_rate", "interval"}


def test_train_prints_one_object(trained):
    found = strict(trained[1])
    (run,) = found["runs"]
    assert run == {
        "run": str(trained[0] / "seed0"),
        "seed": 0,
        "steps": 48,
        "finished": True,
    }


def test_evaluate_prints_one_object(run, capsys):
    code, out, _ = call(capsys, "evaluate", run, "--json", "--episodes", "20")
    found = strict(out)
    assert code == 0 and SHARE | {"runs", "groups", "comparisons"} <= found.keys()
    assert found["episodes"] == 20 and 0 <= found["successes"] <= 20
    assert found["success_rate"] == found["successes"] / 20
    low, high = found["interval"]
    assert 0 <= low <= found["success_rate"] <= high <= 1
    assert [r["seed"] for r in found["runs"]] == [0] and len(found["groups"]) == 1
    assert all(SHARE <= part.keys() for part in found["runs"] + found["groups"])
    assert strict((run / "evaluation.json").read_text()) == found["runs"][0]
    again = call(capsys, "evaluate", run, "--json", "--episodes", "20")[1]
    assert again == out


def test_evaluate_pools_and_compares(run, capsys):
    sister = shutil.copytree(run, run.parent / "seed1")
    about = json.loads((sister / "run.json").read_text())
    (sister / "run.json").write_text(json.dumps(about | {"seed": 1}))
    task = ["--task", "rendezvous", *TINY[:6]]
    words = ["evaluate", run.parent, "point-offset", *task, "--json", "--episodes", "20"]
    code, out, err = call(capsys, *words)
    if code == 2:  # this controller does not drive single integrators
        assert "point-offset" in err.lower() or "dynamics" in err
        words.remove("point-offset")
        code, out, err = call(capsys, *words)
    found = strict(out)
    teams = {team["group"]: team for team in found["groups"]}
    together = next(team for team in teams.values() if team["seeds"] == [0, 1])
    assert code == 0 and together["episodes"] == 40
    assert together["successes"] == sum(
        r["successes"] for r in found["runs"] if r["seed"] in (0, 1)
    )
    assert ("episodes" in found) == (len(teams) == 1)  # nothing is said across configurations


def test_report_prints_one_object(run, capsys):
    code, out, err = call(capsys, "report", run, "--json", "--episodes", "20")
    found = strict(out)
    assert code == 0 and SHARE | {"report", "pictures"} <= found.keys()
    page = (run / "report.html").read_text()
    assert found["report"] == str(run / "report.html") and page.startswith("<!")
    assert all(os.path.getsize(p) > 1000 for p in found["pictures"])
    assert str(run / "report.html") in err


def test_watch_prints_one_object(run, capsys):
    code, out, _ = call(capsys, "watch", run, "--json")
    found = strict(out)
    assert code == 0 and isinstance(found["success"], bool)
    with open(found["gif"], "rb") as file:
        assert file.read(3) == b"GIF"
    assert os.path.getsize(found["html"]) > 1000
    refused(capsys, "watch", run, "--episode", "500", parts=["episode: 500 is out of range"])
    refused(capsys, "watch", run, "--episode", "-1", parts=["episode: -1 is out of range"])
    refused(capsys, "watch", run, "--out", "nowhere", parts=["out: there is no directory"])
    refused(capsys, "report", run, "--episodes", "0", parts=["episodes: 0 is out of range"])


def test_list_prints_one_object(capsys):
    code, out, _ = call(capsys, "list", "--json")
    found = strict(out)
    assert code == 0 and found.keys() == {
        *("tasks", "algorithms", "controllers", "certificates", "presets")
    }
    assert all(len(text) > 10 and "\n" not in text for f in found.values() for text in f.values())
    code, out, _ = call(capsys, "list")
    assert code == 0 and all(name in out for family in found.values() for name in family)


def test_list_shows_whole_sentences(capsys):
    found = strict(call(capsys, "list", "--json")[1])
    del found["presets"]
    for family in found.values():
        for text in family.values():
            assert re.fullmatch(r"[A-Z{].*\.( \(.*\))?", text), text


LAW = """
from marlyap.controllers import Zero
from marlyap.games.game import AbstractGame

class Push(Zero):
    game: AbstractGame
    gain: float = 0.5  # inputs for each metre
"""


def test_list_shows_the_gains_of_a_controller_of_ones_own(tmp_path, capsys):
    (tmp_path / "law.py").write_text(LAW)
    code, out, _ = call(capsys, "list", "law.py:Push", "--json")
    assert code == 0 and strict(out) == {
        "gain": {"value": "0.5", "meaning": "inputs for each metre"}
    }
    parts = ["law.py defines no task, algorithm or controller called 'Pull'"]
    refused(capsys, "list", "law.py:Pull", parts=parts)


def test_list_of_one_prints_one_object(capsys):
    code, out, _ = call(capsys, "list", "rendezvous", "--json")
    assert code == 0 and strict(out)["--task.agents"]["value"] == "3"


def test_list_of_one_in_a_process():
    command = [sys.executable, "-m", "marlyap", "list", "masac-lyapunov", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    found = strict(done.stdout)
    assert found["--algorithm.constraint.reading"]["value"] == "han"
    assert found["--algorithm.batch"] == {"value": "256", "meaning": "transitions per update"}


def test_demo_goes_on_with_what_is_there_and_prints_one_object(run, capsys):
    words = ["demo", "--out", run.parent, "--seeds", "0", "--json"]
    code, out, err = call(capsys, *words)
    found = strict(out)
    assert code == 0 and SHARE | {"report", "seconds"} <= found.keys()
    assert found["episodes"] == 500 and "of 500 held-out starts of seed 0 succeeded" in err
    words = ["demo", "--out", run.parent, "--json"]
    refused(capsys, *words, "--seeds", "0", "7", parts=["seed7 is not there"])


# --- Several seeds and code of one's own ---------------------------------------------------------


@pytest.mark.slow
def test_two_seeds_train_in_two_processes(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    command = ["train", "rendezvous", "masac", "--out", "out", "--seeds", "4", "7", *TINY]
    code, out, _ = call(capsys, *command, "--parallel", "process", "--json")
    assert code == 0
    runs = strict(out)["runs"]
    assert [(r["seed"], r["finished"]) for r in runs] == [(4, True), (7, True)]
    a, b = (Run.open(tmp_path / r["run"]).checkpoints.latest().arrays for r in runs)
    assert any(a[key].tobytes() != b[key].tobytes() for key in a)


def test_code_of_ones_own_reaches_the_processes(own, capsys, monkeypatch):
    from marlyap.runs import launch
    from marlyap.runs.job import Job

    class Started(BaseException):
        pass

    def say(child, line):
        raise Started(line)

    monkeypatch.setattr(launch, "WORKER", (sys.executable, "-c", ""))
    monkeypatch.setattr(launch._Child, "say", say)
    command = ["train", own, "masac", "--out", "out", "--seeds", "0", "1", *TINY]
    with pytest.raises(Started) as started:
        main([*command, "--parallel", "process", "--on-nan", "rollback"])
    job = Job.from_json(started.value.args[0])
    assert job.run == "out/seed0" and job.core is not None and job.how.tries == 3
    assert (job.how.task, job.how.algorithm) == (own, None)
