"""Disturbances and parameters drawn at random: off unless asked for, and bad values are named."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.controllers import CONTROLLERS, Droop, Laplacian
from marlyap.errors import UserError
from marlyap.simulation.rollout import rollout
from marlyap.tasks import TASKS
from marlyap.tasks.consensus import Averaging
from marlyap.tasks.estimation import Prediction
from marlyap.tasks.frequency import SwingEquations
from marlyap.tasks.networks import feeder, new_england
from marlyap.tasks.voltage import PowerFlow


KEY = jax.random.key(3)
OPTIONS = [
    ("platoon-catchup", "platoon-linear", "swing", 3.0),
    ("platoon-catchup", "platoon-linear", "lag", 0.3),
    ("platoon-catchup", "platoon-linear", "gain_spread", 0.2),
    ("quads-planar", "quad-chain", "gust", 0.3),
    ("quads-planar", "quad-chain", "inertia_spread", 0.2),
    ("quads-space", "quad-chain-space", "gust", 2.0),
    ("quads-space", "quad-chain-space", "inertia_spread", 0.2),
    ("ring", "ring-linear", "noise", 0.4),
    ("consensus", "laplacian", "noise", 0.05),
    ("estimation", "consensus-filter", "noise", 0.05),
    ("estimation", "consensus-filter", "plant", Prediction(wander=0.01)),
    ("frequency", "droop", "load_step", 0.5),
    ("frequency", "droop", "inertia_spread", 0.2),
    ("frequency", "droop", "damping_spread", 0.2),
    ("frequency", "droop", "line_spread", 0.2),
    ("voltage13", "dead-band", "load_step", 0.3),
    ("voltage13", "dead-band", "line_spread", 0.1),
    ("coverage-bump", "lloyd", "move", 0.2),
    ("flock", "olfati-saber", "push", 0.5),
    ("gnn-flock", "alignment", "push", 0.5),
]
WANDERS = "plant"  # a target that wanders takes everybody along, so that no action holds it


@eqx.filter_jit
def played(game, law, key):
    """Six episodes."""
    one = lambda key: rollout(game, law, game.reset(key), key)
    return jax.vmap(one)(jax.random.split(key, 6))


LARGE = ("coverage-bump", "estimation", "flock", "gnn-flock", "quads-space", "ring")  # to compile
slowly = lambda task: [pytest.mark.slow] if task in LARGE else []


@pytest.mark.parametrize(
    ("task", "law", "option", "value"), [pytest.param(*o, marks=slowly(o[0])) for o in OPTIONS]
)
def test_an_option_disturbs_the_motion_and_not_the_target(task, law, option, value):
    nominal = replace(TASKS[task], horizon=100)
    game = replace(nominal, **{option: value})
    seen, usual = (played(g, CONTROLLERS[law](g), KEY) for g in (game, nominal))
    x, before = np.asarray(seen.state.x), np.asarray(usual.state.x)
    assert np.isfinite(x).all() and not seen.failed.any()
    assert (np.abs(x - before).max(axis=(1, 2, 3)) > 1e-5).all()
    if option == WANDERS:
        return
    there = game.at_target(game.reset(jax.random.key(4)))
    assert game.success(there) and jnp.abs(game.errors(there)).max() < 1e-4
    after = game.step(there, game.hold(there))
    assert jnp.abs(game.errors(after)).max() < 1e-3


def test_an_engine_with_a_lag_comes_to_what_is_asked_for_exponentially():
    game = TASKS["platoon-catchup"]
    start = game.at_target(game.reset(jax.random.key(0)))
    start = eqx.tree_at(lambda s: s.scenario.lag, start, jnp.full(game.agents, 0.5))
    state, asked = start, jnp.full((game.agents, 1), 0.4)
    for k in range(1, 4):
        state = game.step(state, asked)
        np.testing.assert_allclose(state.x[:, 2], 1.0 - np.exp(-k * game.dt / 0.5), atol=1e-4)


def test_a_gust_pushes_while_it_lasts():
    game = TASKS["quads-space"]
    start = game.at_target(game.reset(jax.random.key(0)))
    flight = lambda s: (s.scenario.gust, s.scenario.begins)
    state = eqx.tree_at(flight, start, (start.scenario.gust.at[1, 0].set(2.0), jnp.asarray(0.09)))
    moved = []
    for _ in range(40):
        state = game.step(state, game.hold(state))
        moved.append(float(state.x[1, 3]))
    assert moved[4] == 0 and moved[9] == pytest.approx(0.2, rel=0.05)
    assert moved[29] == pytest.approx(1.0, rel=0.05) and moved[39] < moved[29]


def test_droop_makes_the_energy_of_the_grid_fall():
    """V' = -2 pi sum (D w^2 + w u) by Cui, Jiang and Zhang, up to what a discrete step adds."""
    game, net = TASKS["frequency"], new_england()
    M = 2 * np.array(game.plant.inertia) / 60
    rest = net.angle[:, None] - net.angle[None, :]

    def energy(x):
        angle, w = np.asarray(x, float).T
        d = angle[:, None] - angle[None, :]
        well = net.K * (np.cos(rest) - np.cos(d) - np.sin(rest) * (d - rest))
        return np.pi * np.sum(M * w**2) + well.sum() / 2

    x = played(game, Droop(game), KEY).state.x
    V = np.array([[energy(x) for x in episode[::20]] for episode in x])
    assert (np.diff(V, axis=1) < 1e-3 * V[:, :-1]).all() and (V[:, -1] < 0.3 * V[:, 0]).all()


