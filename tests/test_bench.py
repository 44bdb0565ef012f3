"""The games of the bench: measured references, instability without control, every command.

A new game is one line in MEASURED for each figure that is known of it.
"""

import json
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.cli import main
from marlyap.controllers import CONTROLLERS, AbstractController
from marlyap.errors import UserError
from marlyap.games.game import AbstractRegulation
from marlyap.runs import bench
from marlyap.simulation.evaluation import evaluate
from marlyap.tasks import TASKS, Rendezvous


KEY = jax.random.key(0)


class Measured(NamedTuple):
    """What an independent NumPy oracle measured over a thousand starts or more."""

    task: str
    controller: str
    cost: float
    spread: float  # of the mean cost, as a share of it, with so many starts
    success: float
    failed: float = 0.0
    episodes: int = 200


MEASURED = [
    Measured("formation-di", "zero", 1.569, 0.1, 0.0),
    Measured("formation-di", "formation-consensus", 0.213, 0.12, 1.0),
    Measured("formation-di", "formation-linear", 0.1054, 0.12, 1.0),
    Measured("cartpoles", "zero", 9.72, 0.02, 0.0, 1.0),
    Measured("cartpoles", "uniform", 9.76, 0.02, 0.0, 1.0),
    Measured("cartpoles", "cart-lqr", 0.01049, 0.08, 1.0),
    Measured("cartpoles", "cart-feedback", 0.00770, 0.08, 1.0),
    Measured("microgrid", "zero", 0.447, 0.1, 0.009),
    Measured("microgrid", "hold", 0.393, 0.1, 0.093),
    Measured("microgrid", "grid-feedback", 0.00555, 0.08, 1.0),
    Measured("platoon-catchup", "zero", 0.541, 0.35, 0.0, 0.0, 40),
    Measured("platoon-catchup", "uniform", 8.22, 0.05, 0.0, 1.0, 40),
    Measured("platoon-catchup", "platoon-ovm", 0.1023, 0.35, 1.0, 0.0, 40),
    Measured("platoon-catchup", "platoon-linear", 0.0324, 0.35, 1.0, 0.0, 40),
    Measured("platoon-slowdown", "zero", 8.28, 0.05, 0.0, 1.0, 40),
    Measured("platoon-slowdown", "uniform", 8.40, 0.05, 0.0, 1.0, 40),
    Measured("platoon-slowdown", "platoon-ovm", 0.617, 0.35, 1.0, 0.0, 40),
    Measured("platoon-slowdown", "platoon-linear", 0.410, 0.35, 1.0, 0.0, 40),
    Measured("platoon-long", "platoon-ovm", 1.18, 0.3, 0.22, 0.18),
    Measured("platoon-long", "platoon-linear", 0.380, 0.15, 1.0),
    Measured("quads-planar", "zero", 16.1, 0.1, 0.0, 0.993, 60),
    Measured("quads-planar", "uniform", 25.1, 0.03, 0.0, 1.0, 60),
    Measured("quads-planar", "quad-chain", 0.183, 0.3, 0.999, 0.001, 60),  # of those that succeed
    Measured("quads-space", "zero", 18.1, 0.03, 0.0, 1.0, 60),
    Measured("quads-space", "uniform", 20.6, 0.03, 0.0, 1.0, 60),
    Measured("quads-space", "quad-chain-space", 0.243, 0.2, 1.0, 0.0, 60),
    Measured("consensus", "zero", 0.300, 0.07, 0.0),
    Measured("consensus", "uniform", 54.8, 0.1, 0.0, 0.97),
    Measured("consensus", "laplacian", 0.01124, 0.08, 1.0),
    Measured("consensus-unstable", "zero", 40.7, 0.03, 0.0, 1.0),
    Measured("consensus-unstable", "laplacian", 0.01348, 0.09, 1.0),
    Measured("estimation", "zero", 2.085, 0.05, 0.0),
    Measured("estimation", "uniform", 268.0, 0.05, 0.0, 1.0),
    Measured("estimation", "consensus-filter", 0.00965, 0.05, 1.0),
    Measured("frequency", "zero", 1.178, 0.1, 0.0),
    Measured("frequency", "uniform", 1.203, 0.1, 0.0),
    Measured("frequency", "droop", 0.2205, 0.13, 1.0),
    Measured("frequency", "steep-droop", 0.2055, 0.14, 1.0),
    Measured("frequency-weak", "zero", 2.64, 0.1, 0.0),
    Measured("frequency-weak", "droop", 0.284, 0.14, 0.998),
    Measured("frequency-step", "zero", 1.228, 0.11, 0.0),
    Measured("frequency-step", "droop", 0.2236, 0.13, 1.0),
    Measured("frequency-step", "steep-droop", 0.2080, 0.14, 1.0),
    Measured("ring", "zero", 1.885, 0.2, 0.0, 0.094, 100),
    Measured("ring", "ring-human", 0.772, 0.15, 0.0, 0.0, 20),
    Measured("ring", "follower-stopper", 0.1764, 0.3, 1.0, 0.0, 20),
    Measured("ring", "ring-linear", 0.1781, 0.35, 1.0, 0.0, 20),
    Measured("ring2", "zero", 3.878, 0.01, 0.0, 1.0, 20),
    Measured("ring2", "follower-stopper", 0.0916, 0.3, 1.0, 0.0, 20),
    Measured("ring2", "ring-linear", 0.0994, 0.3, 1.0, 0.0, 20),
    Measured("coverage", "zero", 2.09, 0.05, 0.0),
    Measured("coverage", "uniform", 1.847, 0.05, 0.0),
    Measured("coverage", "lloyd", 0.277, 0.04, 1.0),
    Measured("coverage-bump", "lloyd", 0.323, 0.04, 1.0),
    Measured("flock", "zero", 20.7, 0.13, 0.0),
    Measured("flock", "olfati-saber", 1.008, 0.06, 0.971),
    Measured("flock", "olfati-saber-free", 43.8, 0.1, 0.0),
    Measured("gnn-flock", "zero", 5.685, 0.04, 0.0),
    Measured("gnn-flock", "alignment", 0.557, 0.13, 0.306),
    Measured("gnn-flock", "tanner", 5.046, 0.05, 0.0),
    Measured("gnn-flock", "braking", 0.2242, 0.05, 1.0),
    Measured("gnn-flock-slow", "zero", 0.632, 0.04, 0.0),
    Measured("gnn-flock-slow", "alignment", 0.0326, 0.19, 0.948),
    Measured("gnn-flock-slow", "tanner", 2.296, 0.05, 0.0),
    Measured("gnn-flock-slow", "braking", 0.0094, 0.05, 1.0),
    Measured("voltage13", "zero", 1.320, 0.2, 0.019),
    Measured("voltage13", "uniform", 3.55, 0.56, 0.0, 0.055),
    Measured("voltage13", "dead-band-mild", 0.0895, 0.23, 0.996),
    Measured("voltage13", "dead-band", 0.0623, 0.24, 1.0),
    Measured("voltage13", "linear-voltage", 0.0582, 0.24, 0.941),
    Measured("voltage33", "zero", 0.478, 0.35, 0.331),
    Measured("voltage33", "uniform", 32.2, 0.21, 0.0, 0.655),
    Measured("voltage33", "dead-band-mild", 0.0197, 0.36, 1.0),
    Measured("voltage33", "dead-band", 0.0163, 0.36, 1.0),
    Measured("voltage33", "linear-voltage", 0.0168, 0.36, 1.0),
]
BENCH = tuple(dict.fromkeys(m.task for m in MEASURED))


