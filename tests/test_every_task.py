"""Laws that every game must obey, whatever its task, graph and dynamics."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.conformance.laws import LAWS, conformance, see
from marlyap.errors import UserError
from marlyap.games.dynamics import DoubleIntegrator, LateUnicycle, SingleIntegrator, Unicycle
from marlyap.games.planar import AbstractPlanar
from marlyap.games.sensing import near
from marlyap.simulation.rollout import Decentralised, Uniform, rollout
from marlyap.tasks import TASKS
from marlyap.tasks.rendezvous import Rendezvous


VARIANTS = {
    "complete": Rendezvous(),
    "path": Rendezvous(agents=5, graph="path", leaders=(0, 3)),
    "ring": Rendezvous(agents=4, graph="ring", leaders=(2,)),
    "star": Rendezvous(agents=4, graph="star", size=2.5, dynamics=DoubleIntegrator()),
    "disk": Rendezvous(agents=4, graph="disk:0.9", headings=True),
    "edges": Rendezvous(agents=4, graph="0-2,2-1,2-3", dynamics=SingleIntegrator((2.0, 0.5))),
    "rk4": Rendezvous(agents=2, headings=True, dynamics=Unicycle((2.0, 3.0), "rk4")),
    "late": Rendezvous(agents=2, graph="path", dynamics=LateUnicycle((2.0, 3.0))),
    "alone": Rendezvous(agents=1),
}
GAMES = VARIANTS | {f"TASKS[{k}]": g for k, g in TASKS.items() if g not in VARIANTS.values()}
PLANAR = {k: g for k, g in GAMES.items() if isinstance(g, AbstractPlanar)}


FAST = {"complete", "path", "disk"}
FAST |= {f"TASKS[{name}]" for name in ("microgrid", "platoon-catchup", "voltage13")}


def each(games):
    """As parameters; those that differ little in kind from a fast one are slow."""
    marks = lambda name: [] if name in FAST else [pytest.mark.slow]
    return [pytest.param(game, id=name, marks=marks(name)) for name, game in games.items()]


every_game = pytest.mark.parametrize("game", each(GAMES))
every_planar_game = pytest.mark.parametrize("game", each(PLANAR))


@eqx.filter_jit
def look(game, states, actions):
    """`see` for a batch; one compilation serves all laws."""
    return jax.vmap(lambda s, a: see(game, s, a))(states, actions)


BATCH = 8


@eqx.filter_jit
def draw(game, key):
    """BATCH states in the middle of an episode, and actions."""

    def one(key):
        k_start, k_x, k_act = jax.random.split(key, 3)
        s = game.reset(k_start)
        x = s.x + 0.5 * jax.random.normal(k_x, s.x.shape)
        action = jax.random.uniform(k_act, (game.agents, game.dynamics.du), minval=-1.0)
        return eqx.tree_at(lambda s: s.x, s, x), action

    return jax.vmap(one)(jax.random.split(key, BATCH))


@eqx.filter_jit
def resets(game, keys):
    return jax.vmap(game.reset)(keys)


@eqx.filter_jit
def target(game, states, key):
    """The same scenes with every agent at rest at its goal, heading anywhere."""
    angle = jax.random.uniform(key, states.scenario.goal.shape[:2], minval=-3.0, maxval=3.0)
    rest = jax.vmap(jax.vmap(game.dynamics.rest))
    return eqx.tree_at(lambda s: s.x, states, rest(states.scenario.goal, angle))


def moved(states, x=None, goal=None):
    new = lambda old, want: old if want is None else jnp.asarray(np.asarray(want, np.float32))
    return eqx.tree_at(
        lambda s: (s.x, s.scenario.goal),
        states,
        (new(states.x, x), new(states.scenario.goal, goal)),
    )


def nudged(states, agent, by, coordinate=slice(None), what="x"):
    """`by` added to some of the coordinates of one agent."""
    value = np.array(states.scenario.goal if what == "goal" else states.x)
    value[:, agent, coordinate] += by
    return moved(states, **{what: value})


@jax.jit
def copies(states, row):
    """One of the states, BATCH times."""
    return jax.tree.map(lambda a: jnp.repeat(a[row][None], BATCH, axis=0), states)


@every_game
def test_the_laws_of_the_library_are_kept(game):
    """Shapes, finiteness, determinism, locality, Assumptions 1 and 2 and more: `check-task`."""
    found = conformance(game)
    assert {f.law: f.faults for f in found if f.faults != ()} == {}
    assert len(found) == 1 + len(LAWS)


@every_game
def test_the_target_set_is_kept_by_the_action_that_holds_it(game):
    """There the errors, the cost and the distance are 0, no rule is broken, and `hold` keeps it."""

    @eqx.filter_jit
    def there(key):
        state = game.at_target(game.reset(key))
        action = game.hold(state)
        after = game.step(state, action)
        size = jnp.max(jnp.abs(state.x), axis=0)
        close = jnp.abs(game.errors(after)) <= 1e-5 * (1 + jnp.max(size))
        zero = [game.errors(state), game.distance(state), game.costs(state, action)]
        round_off = jnp.finfo(state.x.dtype).eps * jnp.max(size)
        return game.success(state), game.failed(state), jnp.all(close), zero, round_off

    for seed in range(4):
        success, failed, close, zero, round_off = there(jax.random.key(seed))
        assert success and not failed and close
        for values in zero:
            np.testing.assert_allclose(values, 0, atol=1e-6 + 2 * round_off)


@every_game
def test_success_ends_at_the_edge(game):
    """Where an agent's miss is above 1 the team has not succeeded; it has where none is."""

    @eqx.filter_jit
    def seen(keys):
        def one(key, far):
            state = game.farther(game.reset(key), far)
            return game.miss(state), game.success(state), game.failed(state)

        return jax.vmap(one)(keys, jnp.geomspace(1e-4, 1.0, 64))

    miss, success, failed = map(np.asarray, seen(jax.random.split(jax.random.key(5), 64)))
    np.testing.assert_array_equal(success, (miss <= 1).all(axis=1) & ~failed)
    if not isinstance(game, AbstractPlanar):  # whose starts move about the origin, not the goals
        assert success[0] and not success[-1]


