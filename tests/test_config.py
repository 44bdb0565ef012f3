"""Objects as text and back: overrides, records, and code of the user's own."""

import json

import pytest
from conftest import put_anywhere
from hypothesis import given, settings, strategies as st

from marlyap.errors import UserError
from marlyap.games.dynamics import DYNAMICS, DoubleIntegrator, Unicycle
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.algorithms import ALGORITHMS, MASAC, PRESETS, DecentralisedSAC
from marlyap.learning.constraint import Unconstrained
from marlyap.learning.constraints import CONSTRAINTS, Lyapunov
from marlyap.learning.hosted import Hosted
from marlyap.learning.trainer import SCHEDULES, Schedule, Trainer
from marlyap.runs import config
from marlyap.runs.run import Run
from marlyap.shields import Shield, Shielded
from marlyap.tasks import TASKS, Rendezvous


GAME, RULE, ALONE = Rendezvous(), MASAC(constraint=Lyapunov()), DecentralisedSAC()


def refused(run, *parts):
    """The message of the UserError that `run` must raise; it is one sentence with these parts."""
    with pytest.raises(UserError) as caught:
        run()
    message = str(caught.value)
    assert message and "\n" not in message and message[-1] in ".?"
    for part in parts:
        assert part in message, message
    return message


# --- override ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "of, path, text, value",
    [
        (GAME, "agents", "5", 5),
        (GAME, "horizon", "1_000", 1000),
        (GAME, "radius", "2e-1", 0.2),
        (GAME, "radius", "3", 3.0),
        (GAME, "headings", "true", True),
        (GAME, "headings", "No", False),
        (GAME, "graph", "0-1,1-2", "0-1,1-2"),
        (GAME, "leaders", "1", (1,)),
        (GAME, "leaders", "(0, 2)", (0, 2)),
        (GAME, "leaders", "[0,2]", (0, 2)),
        (GAME, "dynamics", "double-integrator", DoubleIntegrator()),
        (GAME, "dynamics.limits", "2,3.5", (2.0, 3.5)),
        (GAME, "dynamics.integrator", "rk4", "rk4"),
        (RULE, "heads", "team", "team"),
        (RULE, "gamma", "0.9", 0.9),
        (RULE, "constraint", "none", Unconstrained()),
        (RULE, "constraint.reading", "hinge", "hinge"),
        (ALONE, "sac", "masac-nstep", MASAC(n_step=5)),
        (ALONE, "sac.constraint", "none", Unconstrained()),
        (RULE, "constraint.weight", "0.5", 0.5),
        (RULE, "constraint.weight", "none", None),
        (RULE, "constraint.slope", "empirical", "empirical"),
        (RULE, "constraint.slope", "1.5", 1.5),
        (Schedule(), "decay_episodes", "200", 200),
        (Schedule(), "decay_episodes", "None", None),
        (Schedule(), "steps", "1", 1),
    ],
)
def test_every_kind_of_field_is_set_from_text(of, path, text, value):
    new = config.override(of, path, text)
    *outer, last = path.split(".")
    holder, old = new, of
    for name in outer:
        holder, old = getattr(holder, name), getattr(old, name)
    assert getattr(holder, last) == value
    assert type(getattr(holder, last)) is type(value)
    assert config.fields(holder) | {last: None} == config.fields(old) | {last: None}


def test_an_override_leaves_the_original_alone():
    config.override(GAME, "dynamics.limits", "1,1")
    assert GAME == Rendezvous()