class Counted:
    """A function that counts its calls, and is interrupted in one of them."""

    def __init__(self, f, stop=None):
        self.f, self.stop, self.calls = f, stop, 0

    def __call__(self, *args, **options):
        self.calls += 1
        if self.calls == self.stop:
            raise KeyboardInterrupt
        return self.f(*args, **options)


GLOBAL = ("uniform", "braking")  # not made of what each agent knows
LOCAL = sorted({(m.task, m.controller) for m in MEASURED if m.controller not in GLOBAL})
SILENT = ("zero", "hold", "dead-band", "dead-band-mild")  # near the target
FAST = ("cartpoles", "consensus", "microgrid", "platoon-slowdown", "voltage13")  # one of each kind


def marked(cases, task=lambda case: case[0], fast=FAST):
    """Those of other tasks are slow, all in all."""
    name = lambda case: "-".join(case[:2]) if isinstance(case, tuple) else case
    marks = lambda case: [] if task(case) in fast else [pytest.mark.slow]
    return [pytest.param(case, marks=marks(case), id=name(case)) for case in cases]


def regulation(task):
    game = TASKS[task]
    assert isinstance(game, AbstractRegulation)
    return game


@pytest.mark.parametrize("known", marked(MEASURED))
def test_a_controller_reaches_what_was_measured(known):
    game, n = TASKS[known.task], known.episodes
    found = evaluate(game, CONTROLLERS[known.controller](game), n, beyond=0).summary()
    about = lambda p: pytest.approx(p, abs=0.03 + 3 * (p * (1 - p) / n) ** 0.5)
    assert found["cost_mean"] == pytest.approx(known.cost, rel=known.spread)
    assert found["success_rate"] == about(known.success)
    assert found["failed"]["success_rate"] == about(known.failed)


