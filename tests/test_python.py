"""marlyap in Python: names, paths as text, sentences for wrong types, and what training leaves."""

import json
import subprocess
import sys

import jax
import pytest

import marlyap
from marlyap import MASAC, Rendezvous, Run, Schedule, UserError, evaluate, train
from marlyap.cli import main
from marlyap.compute import cache


SCHEDULE = Schedule(
    steps=16, environments=2, steps_per_update=4, warmup=8, capacity=40, select_episodes=2
)
TINY = MASAC(actor_width=4, critic_width=4, batch=4)


@pytest.fixture(scope="module")
def trained():
    return train(Rendezvous(horizon=4), TINY, SCHEDULE, seed=3)


def test_names_are_shown_and_no_others():
    assert dir(marlyap) == sorted([*marlyap.__all__, "__version__"])
    for name in dir(marlyap):
        assert getattr(marlyap, name) is not None
    assert marlyap.__version__.count(".") == 2
    with pytest.raises(AttributeError, match="no attribute 'Rendezvouz'"):
        _ = marlyap.Rendezvouz  # pyright: ignore


def test_a_function_is_not_hidden_by_the_module_of_its_name():
    script = "import marlyap.simulation.rollout, marlyap.certificates.certify, marlyap; "
    script += "from marlyap.simulation.rollout import until; from marlyap import certify, rollout; "
    script += "print(callable(certify), callable(rollout), callable(marlyap.rollout))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "True True True\n", done.stderr


WRONG = {
    "Schedule(steps=1e5)": "steps: 100000.0 is not a whole number (int); write 100000.",
    "Rendezvous(agents=3.0)": "agents: 3.0 is not a whole number (int); write 3.",
    "Rendezvous(agents=True)": "agents: True is not a whole number (int); use one.",
    "Rendezvous(leaders=0)": "leaders: 0 is not a tuple of whole numbers; write (0,).",
    "Rendezvous(leaders=(0.0,))": "leaders: (0.0,) is not a tuple of whole numbers; "
    "write one such as (0, 1).",
    "train('rendezvouz', 'masac')": "task: no task is called 'rendezvouz'; did you mean "
    "'rendezvous'?",
    "Run.open('nowhere')": "run: nowhere is not a run (it has no run.json).",
}


def test_a_wrong_type_is_one_sentence():
    """In a process of its own: here jaxtyping checks every call, as a user's program does not."""
    script = "from marlyap import *\nfor text in " + repr([*WRONG]) + ":\n"
    script += "    try: eval(text)\n    except UserError as error: print(error)\n"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.splitlines() == [*WRONG.values()], done.stderr


def test_a_game_shows_its_fields():
    shown = repr(Rendezvous())
    assert shown.startswith("Rendezvous(agents=3, ") and "horizon=" in shown


def test_what_was_trained_is_saved_as_a_run(trained, tmp_path, capsys):
    saved = trained.save(str(tmp_path / "run"))
    run = Run.open(str(tmp_path / "run"))
    assert run.finished and run.seed == 3 and run.history() == trained.history
    assert run.names == {"task": "Rendezvous", "algorithm": "MASAC", "preset": "tuned"}
    assert saved.trainer == run.trainer
    same = lambda c: evaluate(run.game, c, episodes=16).final.tolist()
    assert same(run.controller()) == same(trained.controller)
    assert main(["evaluate", str(tmp_path / "run"), "--episodes", "4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 4
    with pytest.raises(UserError, match="already exists"):
        trained.save(tmp_path / "run")


def test_training_takes_names(monkeypatch):
    import importlib

    fit = importlib.import_module("marlyap.runs.fit")
    seen = []

    class Enough(Exception):
        pass

    def begin(trainer, seed):
        seen.append(trainer)
        raise Enough

    monkeypatch.setattr(fit, "begin", begin)
    with pytest.raises(Enough):
        train("rendezvous", "masac-lyapunov")
    assert seen[0].game == marlyap.Rendezvous() and seen[0].algorithm.constraint.horizon == 10


def test_training_is_silent_where_there_is_no_terminal(trained, capfd):
    train(Rendezvous(horizon=4), TINY, SCHEDULE, seed=3)
    assert capfd.readouterr() == ("", "")


def test_the_users_own_cache_stays(monkeypatch, tmp_path):
    before = jax.config.jax_compilation_cache_dir  # pyright: ignore
    monkeypatch.delenv("MARLYAP_PROGRAMS", raising=False)
    assert before and cache.enable_cache(programs=True) is None
    assert jax.config.jax_compilation_cache_dir == before  # pyright: ignore


def test_a_second_start_finds_what_the_first_compiled(tmp_path):
    """In Python as on the command line: programs are kept, without a word being set."""
    script = "import marlyap, jax; from marlyap.compute.cache import enable_cache; "
    script += "print(enable_cache(True), jax.config.jax_compilation_cache_dir)"
    env = {"XDG_CACHE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=env)
    assert done.stdout == f"None {tmp_path}/marlyap/jax\n", done.stderr


@pytest.mark.parametrize("argv", [["list"], ["train", "rendezvous", "masac", "--seeds", "x"]])
def test_a_cache_that_cannot_be_written_is_one_line(argv, tmp_path):
    (tmp_path / "file").write_text("")
    env = {"XDG_CACHE_HOME": str(tmp_path / "file"), "PATH": "/usr/bin:/bin"}
    command = [sys.executable, "-m", "marlyap", *argv]
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    lines = [line for line in done.stderr.splitlines() if "cache" in line or "Warning" in line]
    assert lines == [line for line in lines if line.startswith("marlyap: cache: ")]
    assert len(lines) == 1
