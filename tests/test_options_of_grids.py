"""What may disturb the games of grids, sensors and flocks: off unless asked for, and bad values."""

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
REST = [o for o in OPTIONS if o[2] != "plant"]  # a target that wanders takes everybody along


@eqx.filter_jit
def played(game, law):
    """Four episodes."""
    one = lambda key: rollout(game, law, game.reset(key), key)
    return jax.vmap(one)(jax.random.split(KEY, 4))


@pytest.mark.parametrize(("task", "law", "option", "value"), OPTIONS)
def test_an_option_disturbs_every_episode(task, law, option, value):
    nominal = replace(TASKS[task], horizon=30)
    games = nominal, replace(nominal, **{option: value})
    usual, seen = (played(g, CONTROLLERS[law](g)).state.x for g in games)
    off = np.abs(np.asarray(seen) - np.asarray(usual)).max(axis=(1, 2, 3))
    assert np.isfinite(seen).all() and (off > 1e-6).all()


@pytest.mark.slow
@pytest.mark.parametrize(("task", "law", "option", "value"), REST)
def test_an_option_leaves_a_target_that_can_be_held(task, law, option, value):
    game = replace(TASKS[task], **{option: value})
    for key in jax.random.split(KEY, 3):
        there = game.at_target(game.reset(key))
        after = game.step(there, game.hold(there))
        assert game.success(there) and game.success(after)
        assert jnp.abs(game.errors(after)).max() < 1e-4
        assert game.cost(there, game.hold(there)) < 1e-6


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

    x = played(game, Droop(game)).state.x
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
def test_bad_fields_are_named(made, says):
    with pytest.raises(UserError, match=f"^{says}"):
        made()