@pytest.mark.parametrize("case", marked(LOCAL))
def test_a_controller_is_local_bounded_and_finite(case):
    """Row i changes with agent j only if they are linked, and even far away it is an action."""
    task, controller = case
    game = regulation(task)
    law = CONTROLLERS[controller](game)
    act = eqx.filter_jit(lambda states: jax.vmap(lambda s: law(s, KEY))(states))
    start = game.reset(jax.random.key(1))
    near = game.farther(start, 0.01)  # far from the limits, at which nothing changes
    moved = [
        eqx.tree_at(lambda s: s.x, near, near.x.at[j].add(1e-3 * jnp.abs(start.x[j]) + 1e-4))
        for j in range(game.agents)
    ]
    far = [game.farther(start, factor) for factor in (1.0, 10.0, 1e4)]
    out = np.asarray(act(jax.tree.map(lambda *x: jnp.stack(x), near, *moved, *far)))
    assert np.isfinite(out).all() and (np.abs(out) <= 1).all()
    linked = np.asarray(game.linked(near)) | np.eye(game.agents, dtype=bool)
    for j in range(game.agents):
        changed = (out[1 + j] != out[0]).any(axis=1)
        assert not (changed & ~linked[:, j]).any()
        still = controller in SILENT or (np.abs(out[0, j]) == 1).all()
        assert changed[j] or still


UNSTABLE = [
    ("cartpoles", 1.082, 0.003),
    ("consensus-unstable", 1.1, 1e-6),
    ("estimation", 1.01, 1e-6),
    ("frequency-weak", 1.0011, 5e-5),
]


@pytest.mark.parametrize(("task", "factor", "close"), UNSTABLE)
def test_without_control_it_diverges(task, factor, close):
    """The largest eigenvalue of a step at the target set is what the literature's plant has."""
    game = regulation(task)
    with jax.enable_x64(True):
        there = jax.tree.map(double, game.at_target(game.reset(KEY)))

        def after(x):
            state = eqx.tree_at(lambda s: s.x, there, x.reshape(there.x.shape))
            return game.step(state, game.hold(there)).x.ravel()

        A = jax.jacobian(after)(there.x.ravel())
    assert np.abs(np.linalg.eigvals(np.asarray(A))).max() == pytest.approx(factor, abs=close)


def test_a_load_above_563_watts_destabilises_the_microgrid():
    """P > V^2 R C / L, up to what the discrete step adds."""
    game = regulation("microgrid")

    def radius(power):
        start = game.reset(KEY)
        start = eqx.tree_at(lambda s: s.scenario.power, start, jnp.full(game.agents, power))
        there = game.at_target(start)

        def after(x):
            state = eqx.tree_at(lambda s: s.x, there, x.reshape(there.x.shape))
            return game.step(state, game.hold(there)).x.ravel()

        return np.abs(np.linalg.eigvals(np.asarray(jax.jacobian(after)(there.x.ravel())))).max()

    assert radius(540.0) < 1 < radius(610.0)