@pytest.mark.parametrize(
    "of, path, text, parts",
    [
        (GAME, "agent", "3", ["agent:", "did you mean 'agents'?"]),
        (GAME, "dynamics.limit", "3", ["dynamics.limit:", "did you mean 'limits'?"]),
        (GAME, "zzz", "3", ["zzz", "there is agents", "horizon"]),
        (GAME, "agents.deeper", "3", ["agents.deeper"]),
        (GAME, "", "3", []),
        (GAME, "__class__", "3", ["__class__"]),
        (GAME, "agents", "three", ["agents: 'three' is not a whole number"]),
        (GAME, "agents", "3.0", ["a whole number"]),
        (GAME, "agents", "", ["a whole number"]),
        (GAME, "radius", "wide", ["radius: 'wide' is not a number"]),
        (GAME, "radius", "nan", ["a number"]),
        (GAME, "radius", "-inf", ["a number"]),
        (GAME, "radius", "1e999", ["a number"]),
        (GAME, "headings", "2", ["true or false"]),
        (GAME, "leaders", "0;1", ["leaders", "with commas between"]),
        (GAME, "dynamics", "bicycle", ["dynamics: 'bicycle'", "unicycle"]),
        (GAME, "dynamics.integrator", "heun", ["dynamics.integrator: 'heun'", "euler or rk4"]),
        (RULE, "heads", "both", ["heads: 'both' is not team or agent"]),
        (RULE, "constraint.weight", "much", ["none or a number"]),
        (RULE, "constraint.slope", "steep", ["empirical or spectral"]),
        (GAME, "agents", "0", ["agents: 0 is out of range"]),
        (GAME, "agents", "-1", ["agents: -1 is out of range"]),
        (GAME, "leaders", "3", ["leaders: (3,)", "from 0 to 2"]),
        (GAME, "leaders", "0,0", ["leaders:", "twice"]),
        (GAME, "leaders", "", ["leaders:", "at least one"]),
        (GAME, "graph", "0-1", ["graph: '0-1' is not connected", "agent 2"]),
        (GAME, "graph", "pth", ["graph: 'pth'", "path"]),
        (GAME, "graph", "disk:-1", ["graph:", "positive radius"]),
        (GAME, "graph", "0-3,0-1,0-2", ["graph: edge 0-3"]),
        (GAME, "dt", "0", ["dt: 0.0 s is out of range"]),
        (GAME, "dynamics.limits", "1", ["dynamics.limits: (1.0,)", "2 positive numbers"]),
        (GAME, "dynamics.limits", "1,-1", ["dynamics.limits:"]),
        (RULE, "constraint.reading", "score", ["constraint.reading: 'score'"]),
        (RULE, "constraint.horizon", "0", ["constraint.horizon: 0"]),
        (RULE, "constraint.weight", "-1", ["constraint.weight: -1"]),
        (Schedule(), "steps", "0", ["steps: 0 is out of range"]),
        (Schedule(), "warmup", "-1", ["warmup: -1 is out of range"]),
        (Schedule(), "decay", "0", ["decay: 0.0"]),
    ],
)
def test_what_cannot_be_set_is_said_in_one_sentence(of, path, text, parts):
    refused(lambda: config.override(of, path, text), *parts)


@pytest.mark.parametrize(
    "of, path, text",
    [
        (RULE, "gamma", "1.5"),
        (RULE, "gamma", "-0.1"),
        (RULE, "tau", "2"),
        (RULE, "rate_Q", "-1"),
        (RULE, "batch", "0"),
        (RULE, "n_step", "0"),
        (RULE, "alpha", "0"),
        (RULE, "actor_width", "0"),
        (RULE, "critic_width", "-8"),
        (RULE, "ema_rate", "0"),
        (RULE, "constraint.weight_start", "0"),
        (RULE, "constraint.floor", "0"),
        (RULE, "constraint.discount", "2"),
        (RULE, "constraint.clip", "-1"),
        (Schedule(), "decay_episodes", "0"),
        (Schedule(), "decay_episodes", "-5"),
    ],
)
def test_hyperparameters_out_of_range_are_refused(of, path, text):
    refused(lambda: config.override(of, path, text), path.split(".")[-1])


@settings(deadline=None)
@given(st.sampled_from(["agents", "radius", "leaders", "dynamics.limits", "headings"]), st.text())
def test_override_raises_nothing_but_user_errors(path, text):
    try:
        config.override(GAME, path, text)
    except UserError:
        pass


# --- record and build ----------------------------------------------------------------------------


MEMBERS = {
    "task": TASKS,
    "algorithm": ALGORITHMS,
    "schedule": SCHEDULES,
    "constraint": CONSTRAINTS,
    "dynamics": DYNAMICS,
    "preset": {f"paper-{name}": PRESETS["paper"](rule) for name, rule in ALGORITHMS.items()},
}


@pytest.mark.parametrize(
    "part, thing",
    [pytest.param(p, x, id=f"{p}-{n}") for p, family in MEMBERS.items() for n, x in family.items()],
)
def test_every_member_survives_the_trip_through_json(part, thing):
    text = json.dumps(config.record(thing), allow_nan=False)
    back = config.build(json.loads(text), config.known(), part)
    assert type(back) is type(thing)
    assert back == thing
    assert config.record(back) == json.loads(text)


POSITIVE = st.floats(1e-9, 10)


