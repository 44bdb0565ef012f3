"""What every hand-written controller must respect, and what each is known to achieve."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.controllers import (
    CONTROLLERS,
    AbstractController,
    OptimalControl,
    PointOffset,
    Replayed,
    names_a_controller,
)
from marlyap.errors import UserError
from marlyap.games.dynamics import DoubleIntegrator, LateUnicycle, Unicycle
from marlyap.games.planar import Goals
from marlyap.runs.config import load_controller
from marlyap.simulation.evaluation import evaluate
from marlyap.simulation.rollout import rollout
from marlyap.tasks import CartPoles, Microgrid, Rendezvous
from marlyap.types import State


LAWS = ["point-offset", "gradient-consensus", "lin-francis-maggiore", "tree-pursuit"]
OTHERS = {"cart-lqr": CartPoles(), "cart-feedback": CartPoles(), "grid-feedback": Microgrid()}
ANY = ("zero", "hold", "uniform")
every_law = pytest.mark.parametrize("name", LAWS)
PATH = Rendezvous(agents=5, graph="path")
STRONG = Rendezvous(agents=5, graph="path", dynamics=Unicycle(limits=(1e4, 1e4)))  # unsaturated
DISK = Rendezvous(agents=5, graph="disk:0.9")
KEY = jax.random.key(0)
act = eqx.filter_jit(lambda controller, state: controller(state, KEY))
step = eqx.filter_jit(lambda game, state, action: game.step(state, action))
act_all = eqx.filter_jit(lambda controller, states: jax.vmap(lambda s: controller(s, KEY))(states))


def moving(game, seed=0):
    """A random state with every agent in motion."""
    state = game.reset(jax.random.key(seed))
    rates = jax.random.normal(jax.random.key(seed + 1), (game.agents, 2))
    return eqx.tree_at(lambda s: s.x, state, state.x.at[:, 3:].set(rates))


def batch(states):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


def distances(game, controller, episodes):
    """How far each agent is from its goal, [time, episode, agent]."""

    @eqx.filter_jit
    def run(controller, keys):
        one = lambda k: jax.vmap(game.distance)(rollout(game, controller, game.reset(k), k).state)
        return jax.vmap(one, out_axes=1)(keys)

    return np.asarray(run(controller, jax.random.split(jax.random.key(7), episodes)))


@every_law
def test_an_agent_uses_only_what_it_may_know(name):
    state = moving(STRONG)
    others = [eqx.tree_at(lambda s: s.x, state, state.x.at[j].add(0.3)) for j in range(5)]
    blind = eqx.tree_at(lambda s: s.scenario.goal, state, state.scenario.goal.at[1:].add(7.0))
    out = np.asarray(act_all(CONTROLLERS[name](STRONG), batch([state, *others, blind])))
    for j in range(5):
        for i in range(5):
            if abs(i - j) > 1:
                assert (out[1 + j, i] == out[0, i]).all(), f"{i} saw {j}"
    assert (out[6] == out[0]).all(), "a follower saw its goal"
    assert all((out[1 + j, j] != out[0, j]).any() for j in range(5))


@every_law
def test_a_turn_and_a_shift_of_the_scene_change_nothing(name):
    def moved(state, angle, shift):
        c, s = np.cos(angle), np.sin(angle)
        turn = lambda p: p @ jnp.array([[c, s], [-s, c]]) + shift[None]
        x = jnp.concatenate([turn(state.x[:, :2]), state.x[:, 2:3] + angle, state.x[:, 3:]], axis=1)
        return State(x=x, scenario=Goals(turn(state.scenario.goal)), t=state.t)

    states = [moving(PATH, 3)]
    states += [moved(states[0], a, jnp.array([0.3, -0.4])) for a in (0.5, 2.0, -1.3, np.pi)]
    out = act_all(CONTROLLERS[name](PATH), batch([*states, *states[:2]]))
    np.testing.assert_allclose(out, jnp.broadcast_to(out[:1], out.shape), atol=2e-4)


@every_law
def test_actions_are_bounded_and_finite_everywhere(name):
    state = PATH.reset(KEY)
    there = jax.vmap(PATH.dynamics.rest)(state.scenario.goal, jnp.linspace(-3, 3, 5))
    at_goal = eqx.tree_at(lambda s: s.x, state, there)
    far = eqx.tree_at(lambda s: s.x, moving(PATH), 1e3 * moving(PATH, 2).x)
    wild = [moving(PATH, s) for s in range(4)]
    out = np.asarray(act_all(CONTROLLERS[name](PATH), batch([at_goal, far, state, *wild])))
    assert np.isfinite(out).all() and (np.abs(out) <= 1).all()
    if name in ("gradient-consensus", "tree-pursuit"):
        assert (out[0] == 0).all()


@every_law
def test_proximity_graphs_leave_a_lonely_agent_at_rest(name):
    x = jax.vmap(Unicycle().rest)(jnp.arange(10.0).reshape(5, 2) * 3, jnp.zeros(5))
    lonely = State(x=x, scenario=Goals(jnp.ones((5, 2))), t=jnp.asarray(0))
    action = act(CONTROLLERS[name](DISK), lonely)
    assert np.isfinite(action).all()
    assert (action[1:, 0] == 0).all() and action[0, 0] != 0


@every_law
def test_other_dynamics_are_refused_in_one_sentence(name):
    with pytest.raises(UserError, match="drives Unicycle.* only, not DoubleIntegrator"):
        CONTROLLERS[name](Rendezvous(dynamics=DoubleIntegrator()))
    if name != "tree-pursuit":
        with pytest.raises(UserError, match="drives Unicycle only, not LateUnicycle"):
            CONTROLLERS[name](Rendezvous(dynamics=LateUnicycle()))


def test_the_tree_leads_to_the_nearest_leader():
    def parents(game, state=None):
        return CONTROLLERS["tree-pursuit"](game).parents(state or game.reset(KEY))

    assert parents(PATH)[1:].tolist() == [0, 1, 2, 3]
    assert parents(Rendezvous(agents=5, graph="path", leaders=(0, 4)))[1:4].tolist() == [0, 1, 4]
    line = jnp.array([[0.0, 0], [0.8, 0], [1.6, 0], [2.4, 0], [9.0, 0]])
    x = jax.vmap(Unicycle().rest)(line, jnp.zeros(5))
    assert parents(DISK, State(x=x, scenario=Goals(line), t=jnp.asarray(0)))[1:].tolist() == [
        0,
        1,
        2,
        -1,
    ]


def test_tree_pursuit_solves_the_standard_task():
    game = Rendezvous()
    last = distances(game, CONTROLLERS["tree-pursuit"](game), 500)[-1]
    assert (last <= game.radius).all(axis=1).mean() >= 0.99


def test_tree_pursuit_looks_a_step_ahead_where_inputs_are_late():
    """A leader alone knows all that will happen: it does the same one step later."""
    soon = Rendezvous(agents=1)
    late = Rendezvous(agents=1, dynamics=LateUnicycle())
    on_time, delayed = (distances(g, CONTROLLERS["tree-pursuit"](g), 20) for g in (soon, late))
    np.testing.assert_allclose(delayed[1:], on_time[:-1], atol=1e-3)
    team = Rendezvous(dynamics=LateUnicycle())
    last = distances(team, CONTROLLERS["tree-pursuit"](team), 500)[-1]
    assert (last <= team.radius).all(axis=1).mean() >= 0.99


def test_point_offset_brings_the_offset_points_to_the_goal():
    game = Rendezvous(size=5.0, dt=0.02, horizon=3000, dynamics=Unicycle(limits=(1e3, 1e5)))
    controller = PointOffset(game, offset=0.1, k_p=4.0, k_d=4.0, leader_gain=2.0)
    last = eqx.filter_jit(lambda c, s: rollout(game, c, s, KEY).state.x[-1])(
        controller, start := game.reset(KEY)
    )
    z = game.positions(eqx.tree_at(lambda s: s.x, start, last))
    heading = jax.vmap(game.dynamics.heading)(last)
    np.testing.assert_allclose(z + controller.offset * heading, start.scenario.goal, atol=1e-3)
    distance = np.linalg.norm(z - start.scenario.goal, axis=1)
    np.testing.assert_allclose(distance, controller.offset, atol=1e-3)


def test_lin_francis_maggiore_approaches_slowly():
    game = Rendezvous(horizon=600)
    start, soon, late = distances(game, CONTROLLERS["lin-francis-maggiore"](game), 50)[
        [0, 40, 600]
    ].mean(axis=(1, 2))
    assert late < 0.25 * start and late < soon < start


OWN = """
from marlyap.controllers import AbstractController, TreePursuit
from marlyap.games.planar import AbstractPlanar, Goals