STRINGS = [
    ("platoon-slowdown", "platoon-ovm", 1.160),
    ("platoon-slowdown", "platoon-linear", 1.0),
    ("platoon-catchup", "platoon-linear", 1.0),
]


@pytest.mark.parametrize(("task", "controller", "most"), STRINGS)
def test_how_much_a_disturbance_grows_from_car_to_car(task, controller, most):
    """sup |G(z)| on the unit circle at the sampling time: only the tuned law is string stable."""
    game = regulation(task)
    law, there = CONTROLLERS[controller](game), game.at_target(game.reset(KEY))
    u = lambda x: game.plant.limits[0] * law(eqx.tree_at(lambda s: s.x, there, x), KEY)[1, 0]
    slope = np.asarray(jax.grad(u)(there.x), float)
    k_h, k_ahead, k_own = slope[1, 0], slope[0, 1], slope[1, 1]
    z = np.exp(1j * np.geomspace(1e-3, np.pi, 4000))
    h = game.dt / 2 * (z + 1) / (z - 1)  # of v_ahead - v
    G = game.dt * (k_ahead + k_h * h) / (z - 1 + game.dt * (k_h * h - k_own))
    assert np.abs(G).max() == pytest.approx(most, abs=2e-3)


@pytest.mark.slow
def test_only_a_string_stable_law_drives_a_platoon_of_32():
    game = regulation("platoon-slowdown").resized(32)
    found = [evaluate(game, CONTROLLERS[f"platoon-{law}"](game), 40) for law in ("ovm", "linear")]
    assert found[0].failed.all() and found[1].success_rate == 1.0


@pytest.mark.parametrize(("length", "growth"), [(220, 0.0236), (270, 0.0187)])
def test_humans_on_a_ring_break_up_and_one_car_that_holds_its_speed_calms_them(length, growth):
    """The largest eigenvalue of a step, besides that of turning the ring (growth in 1/s)."""
    game = regulation("ring")
    plant, gap = game.plant, length / game.plant.cars - game.plant.size

    def radius(drive):
        start = game.reset(KEY)
        road = lambda s: (s.scenario.length, s.scenario.flow)
        there = eqx.tree_at(road, start, (jnp.asarray(float(length)), plant.flow(jnp.asarray(gap))))
        there = game.at_target(jax.tree.map(double, there))

        def after(x):
            state = eqx.tree_at(lambda s: s.x, there, x.reshape(there.x.shape))
            ahead, v = game.ahead(state)[:1], state.x[:1, 1]
            a = drive(v, ahead, game.gaps(state)[:1], there.scenario.flow) / plant.limits[0]
            return game.step(state, a[:, None]).x.ravel()

        eigenvalues = np.linalg.eigvals(np.asarray(jax.jacobian(after)(there.x.ravel())))
        turn = np.argmin(np.abs(eigenvalues - 1))
        return np.abs(np.delete(eigenvalues, turn)).max()

    with jax.enable_x64(True):
        human = radius(lambda v, ahead, gap, flow: plant.human(v, ahead, gap))
        calm = radius(lambda v, ahead, gap, flow: 0.5 * (flow - v) + 0.3 * (ahead - v))
    assert np.log(human) / game.dt == pytest.approx(growth, abs=2e-4) and calm < 1


def double(x):
    """In double precision, if it is a float."""
    return jnp.asarray(x, float) if jnp.issubdtype(x.dtype, jnp.floating) else x


TINY = """--task.horizon 6 --steps 24 --schedule.environments 2 --schedule.warmup 6
--schedule.select_episodes 2 --schedule.steps_per_update 6""".split()


def game_has_a_map(task):
    game = TASKS[task]
    return game.scene(game.reset(KEY)) is not None


