"""What a command is asked to measure: the run's own task or another; nothing is ignored."""

import json
import shutil

import pytest

from marlyap.cli import main
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.runs import config
from marlyap.runs.run import Run
from marlyap.runs.subject import subject
from marlyap.tasks import TASKS


TINY = """--task.horizon 4 --steps 16 --schedule.environments 2 --schedule.steps_per_update 4
--schedule.warmup 8 --schedule.capacity 40 --schedule.select_episodes 2
--algorithm.actor_width 4 --algorithm.critic_width 4 --algorithm.batch 4""".split()
OWN = """
import jax.numpy as jnp
from marlyap.learning.algorithms import MASAC
from marlyap.learning.constraints import Lyapunov
from marlyap.games.dynamics import SingleIntegrator
from marlyap.tasks import Rendezvous

class Vehicle(SingleIntegrator):
    limits: tuple[float, ...] = (1.0, 1.0)

class Slow(SingleIntegrator):
    limits: tuple[float, ...] = (0.1, 0.1)

class Platoon(Rendezvous):
    agents: int = 2
    dynamics: SingleIntegrator = Vehicle()

class Other(Platoon):
    pass

far = Platoon(size=3.0)

class Effort(Lyapunov):
    pass

class Rule(MASAC):
    constraint: Lyapunov = Effort()

mine = MASAC(constraint=Effort())
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a run of code of one's own and one of the package's."""
    place = tmp_path_factory.mktemp("subject")
    (place / "own.py").write_text(OWN)
    own = f"{place}/own.py"
    for task, rule, out in (
        ("rendezvous", "masac", "built-in"),
        (f"{own}:Platoon", f"{own}:mine", "own"),
    ):
        sizes = ["--task.agents", "2", "--task.dynamics", "single-integrator"]
        more = sizes if out == "built-in" else []
        assert main(["train", task, rule, "--out", str(place / out), *TINY, *more]) == 0
    return place


@pytest.fixture
def ours(place):
    return place / "built-in" / "seed0"


@pytest.fixture
def own(place):
    return place / "own" / "seed0"


def test_without_a_task_it_is_the_runs_own(ours):
    run, game = subject(ours)
    assert game is run.game


def test_a_built_in_task_that_is_named_is_the_one_measured(ours):
    changes = {"task.agents": "2", "task.dynamics": "single-integrator", "task.size": "7"}
    run, game = subject(ours, "rendezvous-late", None, changes)
    late = TASKS["rendezvous-late"]
    about = config.fields(game)
    assert (about["size"], game.horizon, game.agents) == (7.0, late.horizon, 2)
    assert run.game.horizon == 4 and run.controller(game).game is game


def test_a_policy_that_does_not_fit_the_named_task_is_refused(ours):
    run, game = subject(ours, "rendezvous", None, {"task.agents": "3"})
    with pytest.raises(UserError, match="does not fit"):
        run.controller(game)


def test_fields_alone_change_the_runs_own_task(ours):
    run, game = subject(ours, None, None, {"task.size": "7"})
    assert (config.fields(game)["size"], game.horizon) == (7.0, 4)
    assert config.fields(run.game)["size"] == config.fields(TASKS["rendezvous"])["size"]


def test_the_class_of_a_runs_own_code_supplies_it_with_the_recorded_values(own, place):
    run, game = subject(own, f"{place}/own.py:Platoon", f"{place}/own.py:mine")
    assert game is run.game and game.horizon == 4
    assert type(game.dynamics).__name__ == "Vehicle"
    assert type(run.trainer.algorithm.constraint).__name__ == "Effort"  # pyright: ignore
    run, game = subject(
        own, f"{place}/own.py:Platoon", f"{place}/own.py:mine", {"task.horizon": "5"}
    )
    assert (game.horizon, run.game.horizon) == (5, 4)


@pytest.mark.parametrize("name", ["Other", "far"])
def test_another_task_of_the_same_file_is_measured_as_it_is(own, place, name):
    run, game = subject(own, f"{place}/own.py:{name}", f"{place}/own.py:mine")
    assert game is not run.game and game.horizon != 4
    assert type(run.game).__name__ == "Platoon"


