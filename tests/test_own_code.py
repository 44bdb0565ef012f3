"""A task of one's own that is broken: one sentence with file and line, and no directory left."""

import json
import os
import shutil
import subprocess
import sys

import pytest

from marlyap.cli import main
from marlyap.errors import UserError, explained
from marlyap.runs.run import Run
from marlyap.storage import store


TINY = """--task.horizon 4 --steps 16 --schedule.environments 2 --schedule.steps_per_update 4
--schedule.warmup 8 --schedule.capacity 40 --schedule.select_episodes 2
--algorithm.actor_width 4 --algorithm.critic_width 4 --algorithm.batch 4""".split()
HEAD = """import jax.numpy as jnp
import numpy as np
from marlyap.tasks import Rendezvous
class T(Rendezvous):
"""
BROKEN = {
    "costs(self, state, action): raise ValueError('my bug')": ["costs: it raised", "my bug"],
    "step(self, state, action): raise ValueError('my bug')": ["step: it raised", "my bug"],
    "reset(self, key): raise ValueError('my bug')": ["reset: it raised", "my bug"],
    "reset(self, key): return {'x': 1}": ["reset: it returns a dict"],
    "costs(self, state, action): return jnp.mean(self.distance(state))": ["float32[]"],
    "costs(self, state, action): return self.distance(state)[:, None]": ["float32[3, 1]"],
    "costs(self, state, action): return None": ["costs: it is a NoneType"],
    "costs(self, state, action): return np.sqrt(np.asarray(self.distance(state)))": [
        "jnp (jax.numpy)"
    ],
    "costs(self, state, action): return state.x[:, 0] if state.t > 1 else 0": ["jnp.where"],
    "observe(self, state, links): return jnp.zeros(3)": ["observe: it is float32[3]"],
    "observe(self, state, links): return jnp.zeros((3, 2), int)": ["observe: it is int32[3, 2]"],
    "terminated(self, state): return True": ["terminated: it is a bool"],
    "costs(self, state, action): return self.local_view(state)": ["missing", "required"],
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def sentence(capsys, *argv):
    capsys.readouterr()
    assert main(list(map(str, argv))) == 2
    err = capsys.readouterr().err.strip()
    assert err.splitlines()[-1].startswith("marlyap: ") and "Traceback" not in err
    return err


@pytest.mark.parametrize(("method", "parts"), BROKEN.items(), ids=range(len(BROKEN)))
def test_a_broken_task_is_refused_before_a_run_is_made(method, parts, tmp_path, capsys):
    (tmp_path / "t.py").write_text(f"{HEAD}    def {method}\n")
    said = sentence(capsys, "train", "t.py:T", "masac", "--out", "out", *TINY)
    assert said.startswith("marlyap: task: ") and "t.py:5" in said
    assert all(part in said for part in parts), said
    assert not (tmp_path / "out").exists()


def test_negative_costs_stop_the_training_and_leave_no_directory(tmp_path, capsys):
    cost = "costs(self, state, action): return self.distance(state) - 1.0"
    (tmp_path / "t.py").write_text(f"{HEAD}    def {cost}\n")
    said = sentence(capsys, "train", "t.py:T", "masac", "--out", "out", *TINY)
    assert "cost: the task returned a negative number in the warm-up" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("x = 1\ny = undefined", "t.py:2: NameError (name 'undefined' is not defined)"),
        ("x = 1\ny = (", "t.py:2: SyntaxError"),
        ("import nothing_of_that_name", "t.py:1: ModuleNotFoundError"),
        (
            "from marlyap.tasks import Rendezvous as R\nclass T(R):\n  size = 3.0",
            "size: float = 3.0",
        ),
        ("from marlyap.tasks import Rendezvous as R\nclass Tea(R): pass", "did you mean 'Tea'?"),
    ],
)
def test_a_file_that_cannot_be_used_is_said_with_its_line(text, part, tmp_path, capsys):
    (tmp_path / "t.py").write_text(text)
    assert part in sentence(capsys, "train", "t.py:T", "masac")