@pytest.mark.parametrize("task", marked(BENCH, lambda task: task, ("microgrid",)))
def test_every_command_takes_it(task, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")  # so that no name is broken
    run = "out/seed0"

    def said(*argv, ends=(0,)):
        capsys.readouterr()
        assert main([*argv, "--json"]) in ends, capsys.readouterr().err
        return json.loads(capsys.readouterr().out)

    made = said("train", task, "masac-lyapunov", "--out", "out", *TINY)
    assert made["runs"][0]["finished"]
    assert said("evaluate", run, "--episodes", "4")["runs"][0]["episodes"] == 4
    assert main(["evaluate", run, "hold", "--task", task, *TINY[:2], "--episodes", "4"]) == 0
    assert "cost" in (table := capsys.readouterr().out) and ("m/s" in table) == game_has_a_map(task)
    assert said("report", run) and Path(run, "report.html").stat().st_size > 10_000
    assert said("watch", run) and Path(run, "film.gif").read_bytes()[:3] == b"GIF"
    assert (
        main(["watch", "hold", "--task", task, "--episode", "2"]) == 0 and Path("film.gif").exists()
    )
    asked = ("--certificates", "reach", "quantiles", "--rollouts", "1000")
    verdicts = said("certify", run, *asked, ends=(0, 1))
    assert verdicts
    assert main(["recheck", f"{run}/certificate"]) in (1, 2)
    assert main(["list", task]) == 0
    told = capsys.readouterr().out
    names = [e.name for part in TASKS[task].entries().values() for e in part]
    assert names and all(name in told for name in names)


@pytest.mark.parametrize(("task", "controller"), LOCAL)
def test_a_controller_of_another_game_is_refused(task, controller):
    law = CONTROLLERS[controller](TASKS[task])
    elsewhere = eqx.tree_at(lambda c: c.game, law, Rendezvous())
    if law.drives:
        with pytest.raises(UserError, match=f"^controller: {type(law).__name__} drives .* not Uni"):
            AbstractController.__check_init__(elsewhere)
    else:
        AbstractController.__check_init__(elsewhere)


def test_the_bench_measures_each_cell_once(tmp_path, monkeypatch, capsys):
    """Two games and a run of one; stopped in the middle and resumed; then nothing is left."""
    monkeypatch.chdir(tmp_path)
    small = "--steps 2000 --schedule.environments 2 --schedule.warmup 1000".split()
    small += "--schedule.select_episodes 2 --schedule.steps_per_update 500".split()
    assert main(["train", "cartpoles", "masac", "--out", "r", *small]) == 0
    monkeypatch.setattr(bench, "evaluate", counted := Counted(evaluate, stop=5))
    asked = ["bench", "cartpoles", "microgrid", "--quick", "--out", "b", "--runs", "r", "--json"]
    asked += ["--controllers", "zero", "cart-feedback", "grid-feedback"]
    assert main(asked) == 130
    assert not Path("b/bench.csv").exists() and len(list(Path("b/cells").rglob("*.json"))) == 4
    counted.stop = None
    capsys.readouterr()
    rows = json.loads((main(asked), capsys.readouterr().out)[1])["rows"]
    assert counted.calls == 1 + len(rows) and len({r["controller"] for r in rows}) == 4
    page = Path("b/bench.html").read_text()
    assert "cart-feedback" in page and "r/seed0" in page and "://" not in page
    assert Path("b/bench.csv").read_text().count("\n") == 1 + len(rows)
    by = {(r["game"], r["controller"], r["horizons"]): r for r in rows}
    assert by["microgrid", "grid-feedback", 2]["success"] == 1.0
    assert by["cartpoles", "zero", 1]["failed"] == 1.0
    assert by["cartpoles", "zero", 2]["steps"] == 1000
    main(asked)
    assert counted.calls == 1 + len(rows)
    Path("b/cells/cartpoles/zero-1.json").write_text("{}")
    main(asked)
    assert counted.calls == 2 + len(rows)


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["cartpole"], "did you mean 'cartpoles'"),
        (["cartpoles", "--controllers", "cart-lrq"], "did you mean 'cart-lqr'"),
        (["cartpoles", "--controllers", "grid-feedback"], "drives none of these games"),
        (["cartpoles", "--episodes", "0"], "episodes: 0 is out of range"),
        (["cartpoles", "--longer", "0"], "longer: 0 is out of range"),
        (["cartpoles", "--task.agents", "4"], "the bench measures the games as they are"),
        (["cartpoles", "--runs", "nowhere"], "nowhere"),
    ],
)
def test_what_the_bench_cannot_do_is_one_sentence(argv, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["bench", *argv]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1