def test_own_code_is_measured_on_a_built_in_run(ours, place):
    run, game = subject(ours, f"{place}/own.py:Platoon")
    assert type(game).__name__ == "Platoon" and type(run.game).__name__ == "Rendezvous"


@pytest.mark.parametrize(
    ("task", "algorithm", "overrides", "says"),
    [
        (None, "masac", {}, "leave --algorithm out"),
        (None, None, {"algorithm.batch": "8"}, "--algorithm.batch: only a training sets it"),
        (None, None, {"schedule.steps": "8"}, "--schedule.steps: only a training sets it"),
        ("rendez", None, {}, "did you mean"),
        (None, None, {"task.siz": "8"}, "--task.siz: there is no field"),
    ],
)
def test_what_cannot_be_done_is_refused(ours, task, algorithm, overrides, says):
    with pytest.raises(UserError, match=says):
        subject(ours, task, algorithm, overrides)


def test_own_code_that_is_not_named_is_asked_for_by_the_name_it_was_trained_under(own, place):
    for task, rule, wanted in (
        (None, None, "--task {}/own.py:Platoon"),
        ("rendezvous", None, "--task {}/own.py:Platoon"),
    ):
        with pytest.raises(UserError, match=wanted.format(place)):
            subject(own, task, rule)


def test_a_run_records_its_code_and_warns_when_it_changed(own, place, tmp_path):
    about = json.loads((own / "run.json").read_text())["code"]
    assert about["task"]["file"] == f"{place}/own.py" and len(about["task"]["sha256"]) == 64
    assert about["task"]["classes"] == ["Platoon", "Vehicle"]
    assert about["algorithm"]["classes"] == ["Effort"]
    changed = tmp_path / "changed.py"
    changed.write_text(OWN + "\n# another line\n")
    run, _ = subject(own, f"{changed}:Platoon", f"{place}/own.py:mine")
    assert len(run.warnings) == 1 and "changed.py is not what" in run.warnings[0]
    assert subject(own, f"{place}/own.py:Platoon", f"{place}/own.py:mine")[0].warnings == ()


def test_a_class_that_bears_a_name_of_ours_does_not_pass_for_ours(ours, tmp_path):
    mine = tmp_path / "mine.py"
    mine.write_text("from marlyap.tasks import Rendezvous as R\nclass Rendezvous(R): pass\n")
    run, game = subject(ours, f"{mine}:Rendezvous")
    assert type(run.game).__module__ == "marlyap.tasks.rendezvous" and game is not run.game


def test_runs_from_before_the_code_was_recorded_still_open(own, place, tmp_path):
    old = shutil.copytree(own, tmp_path / "old")
    about = json.loads((old / "run.json").read_text())
    del about["code"]
    (old / "run.json").write_text(json.dumps(about))
    run, game = subject(old, f"{place}/own.py:Platoon", f"{place}/own.py:mine")
    assert game is run.game and run.warnings == ()


@pytest.mark.parametrize("code", [3, [], {"task": 3}, {"task": {"sha256": 1, "classes": []}}])
def test_a_record_of_code_of_the_wrong_kind_is_refused(own, place, tmp_path, code):
    bad = shutil.copytree(own, tmp_path / "bad")
    about = json.loads((bad / "run.json").read_text())
    (bad / "run.json").write_text(json.dumps(about | {"code": code}))
    with pytest.raises(UserError, match="'code' of the wrong kind"):
        subject(bad, f"{place}/own.py:Platoon", f"{place}/own.py:mine")


def test_titles_show_no_path(own, place):
    run, _ = subject(own, f"{place}/own.py:Platoon", f"{place}/own.py:mine")
    assert run.title == "Platoon mine seed 0"
    assert run.labels["task"] == "Platoon" and run.names["task"] == f"{place}/own.py:Platoon"


def test_train_resume_opens_own_dynamics_too(own, place, tmp_path):
    again = shutil.copytree(own, tmp_path / "again")
    task, rule = f"{place}/own.py:Platoon", f"{place}/own.py:mine"
    assert main(["train", "--resume", str(again), "--task", task, "--algorithm", rule]) == 0
    assert Run.open(own, *named(task, rule)).finished


def named(task, rule):
    return config.load(task, AbstractGame), config.load(rule, AbstractAlgorithm)