class PD(AbstractController):
    game: AbstractPlanar
    gain: float = 2.0

    def __call__(self, state, key):
        x = state.x
        return (self.gain * (state.scenario.goal - x[:, :2]) - 2.0 * x[:, 2:]) / 5.0

class Unfinished(AbstractController):
    game: AbstractPlanar

class Needy(AbstractController):
    game: AbstractPlanar
    other: float

    def __call__(self, state, key):
        return 0.0 * state.scenario.goal

NotOne = 3
"""


def test_a_controller_in_a_file_is_loaded_and_drives_any_dynamics(tmp_path):
    file = tmp_path / "law.py"
    file.write_text(OWN)
    game = Rendezvous(dynamics=DoubleIntegrator(), leaders=(0, 1, 2), horizon=60)
    assert names_a_controller(f"{file}:PD") and names_a_controller("zero")
    assert not names_a_controller("runs/demo") and not names_a_controller(str(file))
    law = load_controller(f"{file}:PD", game)
    assert isinstance(law, AbstractController) and evaluate(game, law, 20).successes.all()
    assert type(load_controller("tree-pursuit", PATH)) is CONTROLLERS["tree-pursuit"]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("tree-persuit", "no controller is called 'tree-persuit'; did you mean 'tree-pursuit'"),
        ("law.py", "names no class; write .*law.py:Name"),
        ("law.py:Pd", "defines no controller called 'Pd'; write a class Pd"),
        ("law.py:NotOne", "defines no controller called 'NotOne'"),
        ("law.py:Unfinished", "Unfinished cannot be made from a game alone: .*abstract"),
        ("law.py:Needy", "Needy cannot be made from a game alone: .*"),
        ("nowhere.py:PD", "there is no file .*nowhere.py"),
        ("broken.py:PD", "could not be loaded"),
    ],
)
def test_a_controller_that_cannot_be_loaded_is_named(tmp_path, name, says):
    (tmp_path / "law.py").write_text(OWN)
    (tmp_path / "broken.py").write_text("1 / 0")
    word = str(tmp_path / name) if ".py" in name else name
    with pytest.raises(UserError, match=f"^controller: .*{says}"):
        load_controller(word, PATH)


@pytest.mark.parametrize("dynamics", [DoubleIntegrator(), Unicycle()], ids=["integrator", "uni"])
def test_zero_and_uniform_actions(dynamics):
    game = Rendezvous(dynamics=dynamics)
    state = game.reset(KEY)
    assert not np.any(act(load_controller("zero", game), state))
    keys = jax.random.split(KEY, 500)
    drawn = jax.vmap(lambda k: load_controller("uniform", game)(state, k))(keys)
    assert drawn.shape == (500, 3, 2) and np.abs(drawn).max() <= 1
    np.testing.assert_allclose(np.mean(drawn, axis=0), 0, atol=0.15)
    np.testing.assert_allclose(np.var(drawn, axis=0), 1 / 3, atol=0.08)


def test_a_plan_is_replayed_by_the_clock():
    actions = jnp.linspace(-1, 1, 12).reshape(3, 2, 2)
    at = lambda t: act(
        Replayed(actions), State(x=jnp.zeros((2, 5)), scenario=Goals(jnp.zeros((2, 2))), t=t)
    )
    for t, row in ((0, 0), (2, 2), (9, 2)):
        assert (at(jnp.asarray(t)) == actions[row]).all()


def test_optimal_control_asks_for_a_plan():
    with pytest.raises(UserError, match="plans before the episode"):
        OptimalControl(PATH)(PATH.reset(KEY), KEY)


def test_without_casadi_the_mend_is_said(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "casadi", None)
    with pytest.raises(UserError, match=r"marlyap\[optimal-control\]"):
        OptimalControl(PATH).plan(batch([PATH.reset(KEY)]))


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_optimal_plans_end_at_rest_on_the_goal(integrator):
    pytest.importorskip("casadi")
    game = Rendezvous(agents=2, horizon=20, dynamics=Unicycle(integrator=integrator))
    states = batch([game.reset(KEY)])
    actions = OptimalControl(game).plan(states).actions
    assert actions.shape == (1, 20, 2, 2) and np.abs(actions).max() <= 1
    state = game.reset(KEY)
    for action in actions[0]:
        state = step(game, state, jnp.asarray(action))
    assert (game.distance(state) < 0.01).all() and jnp.abs(state.x[:, 3:]).max() < 1e-3


def test_optimal_control_is_evaluated_like_the_others():
    pytest.importorskip("casadi")
    game = Rendezvous(agents=2, horizon=20)
    result = evaluate(game, OptimalControl(game), 3)
    assert result.successes.all() and (result.final < 0.01).all()