@settings(deadline=None)
@given(
    st.fixed_dictionaries(
        {
            "agents": st.integers(3, 30),
            "leaders": st.lists(st.integers(0, 2), min_size=1, unique=True).map(tuple),
            "radius": POSITIVE,
            "dt": POSITIVE,
            "headings": st.booleans(),
        }
    ),
    st.tuples(POSITIVE, POSITIVE),
)
def test_every_number_survives_to_the_last_bit(values, limits):
    game = Rendezvous(**values, dynamics=Unicycle(limits=limits))
    data = json.loads(json.dumps(config.record(game)))
    assert config.build(data, config.known(), "task") == game


def edited(thing, **changes):
    return config.record(thing) | changes


@pytest.mark.parametrize(
    "data, parts",
    [
        (None, ["task:", "kind"]),
        ([], ["task:", "kind"]),
        ({}, ["task:", "kind"]),
        ({"kind": 3}, ["task:", "kind"]),
        ({"kind": "Mine"}, ["'Mine' is not part of marlyap", "--task path/to/file.py:Mine"]),
        ({"kind": "os.system"}, ["'os.system' is not part of marlyap"]),
        (edited(GAME, agnets=3), ["task.agnets", "did you mean 'agents'?"]),
        (edited(GAME, agents="3"), ["task.agents: '3' is not a whole number"]),
        (edited(GAME, agents=3.0), ["task.agents: 3.0"]),
        (edited(GAME, agents=True), ["task.agents: True"]),
        (edited(GAME, agents=None), ["task.agents: None"]),
        (edited(GAME, agents=[3]), ["task.agents"]),
        (edited(GAME, agents=0), ["task.agents: 0 is out of range"]),
        (edited(GAME, headings=1), ["task.headings: 1 is not true or false"]),
        (edited(GAME, radius="0.1"), ["task.radius"]),
        (edited(GAME, radius=float("nan")), ["task.radius"]),
        (edited(GAME, leaders=0), ["task.leaders"]),
        (edited(GAME, leaders=["0"]), ["task.leaders: '0'"]),
        (edited(GAME, leaders=[[0]]), ["task.leaders"]),
        (edited(GAME, graph=["path"]), ["task.graph"]),
        (edited(GAME, dynamics="unicycle"), ["task.dynamics"]),
        (edited(GAME, dynamics={"kind": "Bicycle"}), ["task.dynamics: 'Bicycle'"]),
        (edited(GAME, dynamics=edited(Unicycle(), limit=3)), ["task.dynamics.limit", "'limits'"]),
        (edited(GAME, dynamics=edited(Unicycle(), limits=["5"])), ["task.dynamics.limits: '5'"]),
        (edited(GAME, dynamics=edited(Unicycle(), integrator="x")), ["task.dynamics.integrator"]),
    ],
)
def test_damaged_records_are_refused_by_the_dotted_name(data, parts):
    refused(lambda: config.build(data, config.known(), "task"), *parts)


@pytest.mark.parametrize(
    "part, data, start",
    [
        ("task", edited(GAME, dynamics=edited(Unicycle(), limits=[5.0])), "task.dynamics.limits:"),
        (
            "algorithm",
            edited(RULE, constraint=edited(Lyapunov(), horizon=0)),
            "algorithm.constraint.horizon:",
        ),
    ],
)
def test_a_nested_check_names_the_field_once(part, data, start):
    message = refused(lambda: config.build(data, config.known(), part))
    assert message.startswith(start)


@pytest.mark.parametrize(
    "part, data, field",
    [
        ("task", edited(GAME, dynamics=config.record(Schedule())), "task.dynamics"),
        ("task", edited(GAME, dynamics=config.record(GAME)), "task.dynamics"),
        ("task", edited(GAME, agents=config.record(Unicycle())), "task.agents"),
        ("algorithm", edited(RULE, constraint=config.record(Unicycle())), "algorithm.constraint"),
    ],
)
def test_an_object_in_the_wrong_place_is_refused(part, data, field):
    refused(lambda: config.build(data, config.known(), part), f"{field}:")


def test_an_enormous_integer_is_refused():
    data = edited(GAME, radius=10**400)
    refused(lambda: config.build(data, config.known(), "task"), "task.radius")


