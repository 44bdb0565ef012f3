"""The four tasks of docs/add-a-task.md as a stranger would use them, and the usual mistakes.

Every file is copied from the page, then given to the real command line.
"""

import json
import re
from pathlib import Path

import jax
import pytest

from marlyap import AbstractGame, UserError, load_policy
from marlyap.cli import main
from marlyap.conformance import conformance
from marlyap.runs import config


pytestmark = pytest.mark.usefixtures("quick_compilation")
PAGE = (Path(__file__).parents[1] / "docs" / "add-a-task.md").read_text()
FILES = {
    name: code
    for code, name in re.findall(r"^```python\n(# (\w+)\.py\n.*?)^```", PAGE, re.S | re.M)
}
TASKS = {
    "moving_formation": "MovingFormation",
    "platoon": "Platoon",
    "generators": "Generators",
    "swap": "Swap",
}
TINY = """--task.horizon 6 --steps 24 --schedule.environments 2 --schedule.warmup 0
--schedule.select_episodes 2""".split()


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with jax.numpy_rank_promotion("allow"):  # as in a user's program
        yield


def written(name, text=None):
    Path(f"{name}.py").write_text(text or FILES[name])
    return f"{name}.py:{TASKS[name]}"


def test_the_page_has_the_four_tasks_and_they_are_short():
    assert FILES.keys() == TASKS.keys()
    assert all(len(code.splitlines()) <= 100 for code in FILES.values())


@pytest.mark.parametrize("name", TASKS)
def test_a_task_of_the_page_keeps_all_laws(name):
    game = config.load(written(name), AbstractGame)
    assert {f.law: f.faults for f in conformance(game) if f.faults != ()} == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_every_verb_takes_the_task(name, capsys):
    task = written(name)
    run, of = "out/seed0", ("--task", task)

    def said(*argv):
        capsys.readouterr()
        assert main([*argv, "--json"]) == 0, capsys.readouterr().err
        return json.loads(capsys.readouterr().out)

    assert said("train", task, "apg", "--out", "out", *TINY)["runs"][0]["finished"]
    measured = said("evaluate", run, *of, "--episodes", "4")
    assert measured["runs"][0]["episodes"] == 4
    assert said("report", run, *of) and Path(run, "report.html").stat().st_size > 10_000
    assert said("watch", run, *of) and Path(run, "film.gif").read_bytes()[:3] == b"GIF"
    asked = ("--certificates", "reach", "quantiles", "--rollouts", "1000")
    assert said("certify", run, *of, *asked)
    assert main(["recheck", f"{run}/certificate"]) in (1, 2)  # it has no model of this task
    assert "recheck" in "".join(capsys.readouterr()) and Path(run, "certificate").is_dir()
    game = config.load(task, AbstractGame)
    assert load_policy(run, task).policy is not None and game.agents > 3


def without(text, *names):
    """The task without these methods."""
    for name in names:
        method = r"(    @property\n)?    def %s\(self.*?(?=\n    (?:@|def )|\Z)"
        text, n = re.subn(method % name, "", text, count=1, flags=re.S)
        assert n
    return text


NUMPY = ("import jax\n", "import jax\nimport numpy as np\n")
CHANGING = """
    def step(self, state, action):
        after = super().step(state, action)
        scenario = Orbit(state.scenario.phase + 0.1, state.scenario.place)
        return State(x=after.x, scenario=scenario, t=after.t)
"""
UNCLIPPED = """
    def step(self, state, action):
        x = state.x + self.dt * jnp.concatenate([state.x[:, 2:], 3 * action], axis=1)
        return State(x=x, scenario=state.scenario, t=state.t + 1)
"""
IF = """
        if state.x[0, 0] < 1.0:
            return jnp.asarray(True)
        return jnp.asarray(False)
"""
# The task, what is replaced in it by what (or what is put at its end), and how the answer begins.
MISTAKES = [
    ("swap", ["gap: float = 0.2", "gap = 0.2"], "Swap: gap"),
    ("swap", ["horizon: int = 60", "horizon: int = 60.0"], "horizon: 60.0"),
    ("platoon", ["    plant: AbstractPlant = Cars()\n", ""], "platoon.py:Platoon: it lacks"),
    ("platoon", ["(3.0,)", "(3.0, 1.0)"], "limits: "),
    ("swap", ["scenario=Goals(-place)", "goal=-place"], "reset: it raised TypeError"),
    ("swap", ["Goals(-place)", "-place"], "task: scenario: Swap puts no goal"),
    ("generators", [*NUMPY, "jnp.abs(state.x)", "np.abs(state.x)"], "costs: it raised Tracer"),
    (
        "platoon",
        [" jnp.any(state.x[:, 0] < 1.0)", " 0", "        return 0", IF],
        "failed: it raised",
    ),
    ("swap", ["self.local_view(state, links)", "jnp.zeros((4, 3), int)"], "observe: it is int32"),
    ("platoon", ["u[:, 0]], axis=1)", "u[:, 0]])"], "field: "),
    ("swap", ["observe(self, state, links)", "observe(self, state)"], "observe: it raised TypeErr"),
    ("moving_formation", [CHANGING], "step: the scenario changes"),
    (
        "platoon",
        [
            "beside(own, jnp.stack(seen, axis=2), jnp.asarray(self.slots), links)",
            "jnp.concatenate([own, jnp.tile(jnp.ravel(state.x), (self.agents, 1))], axis=1)",
        ],
        "observe: a row changes with agent 0",
    ),
    ("platoon", ["self.slots), links)", "self.slots), self.linked(state))"], "observe: without"),
    ("swap", [UNCLIPPED], "step: an action of 4"),
    ("generators", ["def hold", "def held"], "step: from the target set"),
    ("platoon", ["return 50.0", "return 0.1"], "failure_cost: "),
]


def spoilt(text, edit):
    for old, new in zip(edit[::2], edit[1::2], strict=False):
        assert old in text, old
        text = text.replace(old, new)
    return text + edit[-1] if len(edit) % 2 else text


@pytest.mark.parametrize(("name", "edit", "begins"), MISTAKES, ids=[m[2] for m in MISTAKES])
def test_the_page_quotes_what_is_printed_for_a_mistake(name, edit, begins):
    text = FILES[name]
    if "it lacks" in begins:
        text = without(text, "errors")
    task = written(name, spoilt(text, edit))
    try:
        found = conformance(config.load(task, AbstractGame))
    except UserError as error:
        told = [str(error)]
    else:
        told = [fault for finding in found for fault in finding.faults or ()]
    said = [sentence for sentence in told if sentence.startswith(begins)]
    assert said, told
    assert plain(said[0]) in plain(PAGE), said[0]


def plain(text):
    """On one line, without the numbers of lines of code and what JAX and Python say."""
    text = re.sub(r"(it raised \w+) \(.*?\)( at|;)", r"\1\2", " ".join(text.split()))
    return re.sub(r"\.py:\d+", ".py:N", text)