@every_planar_game
def test_the_target_set_is_an_equilibrium_without_cost(game):
    """t10, first half: there the cost and the errors are 0 exactly, and stay so."""
    states, actions = draw(game, jax.random.key(1))
    there = target(game, states, jax.random.key(2))
    out = look(game, there, 0 * actions)
    assert np.all(out["success"])
    for name in ("costs", "errors", "distance", "rewards"):
        assert not np.any(np.asarray(out[name])), name
    np.testing.assert_array_equal(out["next"].x, there.x)
    np.testing.assert_array_equal(out["next"].scenario.goal, there.scenario.goal)


@every_planar_game
def test_errors_are_zero_nowhere_else(game):
    """Moving any one agent a little in any but its heading shows in its errors, and only there."""
    states, actions = draw(game, jax.random.key(3))
    there = target(game, states, jax.random.key(2))
    for i in range(game.agents):
        for k, name in enumerate(game.dynamics.names):
            errors = look(game, nudged(there, i, 1e-3, k), actions)["errors"]
            changed = np.any(np.asarray(errors) != 0, axis=2)
            want = (np.arange(game.agents) == i) & (name != "psi")
            np.testing.assert_array_equal(changed, np.broadcast_to(want, changed.shape))


@every_planar_game
def test_success_is_all_agents_within_the_radius(game):
    states, actions = draw(game, jax.random.key(4))
    there = target(game, states, jax.random.key(2))
    for i in range(game.agents):
        shift = lambda d, i=i: nudged(there, i, d * game.radius, 1)
        near_by, off = look(game, shift(0.95), actions), look(game, shift(1.05), actions)
        assert np.all(near_by["success"]) and not np.any(off["success"])
        np.testing.assert_allclose(off["distance"][:, i], 1.05 * game.radius, rtol=1e-3)


@every_planar_game
def test_observations_are_local(game):
    """t5: row i changes with agent j exactly if they are linked, to the last bit (section 2.9)."""
    states, actions = draw(game, jax.random.key(5))
    kinds = set()
    for row in range(BATCH):
        base = copies(states, row)
        before = look(game, base, actions)
        for j in range(game.agents):
            after = look(game, nudged(base, j, 1e-3), actions)
            linked = np.asarray(before["linked"][0])
            if np.any(linked != np.asarray(after["linked"][0])):  # someone left the disk
                continue
            changed = np.any(np.asarray(after["obs"] != before["obs"])[0], axis=1)
            want = linked[:, j] | (np.arange(game.agents) == j)
            np.testing.assert_array_equal(changed, want)
            kinds |= set(linked[:, j][np.arange(game.agents) != j])
    sparse = {"path", "ring", "star", "edges", "disk:0.9"}
    if game.agents > 3 and (game.graph in sparse or "," in game.graph):
        assert kinds == {True, False}


@every_planar_game
def test_only_leaders_see_their_goal(game):
    states, actions = draw(game, jax.random.key(6))
    before = look(game, states, actions)["obs"]
    for j in range(game.agents):
        obs = look(game, nudged(states, j, 0.2, what="goal"), actions)["obs"]
        changed = np.any(np.asarray(obs != before), axis=2)
        want = (np.arange(game.agents) == j) & (j in game.leaders)
        np.testing.assert_array_equal(changed, np.broadcast_to(want, changed.shape))