NAMES = sorted({n for cls in config.known().values() for n in config._hints(cls)} | {"kind", "x"})
KINDS = sorted(config.known()) + ["Mine", ""]
LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats()
    | st.sampled_from([*KINDS, "path", "0-1", "disk:1", "rk4", "han", "norm", "spectral"])
    | st.text(max_size=8)
)
VALUES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(NAMES), inner, max_size=4)
        | st.builds(
            lambda kind, d: {**d, "kind": kind},
            st.sampled_from(KINDS),
            st.dictionaries(st.sampled_from(NAMES), inner, max_size=4),
        )
    ),
    max_leaves=8,
)


@settings(max_examples=200, deadline=None)
@given(VALUES)
def test_build_raises_nothing_but_user_errors(data):
    try:
        built = config.build(data, config.known(), "task")
    except UserError as error:
        assert "\n" not in str(error)
    else:
        assert config.record(built).keys() >= data.keys()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    schedule = Schedule(steps=80, environments=1, steps_per_update=1, warmup=40, capacity=10)
    place = tmp_path_factory.mktemp("run") / "run"
    return Run.create(place, Trainer(GAME, RULE, schedule), 0, {"task": "rendezvous"})


@settings(max_examples=60, deadline=None, database=None)  # each may compile a training
@given(data=st.data(), value=VALUES)
def test_a_run_that_others_edited_opens_or_is_refused(run, data, value):
    """Any value anywhere in run.json; then the log, with any line in it."""
    path = run.directory / "run.json"
    sound = path.read_text()
    about = json.loads(sound)
    put_anywhere(data, value, about)
    log = run.directory / "log.jsonl"
    log.write_text('{"iteration": 1}\n' + data.draw(st.text(max_size=20)))
    try:
        path.write_text(json.dumps(about))
        opened = Run.open(run.directory)
        assert isinstance(opened.trainer.game, AbstractGame) and opened.steps_done >= 0
        opened.history()
        opened.load()
    except UserError as error:
        assert str(error)
    finally:
        path.write_text(sound)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(sorted(config.known())), st.data())
def test_records_with_one_field_replaced_are_refused_or_round_trip(kind, draw):
    members = [o for fam in config.FAMILIES.values() for o in fam.values()]
    members += [
        Hosted("pettingzoo:mpe2.simple_spread_v3"),
        Schedule(),
        Shield(),
        Shielded(TASKS["rendezvous"]),
        *(game.plant for game in TASKS.values()),
    ]
    thing = next(o for o in members if type(o).__name__ == kind)
    name = draw.draw(st.sampled_from(sorted(config.fields(thing)) or ["x"]))
    data = edited(thing, **{name: draw.draw(LEAVES | st.lists(LEAVES, max_size=3))})
    try:
        built = config.build(data, config.known(), "part")
    except UserError as error:
        assert str(error).startswith("part"), error
    else:
        back = config.build(config.record(built), config.known(), "part")
        assert repr(config.record(back)) == repr(config.record(built))


def test_describe_names_every_field_that_can_be_set():
    for prefix, family in (("task", TASKS), ("algorithm", ALGORITHMS)):
        for thing in family.values():
            for option, value, note in config.describe(thing, prefix):
                path = option.removeprefix(f"{prefix}.")
                assert config.override(thing, path, value) == thing or "." not in path
                assert isinstance(note, str)
            options = {row[0].split(".")[1] for row in config.describe(thing, prefix)}
            assert set(config.fields(thing)) == options


# --- load ----------------------------------------------------------------------------------------


OWN = '''
import jax.numpy as jnp
from marlyap.learning.algorithms import MASAC
from marlyap.tasks import Rendezvous

class Meeting(Rendezvous):
    """Agents meet."""
    wish: float = 0.5  # how much

class Slow(MASAC):
    rate_Q: float = 1e-5

ready = Meeting(agents=2)
number = 3
class Needy(Rendezvous):
    agents: int = 0
'''