def test_a_file_without_a_name_is_told_the_names_in_it(tmp_path, capsys):
    (tmp_path / "t.py").write_text("raise SystemExit\nclass A: pass\nclass B(A): pass\n")
    assert "as in t.py:A or t.py:B." in sentence(capsys, "check-task", "t.py")


def test_only_errors_of_the_users_code_lose_their_traceback(tmp_path):
    (tmp_path / "t.py").write_text("def f():\n    raise KeyError('x')\n")
    namespace = {}
    exec(compile((tmp_path / "t.py").read_text(), str(tmp_path / "t.py"), "exec"), namespace)
    caught = None
    try:
        namespace["f"]()
    except KeyError as error:
        caught = error
    assert caught and explained(caught) == "t.py:2: KeyError ('x')."
    try:
        json.loads("{")
    except ValueError as error:
        caught = error.with_traceback(error.__traceback__ and error.__traceback__.tb_next)
    assert explained(caught) is None


def test_memory_that_is_not_there_is_one_sentence():
    error = RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 64 bytes.")
    said = explained(error)
    assert said and said.startswith("memory: there is not enough (Out of memory allocating 64")


# --- Where runs may be made ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("own-code")
    assert main(["train", "rendezvous", "masac", "--out", str(out), *TINY]) == 0
    return out / "seed0"


@pytest.fixture
def run(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "run")


def test_no_run_is_made_inside_a_run(run, capsys):
    (run / "report.html").write_text("kept")
    for argv in (["train", "rendezvous", "masac"], ["demo"]):
        said = sentence(capsys, *argv, "--out", run)
        assert "is inside the run" in said
    assert (run / "report.html").read_text() == "kept" and not (run / "seed0").exists()
    assert "the path is empty" in sentence(capsys, "train", "rendezvous", "masac", "--out", "")


def test_a_finished_run_without_a_sound_checkpoint_is_not_done(run, capsys):
    for arrays in run.glob("checkpoints/*/arrays.safetensors"):
        arrays.write_bytes(arrays.read_bytes()[:100])
    assert "no checkpoint to load" in sentence(capsys, "train", "--resume", run)


def test_the_log_names_faults_only_where_there_are_any(run):
    assert not [key for line in Run.open(run).history() for key in line if key.startswith("bad_")]


# --- A disk that is full -------------------------------------------------------------------------


def test_a_full_disk_leaves_the_old_picture(tmp_path):
    picture = tmp_path / "film.gif"
    store.write_bytes_atomic(picture, lambda file: file.write(b"old"))

    def fails(file):
        file.write(b"half")
        raise OSError(28, os.strerror(28))

    with pytest.raises(UserError, match="No space left on device.*free some disk space"):
        store.write_bytes_atomic(picture, fails)
    assert picture.read_bytes() == b"old" and os.listdir(tmp_path) == ["film.gif"]
    store.write_bytes_atomic(picture, lambda file: file.write(b"new"))
    assert picture.read_bytes() == b"new"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("argv", [["list", "--json"], ["list"], ["--version"]])
def test_output_that_cannot_be_written_is_one_sentence(argv):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "marlyap", *argv]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "standard output could not be written" in done.stderr


# --- Options -------------------------------------------------------------------------------------


TRAIN = ["train", "rendezvous", "masac"]


@pytest.mark.parametrize(
    ("argv", "part"),
    [
        ([*TRAIN, "--sed", "0"], "there is no option --sed; did you mean --seeds?"),
        ([*TRAIN, "--seeds", "1.5"], "seeds: '1.5' is not a whole number"),
        ([*TRAIN, "--seeds", "0,1", "--seeds", "3"], "--seeds: it is given twice"),
        ([*TRAIN, "--steps", "1.5"], "'1.5' is not a whole number"),
        (["check-task", "rendezvous", "--seed", "-1"], "seed: -1 is out of range"),
        ([*TRAIN, "--algorithm.constraint.reading", "hinge"], "constraint is none"),
        (
            [*TRAIN, "--algorithm.constraint.agents", "7", "--algorithm.constraint", "lyapunov"],
            "--algorithm.constraint.agents: 7 is out of range",
        ),
        (["list", "rech"], "did you mean 'reach'?"),
    ],
)
def test_what_is_wrong_with_an_option(argv, part, capsys):
    assert part in sentence(capsys, *argv)


