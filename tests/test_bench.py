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
from marlyap.controllers import CONTROLLERS
from marlyap.errors import UserError
from marlyap.games.game import AbstractRegulation
from marlyap.simulation.evaluation import outcomes
from marlyap.tasks import TASKS, Rendezvous


KEY = jax.random.key(0)


class Measured(NamedTuple):
    """What an independent NumPy oracle measured over a thousand starts or more."""

    task: str
    controller: str
    cost: float
    spread: float  # of the mean cost, as a share of it, with 200 starts
    success: float
    failed: float = 0.0


MEASURED = [
    Measured("cartpoles", "zero", 9.72, 0.02, 0.0, 1.0),
    Measured("cartpoles", "uniform", 9.76, 0.02, 0.0, 1.0),
    Measured("cartpoles", "cart-lqr", 0.01049, 0.08, 1.0),
    Measured("cartpoles", "cart-feedback", 0.00770, 0.08, 1.0),
    Measured("microgrid", "zero", 0.447, 0.1, 0.009),
    Measured("microgrid", "hold", 0.393, 0.1, 0.093),
    Measured("microgrid", "grid-feedback", 0.00555, 0.08, 1.0),
    Measured("consensus", "zero", 0.300, 0.07, 0.0),
    Measured("consensus", "laplacian", 0.01124, 0.08, 1.0),
    Measured("consensus-unstable", "zero", 40.7, 0.03, 0.0, 1.0),
    Measured("consensus-unstable", "laplacian", 0.01348, 0.09, 1.0),
    Measured("estimation", "zero", 2.085, 0.05, 0.0),
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
    Measured("coverage", "zero", 2.09, 0.05, 0.0),
    Measured("coverage", "lloyd", 0.277, 0.04, 1.0),
    Measured("coverage-bump", "lloyd", 0.323, 0.04, 1.0),
    Measured("flock", "zero", 20.7, 0.13, 0.0),
    Measured("flock", "olfati-saber", 1.008, 0.06, 0.971),
    Measured("flock", "olfati-saber-free", 43.8, 0.1, 0.0),
    Measured("gnn-flock", "zero", 5.685, 0.04, 0.0),
    Measured("gnn-flock", "alignment", 0.557, 0.13, 0.306),
    Measured("gnn-flock", "braking", 0.2242, 0.05, 1.0),
    Measured("gnn-flock-slow", "zero", 0.632, 0.04, 0.0),
    Measured("gnn-flock-slow", "alignment", 0.0326, 0.19, 0.948),
    Measured("gnn-flock-slow", "braking", 0.0094, 0.05, 1.0),
    Measured("voltage13", "zero", 1.320, 0.2, 0.019),
    Measured("voltage13", "uniform", 3.55, 0.56, 0.0, 0.055),
    Measured("voltage13", "dead-band-mild", 0.0895, 0.23, 0.996),
    Measured("voltage13", "dead-band", 0.0623, 0.24, 1.0),
    Measured("voltage33", "zero", 0.478, 0.35, 0.331),
    Measured("voltage33", "uniform", 32.2, 0.21, 0.0, 0.655),
    Measured("voltage33", "dead-band-mild", 0.0197, 0.36, 1.0),
    Measured("voltage33", "dead-band", 0.0163, 0.36, 1.0),
]
QUICK = ("cartpoles", "microgrid")  # whose commands are run every time
BENCH = [
    task if task in QUICK else pytest.param(task, marks=pytest.mark.slow)
    for task in dict.fromkeys(m.task for m in MEASURED)
]
LOCAL = sorted(
    {(m.task, m.controller) for m in MEASURED if m.controller not in ("uniform", "braking")}
)


SILENT = ("zero", "hold", "dead-band", "dead-band-mild")  # near the target


def regulation(task):
    game = TASKS[task]
    assert isinstance(game, AbstractRegulation)
    return game


@pytest.mark.parametrize("known", MEASURED, ids=lambda m: f"{m.task}-{m.controller}")
def test_a_controller_reaches_what_was_measured(known):
    game = TASKS[known.task]
    found = outcomes(game, CONTROLLERS[known.controller](game), jax.random.split(KEY, 200))
    assert found.cost.mean() == pytest.approx(known.cost, rel=known.spread)
    assert found.success.mean() == pytest.approx(known.success, abs=0.07)
    assert found.failed.mean() == pytest.approx(known.failed, abs=0.07)


@pytest.mark.parametrize(("task", "controller"), LOCAL)
def test_a_controller_is_local_bounded_and_finite(task, controller):
    """Row i changes with agent j only if they are linked, and even far away it is an action."""
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
        assert changed[j] or controller in SILENT


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
        there = jax.tree.map(
            lambda x: jnp.asarray(x, float) if jnp.issubdtype(x.dtype, jnp.floating) else x,
            game.at_target(game.reset(KEY)),
        )

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


TINY = """--task.horizon 6 --steps 24 --schedule.environments 2 --schedule.warmup 6
--schedule.select_episodes 2 --schedule.steps_per_update 6""".split()


def game_has_a_map(task):
    game = TASKS[task]
    return game.scene(game.reset(KEY)) is not None


@pytest.mark.parametrize("task", BENCH)
def test_every_command_takes_it(task, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
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
            elsewhere.__check_init__()
    else:
        elsewhere.__check_init__()