@pytest.mark.parametrize(("growth", "agrees"), [(1.31, True), (1.32, False)])
def test_agreement_is_possible_up_to_the_growth_of_you_and_xie(growth, agrees):
    game = replace(TASKS["consensus"], plant=Averaging(growth=growth))
    start = game.reset(KEY)

    def after(x):
        state = eqx.tree_at(lambda s: s.x, start, x[:, None])
        return game.step(state, Laplacian(game)(state, KEY)).x[:, 0]

    A = np.asarray(jax.jacobian(after)(jnp.zeros(game.agents)))
    assert (np.abs(np.linalg.eigvals(A)).max() < 1) == agrees


@pytest.mark.parametrize(("task", "limit"), [("voltage13", 18.9), ("voltage33", 23.2)])
def test_the_largest_stable_slope_of_a_feeder(task, limit):
    X = TASKS[task].plant.sensitivity
    assert 2 / np.linalg.eigvalsh(X)[-1] == pytest.approx(limit, abs=0.05)
    assert np.allclose(X, X.T) and (X > 0).all()


def test_networks_are_those_of_the_literature():
    """Flows balance, and the loads of Baran and Wu add up to 3.715 MW and 2.3 MVar."""
    net = new_england()
    assert np.allclose(net.K, net.K.T) and abs(net.stiffness.sum()) < 1e-9
    assert feeder("33").load.sum() == pytest.approx(3.715 + 2.3j)
    assert feeder("13").Z.shape == (12, 12)


@pytest.mark.parametrize(
    ("task", "field", "value"),
    [
        ("formation-di", "spread", 0.0), ("formation-di", "effort", -1.0),
        ("platoon-catchup", "headway", 0.0), ("platoon-catchup", "lag", -0.1),
        ("platoon-catchup", "gain_spread", 1.0), ("platoon-catchup", "start_speed", (2.0, 1.0)),
        ("platoon-catchup", "start_headway", (1.0,)), ("platoon-catchup", "weights", (1.0,)),
        ("platoon-catchup", "stopping", 40.0), ("quads-planar", "start", (1.0,)),
        ("quads-planar", "leaders", (3,)), ("quads-space", "calm", 0.0),
        ("quads-space", "inertia_spread", 1.0), ("quads-space", "weights", (1.0, 1.0)),
        ("ring", "agents", 3), ("ring", "shortest", 200), ("ring", "longest", 210),
        ("ring", "noise", -1.0), ("ring", "weights", (1.0, -1.0)),
    ],
)  # fmt: skip
def test_bad_fields_are_named(task, field, value):
    with pytest.raises(UserError, match=f"^{field}: .*[.]$"):
        replace(TASKS[task], **{field: value})


@pytest.mark.parametrize(
    ("task", "law", "change", "said"),
    [
        ("formation-di", "formation-linear", {"agents": 4}, "gains for 5 agents, not for 4"),
        ("formation-di", "formation-linear", {"graph": "star"}, "graph path or complete"),
        ("quads-planar", "quad-chain", {"leaders": (1,)}, "agent 0 as a leader"),
        ("quads-space", "quad-chain-space", {"graph": "star"}, "graph path or complete"),
    ],
)
def test_a_law_for_a_chain_refuses_other_teams(task, law, change, said):
    with pytest.raises(UserError, match=f"^controller: .*{said}"):
        CONTROLLERS[law](replace(TASKS[task], **change))


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (lambda: replace(TASKS["frequency"], agents=5), "agents: 5 are not the network's"),
        (lambda: SwingEquations(damping=(1.0,)), "damping: give ten numbers"),
        (lambda: replace(TASKS["frequency"], load_step=9.0), "load_step: 9.0 is out of range"),
        (lambda: PowerFlow(buses="14"), "buses: there is no feeder with 14"),
        (lambda: PowerFlow(inverters=(0, 1, 2)), "inverters: .* must be buses from 1 to 12"),
        (lambda: replace(TASKS["voltage13"], agents=4), "agents: 4 needs as many plant.inverters"),
        (lambda: replace(TASKS["voltage13"], low=1.2), "low: fall < low < 1 < high < rise"),
        (lambda: replace(TASKS["estimation"], dt=0.1), "dt: 0.1 s is not plant.period"),
        (lambda: replace(TASKS["coverage"], dt=0.2), "dt: 0.2 s is not plant.period"),
        (lambda: replace(TASKS["consensus"], agents=12), "graph: .* is not connected"),
        (lambda: replace(TASKS["gnn-flock"], agents=2), "agents: everybody needs two neighbours"),
        (lambda: replace(TASKS["flock"], push=20.0), "push: 20.0 is out of range"),
        (lambda: Averaging(growth=0.5), "growth: 0.5 is out of range"),
    ],
)
def test_what_fits_no_network_or_plant_is_named(made, says):
    with pytest.raises(UserError, match=f"^{says}"):
        made()