def carried(game, states, angle, shift):
    """The whole scene turned about the origin and shifted, goals included."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    names = game.dynamics.names
    x = np.array(states.x, np.float64)
    for pair in (("x", "y"), ("vx", "vy")):
        if set(pair) <= set(names):
            k = [names.index(name) for name in pair]
            x[..., k] = x[..., k] @ turn.T
    if "psi" in names:
        x[..., names.index("psi")] += angle
    x[..., :2] += shift
    return moved(states, x, np.array(states.scenario.goal, np.float64) @ turn.T + shift)


@every_planar_game
def test_no_compass_and_no_map(game):
    """t6: a turn and a shift of the whole scene change nothing, and the motion follows.

    The frame of the integrators is that of the world: for them, shifts only.
    """
    states, actions = draw(game, jax.random.key(7))
    angle = 1.1 if "psi" in game.dynamics.names else 0.0
    shift = np.array([0.7, -1.9])
    here = look(game, states, actions)
    there = look(game, carried(game, states, angle, shift), actions)
    for name in ("obs", "errors", "costs", "rewards", "distance"):
        np.testing.assert_allclose(there[name], here[name], atol=5e-5, err_msg=name)
    np.testing.assert_allclose(
        there["next"].x, carried(game, here["next"], angle, shift).x, atol=2e-5
    )
    # A shift alone also leaves what the critic sees.
    features = look(game, carried(game, states, 0.0, shift), actions)["features"]
    np.testing.assert_allclose(features, here["features"], atol=5e-5)


def expected_view(game, x, goal, linked):
    """What each agent sees, in NumPy: own rates, goal, then slots of neighbours."""

    def magnified(v):
        return v / (np.linalg.norm(v) + game.radius)

    unicycle = "psi" in game.dynamics.names
    rows = []
    for i in range(game.agents):
        psi = x[i, 2] if unicycle else 0.0
        back = np.array([[np.cos(psi), np.sin(psi)], [-np.sin(psi), np.cos(psi)]])
        rates = x[i, 3:] if unicycle else x[i, 2:]
        to_goal = back @ (goal[i] - x[i, :2]) if i in game.leaders else np.zeros(2)
        row = [*rates, float(i in game.leaders), *to_goal, *magnified(to_goal)]
        slots = [j for j in range(game.agents) if game.adjacency[i, j]]
        width = 1 + 2 + 2 + 2 + 2 * game.headings
        for j in slots:
            gap = back @ (x[j, :2] - x[i, :2])
            h = np.array([np.cos(x[j, 2]), np.sin(x[j, 2])]) if unicycle else np.array([1.0, 0])
            v = x[j, 3] * h if unicycle else (x[j, 2:] if x.shape[1] == 4 else np.zeros(2))
            seen = [1.0, *gap, *magnified(gap), *(back @ v)]
            if game.headings:
                seen += [*(back @ h)]
            row += seen if linked[i, j] else [0.0] * width
        most = max(game.adjacency.sum(1))
        rows.append(row + [0.0] * (width * (most - len(slots))))
    return np.array(rows)


@pytest.mark.parametrize("game", VARIANTS.values(), ids=VARIANTS)
def test_the_view_is_what_the_docstring_says(game):
    """Also that empty slots, and slots of neighbours out of reach, are all zero."""
    states, actions = draw(game, jax.random.key(8))
    out = look(game, states, actions)
    for s in range(BATCH):
        x, goal = np.asarray(states.x[s], float), np.asarray(states.scenario.goal[s], float)
        linked = game.adjacency
        if game.graph.startswith("disk:"):
            gap = np.linalg.norm(x[:, None, :2] - x[None, :, :2], axis=2)
            linked = linked & (gap <= float(game.graph[5:]))
        np.testing.assert_array_equal(out["linked"][s], linked)
        np.testing.assert_allclose(
            out["obs"][s], expected_view(game, x, goal, linked), rtol=2e-4, atol=2e-6
        )


def test_a_disk_links_and_parts():
    states, actions = draw(VARIANTS["disk"], jax.random.key(8))
    linked = np.asarray(look(VARIANTS["disk"], states, actions)["linked"])
    pairs = linked[:, *np.triu_indices(4, 1)]
    assert 0.1 < pairs.mean() < 0.9


def test_near_magnifies():
    v = jnp.asarray([[0.0, 0.0], [0.003, 0.004], [30.0, 40.0]])
    np.testing.assert_array_equal(near(v, 0.1)[0], [0, 0])
    np.testing.assert_allclose(near(v, 0.1)[1], [0.003 / 0.105, 0.004 / 0.105], rtol=1e-5)
    np.testing.assert_allclose(near(v, 0.1)[2], [0.6, 0.8], rtol=1e-2)
    assert np.isfinite(jax.jacobian(lambda v: near(v, 0.1))(jnp.zeros(2))).all()


@every_planar_game
def test_episodes_start_at_rest_in_the_box_and_differ(game):
    keys = jax.random.split(jax.random.key(9), 64)
    s, again = resets(game, keys), resets(game, keys)
    np.testing.assert_array_equal(s.x, again.x)
    np.testing.assert_array_equal(s.scenario.goal, again.scenario.goal)
    x, goal = np.asarray(s.x), np.asarray(s.scenario.goal)
    for first in (x[:, 0, 0], x[:, -1, 1], goal[:, 0, 0], goal[:, 0, 1]):
        assert len(np.unique(first)) == 64
    if game.agents > 1:
        assert not np.any(x[:, 0, :2] == x[:, 1, :2])
    p = np.asarray(s.x)[..., :2]
    assert np.all(np.abs(p) <= game.size)
    assert p.min() < -0.9 * game.size and p.max() > 0.9 * game.size
    if isinstance(game, Rendezvous):
        assert np.all(np.abs(goal) <= game.size) and np.ptp(goal) > 1.8 * game.size
        assert np.all(goal == goal[:, :1])
    if "psi" in game.dynamics.names:
        psi = x[..., 2]
        assert np.all(np.abs(psi) <= np.pi + 1e-6) and np.ptp(psi) > 5
    assert not np.any(s.t) and not np.any(x[..., 3 if "psi" in game.dynamics.names else 2 :])


def test_a_formation_has_its_places_on_a_circle():
    game = TASKS["formation"]
    goal = np.asarray(resets(game, jax.random.split(jax.random.key(3), 16)).scenario.goal)
    gap = goal - goal.mean(1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(gap, axis=2), game.spread, rtol=1e-4)
    side = np.linalg.norm(goal[:, 0] - goal[:, 1], axis=1)
    np.testing.assert_allclose(side, 2 * game.spread * np.sin(np.pi / game.agents), rtol=1e-4)
    assert np.ptp(np.arctan2(*gap[:, 0].T)) > 3  # turned anew each time


def test_the_rollout_is_the_loop_written_out():
    game = replace(VARIANTS["path"], horizon=7)
    controller = Decentralised(Uniform(game.dynamics.du), game)
    start = game.reset(jax.random.key(0))
    run = eqx.filter_jit(rollout)
    seen = run(game, controller, start, jax.random.key(1))
    assert seen.action.shape == (7, 5, 2) and seen.state.x.shape == (8, 5, 5)
    assert np.all(np.abs(seen.action) <= 1) and np.ptp(seen.action) > 1.5
    before = jax.tree.map(lambda a: a[:-1], seen.state)
    steps = eqx.filter_jit(jax.vmap(lambda s, a: (game.step(s, a), game.costs(s, a))))
    after, costs = steps(before, seen.action)
    np.testing.assert_array_equal(seen.state.x[0], start.x)
    np.testing.assert_allclose(seen.state.x[1:], after.x, atol=1e-6)
    np.testing.assert_allclose(seen.cost, costs, atol=1e-6)
    np.testing.assert_array_equal(seen.state.t, np.arange(8))
    np.testing.assert_array_equal(seen.reward, -seen.cost)
    assert not np.any(seen.terminated)


class Ending(Rendezvous):
    """It ends two steps after the start."""

    def terminated(self, state):
        return state.t >= 2


def test_a_game_that_has_ended_stands_still():
    game = Ending(agents=2, horizon=5)
    start = game.reset(jax.random.key(0))
    controller = Decentralised(Uniform(2), game)
    seen = eqx.filter_jit(rollout)(game, controller, start, jax.random.key(1))
    np.testing.assert_array_equal(seen.terminated, [False, True, True, True, True])
    np.testing.assert_array_equal(seen.state.t, [0, 1, 2, 2, 2, 2])
    x = np.asarray(seen.state.x)
    assert np.all(x[2:] == x[2]) and np.all(np.any(x[1] != x[2], axis=1))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("agents", 0), ("agents", 4097), ("leaders", ()), ("leaders", (3,)), ("leaders", (-1,)),
        ("leaders", (0, 0)), ("graph", "blob"), ("graph", "0-1"), ("radius", 0.0),
        ("radius", float("nan")), ("size", -1.0), ("dt", 0.0), ("dt", 11.0),
        ("dt", float("nan")), ("horizon", 0),
    ],
)  # fmt: skip
def test_bad_fields_are_named(field, value):
    with pytest.raises(UserError, match=f"^{field}: "):
        Rendezvous(**{field: value})