@pytest.mark.parametrize("flip", [False, True])
def test_the_order_of_overrides_does_not_matter(flip):
    from marlyap.cli.parser import parse
    from marlyap.runs.asked import Asked, assemble

    words = ["--task.leaders", "4"], ["--task.agents", "5"]
    more = ["--algorithm.constraint.reading", "hinge"], ["--algorithm.constraint", "lyapunov"]
    pairs = [*words, *more, ["--steps", "1e3"]]
    argv = sum(reversed(pairs) if flip else pairs, [])
    args, overrides = parse([*TRAIN, *argv])
    trainer = assemble(Asked(args.task, args.algorithm, args.preset, args.steps), overrides)
    assert (trainer.game.agents, trainer.game.leaders) == (5, (4,))
    assert trainer.schedule.steps == 1000
    assert trainer.algorithm.constraint.reading == "hinge"  # pyright: ignore


# --- Lists ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["tree-pursuit", "reach", "tuned", "paper", "schedule", "apg"])
def test_everything_has_its_fields_listed(name, capsys):
    assert main(["list", name, "--json"]) == 0
    assert all(
        set(row) == {"value", "meaning"} for row in json.loads(capsys.readouterr().out).values()
    )


@pytest.mark.parametrize(
    "name", ["masac-lyapunov", "maddpg", "rendezvous", "formation", "schedule"]
)
def test_every_field_has_a_meaning(name, capsys):
    assert main(["list", name, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    options = {name: row for name, row in rows.items() if name.startswith("--")}
    assert options and [name for name, row in options.items() if not row["meaning"]] == []


def test_brackets_in_a_meaning_are_shown_and_choices_too(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    assert main(["list", "masac-lyapunov"]) == 0
    out = capsys.readouterr().out
    assert "[floor, 1]" in out and "one of han, literal, hinge, score, critic" in out


def test_a_subclass_of_ones_own_keeps_the_meanings(tmp_path, capsys):
    (tmp_path / "t.py").write_text(f"{HEAD}    gain: float = 1.0  # of mine\n")
    assert main(["list", "t.py:T", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert rows["--task.gain"]["meaning"] == "of mine" and rows["--task.size"]["meaning"]


def test_check_task_ends_with_a_summary(tmp_path, capsys):
    (tmp_path / "t.py").write_text(f"{HEAD}    def costs(self, state, action): return 3\n")
    assert main(["check-task", "t.py:T"]) == 1
    out = capsys.readouterr().out
    assert out.count("skipped") == 2 and "laws need sound shapes" in out
    assert out.strip().splitlines()[-1].endswith("; broken: shapes.")


def test_train_ignores_no_task(run, capsys):
    said = sentence(capsys, *TRAIN, "--task", "formation", "--out", "out")
    assert "--task: it is for --resume" in said
    said = sentence(capsys, "train", "--resume", run, "--task", "formation")
    assert "was trained with rendezvous" in said
    said = sentence(capsys, "train", "--resume", run, "--algorithm", "maddpg")
    assert "was trained with masac" in said
    assert main(["train", "rendezvous", "masac", "--resume", str(run)]) == 0


def test_help_has_examples_that_can_be_parsed():
    """Every example is a command that the parser takes and whose names are there."""
    import shlex

    from marlyap.cli.parser import VERBS, parse
    from marlyap.controllers import CONTROLLERS
    from marlyap.learning.algorithms import ALGORITHMS
    from marlyap.tasks import TASKS

    known = {*TASKS, *ALGORITHMS, *CONTROLLERS}
    for verb, file in VERBS.items():
        assert file.EXAMPLES.strip()
        for line in file.EXAMPLES.strip().splitlines():
            words = shlex.split(line)
            args, _ = parse(words[1:])
            assert words[0] == "marlyap" and args.verb == verb
            asked = [getattr(args, "task", None), getattr(args, "algorithm", None)]
            asked += [r for r in getattr(args, "runs", ()) if "/" not in str(r)]
            assert all(name is None or name in known or ":" in name for name in asked), line