@pytest.fixture
def own(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(OWN)
    return path


def test_names_give_the_members():
    for name, game in TASKS.items():
        assert config.load(name, AbstractGame) is game
    for name, rule in ALGORITHMS.items():
        assert config.load(name, AbstractAlgorithm) is rule


@pytest.mark.parametrize(
    "name, family, parts",
    [
        ("rendevous", AbstractGame, ["task: no task is called 'rendevous'", "'rendezvous'?"]),
        ("masca", AbstractAlgorithm, ["algorithm:", "did you mean 'masac'?"]),
        ("qqqq", AbstractGame, ["there is cartpoles, consensus"]),
        ("", AbstractGame, ["task:"]),
        ("masac", AbstractGame, ["task: no task is called 'masac'"]),
        ("nowhere.py:Name", AbstractGame, ["task: there is no file nowhere.py"]),
        (":Name", AbstractGame, ["task:"]),
        ("/:Name", AbstractGame, ["task:"]),
        ("nowhere.py:", AbstractAlgorithm, ["algorithm: there is no file"]),
    ],
)
def test_unknown_names_are_refused_with_a_suggestion(name, family, parts):
    refused(lambda: config.load(name, family), *parts)


def test_a_task_and_an_algorithm_of_the_users_own(own):
    game = config.load(f"{own}:Meeting", AbstractGame)
    assert (type(game).__name__, game.wish, game.agents) == ("Meeting", 0.5, 3)
    assert config.load(f"{own}:ready", AbstractGame).agents == 2
    assert config.load(f"{own}:Slow", AbstractAlgorithm).rate_Q == 1e-5
    assert config.override(game, "wish", "2").wish == 2.0


def test_records_of_own_code_need_its_class(own):
    game = config.override(config.load(f"{own}:Meeting", AbstractGame), "wish", "0.25")
    data = json.loads(json.dumps(config.record(game)))
    refused(lambda: config.build(data, config.known(), "task"), "--task path/to/file.py:Meeting")
    back = config.build(data, config.known() | {"Meeting": type(game)}, "task")
    assert back == game


@pytest.mark.parametrize(
    "name, family, parts",
    [
        ("Meting", AbstractGame, ["task:", "called 'Meting'"]),
        ("number", AbstractGame, ["defines no task called 'number'"]),
        ("Slow", AbstractGame, ["defines no task called 'Slow'"]),
        ("Meeting", AbstractAlgorithm, ["defines no algorithm called 'Meeting'"]),
        ("Needy", AbstractGame, ["agents: 0 is out of range"]),
        ("__name__", AbstractGame, ["defines no task"]),
    ],
)
def test_what_a_file_does_not_define_is_said(own, name, family, parts):
    refused(lambda: config.load(f"{own}:{name}", family), *parts)


@pytest.mark.parametrize(
    "text",
    [
        "def broken(:",
        "raise RuntimeError('no')",
        "import no_such_module_at_all",
        "1 / 0",
        "\x00",
        "x = 'unterminated",
    ],
)
def test_files_that_cannot_be_loaded_are_named(tmp_path, text):
    path = tmp_path / "bad.py"
    path.write_text(text)
    refused(lambda: config.load(f"{path}:Name", AbstractGame), "task:", "bad.py")


def test_a_file_that_is_not_python_or_not_text_is_named(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    refused(lambda: config.load(f"{tmp_path}/notes.txt:Name", AbstractGame), "not a Python file")
    (tmp_path / "binary.py").write_bytes(bytes(range(128, 256)))
    refused(lambda: config.load(f"{tmp_path}/binary.py:Name", AbstractGame), "binary.py")
    (tmp_path / "folder.py").mkdir()
    refused(lambda: config.load(f"{tmp_path}/folder.py:Name", AbstractGame), "no file")


def write(tmp_path, text):
    path = tmp_path / "mine.py"
    path.write_text(text)
    return f"{path}:Mine"


def test_a_class_that_cannot_be_made_without_arguments(tmp_path):
    name = write(
        tmp_path,
        "from marlyap.games.game import AbstractGame\nclass Mine(AbstractGame):\n    agents: int\n",
    )
    refused(lambda: config.load(name, AbstractGame), "Mine")


def test_an_error_in_the_users_constructor_is_named(tmp_path):
    text = "from marlyap.tasks import Rendezvous\nclass Mine(Rendezvous):\n"
    text += "    def __check_init__(self):\n        raise ValueError('too wide')\n"
    refused(lambda: config.load(write(tmp_path, text), AbstractGame), "Mine", "too wide")


def test_a_file_that_exits_is_named(tmp_path):
    name = write(tmp_path, "raise SystemExit(3)\n")
    refused(lambda: config.load(name, AbstractGame), "mine.py")


def test_annotations_may_be_strings(tmp_path):
    text = "from __future__ import annotations\nfrom marlyap.tasks import Rendezvous\n"
    text += "class Mine(Rendezvous):\n    wish: float = 0.5\n"
    game = config.load(write(tmp_path, text), AbstractGame)
    assert config.override(game, "wish", "2").wish == 2.0


def test_the_fields_of_own_code_can_be_described(own):
    rows = config.describe(config.load(f"{own}:Meeting", AbstractGame), "task")
    assert ("task.wish", "0.5", "how much") in rows
