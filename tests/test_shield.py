"""The credit shield: its lemmas state by state, its theorem in rollouts, and its way into runs."""

import json
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.certificates import CERTIFICATES
from marlyap.certificates.certify import certify, save
from marlyap.certificates.loop import ClosedLoop, seen_through
from marlyap.certificates.shielded import faults, inexact
from marlyap.controllers import PointPursuit, TreePursuit
from marlyap.controllers.predicting import Predicting
from marlyap.errors import UserError
from marlyap.games.dynamics import DoubleIntegrator, SingleIntegrator, Unicycle
from marlyap.games.perturbed import Perturbed
from marlyap.games.wrapper import plain_game
from marlyap.learning.algorithms import MASAC
from marlyap.learning.schedule import Schedule
from marlyap.learning.source import shape
from marlyap.learning.trainer import Trainer
from marlyap.nets.nets import Actors, Greedy
from marlyap.recheck import Rejected, recheck
from marlyap.runs.run import Run
from marlyap.runs.subject import asked, subject
from marlyap.shields import Shield, Shielded, split
from marlyap.simulation.rollout import Decentralised, rollout
from marlyap.tasks import TASKS
from marlyap.tasks.formation import Formation
from marlyap.tasks.formation_di import DisplacementFormation
from marlyap.tasks.rendezvous import Rendezvous
from marlyap.tasks.runaway import Runaway
from tests.conftest import same


GAMES = {
    "unicycles": Rendezvous(),
    "double": Rendezvous(dynamics=DoubleIntegrator()),
    "single": Rendezvous(dynamics=SingleIntegrator()),
    "unstable": Runaway(),
}
each_game = pytest.mark.parametrize("name", GAMES)


def disturbed(game, **change):
    return Perturbed(inner=game, **change)


def some_states(game, count, key=0):
    """Starts with rates, as in the middle of an episode; memories begin there."""
    k_start, k_rates = jax.random.split(jax.random.key(key))
    rates = jnp.array(game.dynamics.blocks[0])

    def one(key, noise):
        start = plain_game(game).reset(key)
        return game.begun(eqx.tree_at(lambda s: s.x, start, start.x.at[:, rates].add(noise)))

    noise = 0.8 * jax.random.normal(k_rates, (count, game.agents, len(rates)))
    return jax.jit(jax.vmap(one))(jax.random.split(k_start, count), noise)


@each_game
def test_along_the_base_law_the_plan_falls_by_what_a_step_costs(name):
    """Lemma 1, and t1 of the specification: J(f(x, kappa)) = J(x) - c(x) where the plan arrives."""
    plan = Shield().plan(GAMES[name])
    k_x, k_q = jax.random.split(jax.random.key(1))
    n = 2_000
    x = jax.random.normal(k_x, (n, plan.game.dynamics.dx))
    q = jax.random.uniform(k_q, (n, 2), minval=-1.0)

    @jax.jit
    @jax.vmap
    def off(x, q):
        now, then = plan.worth(x, q), plan.worth(plan.after(x, plan.law(x, q)), q)
        return now.cost - plan.cost(x, q) - then.cost, now.steps, then.steps, now.cost

    error, now, then, cost = map(np.asarray, off(x, q))
    arrives = now <= plan.steps
    assert arrives.mean() > 0.8  # some unstable ones are lost already
    assert np.abs(error[arrives]).max() < 1e-4 * cost[arrives].max()
    assert (then[arrives] == np.maximum(now[arrives] - 1, 0)).all()


@each_game
def test_an_agent_in_the_terminal_set_rests_after_one_step_where_it_is(name):
    """Lemma 0, and t2."""
    plan = Shield(rho=0.02).plan(GAMES[name])
    rng, dx, n = np.random.default_rng(0), plan.game.dynamics.dx, 2_000
    x = jnp.asarray(rng.normal(size=(n, dx)) * 0.25, jnp.float32)
    q = x[:, :2] + jnp.asarray(rng.uniform(-0.012, 0.012, (n, 2)), jnp.float32)

    @jax.jit
    @jax.vmap
    def stop(x, q):
        after = plan.after(x, plan.law(x, q))
        d = plan.game.dynamics
        return plan.arrived(x, q), plan.arrived(after, q), d.rates(after), after[:2] - x[:2]

    there, still_there, rates, gone = map(np.asarray, stop(x, q))
    assert there.sum() > 100
    assert still_there[there].all()
    assert np.abs(rates[there]).max(initial=0.0) < 1e-7  # exact but for rounding
    assert np.abs(gone[there]).max() < 1e-8


def test_the_base_law_as_a_proposal_is_always_admitted_and_earns_nothing():
    """t7: outside the terminal set the actions are tree pursuit's, and the credit stays."""
    game = Shielded(Rendezvous(graph="path"), Shield(steps=80))
    act = TreePursuit(game)

    @eqx.filter_jit
    @jax.vmap
    def decide(s):
        a = act(s, jax.random.key(0))
        d = game.decide(s, a)
        return a, d.action, d.outside, d.admitted, d.credit, s.memory["credit"], d.before.steps

    a, b, outside, admitted, after, before, steps = map(np.asarray, decide(some_states(game, 300)))
    assert (outside.mean() > 0.95) and (admitted[outside & (steps <= 80)]).all()
    np.testing.assert_allclose(a[outside], b[outside], atol=1e-6)
    np.testing.assert_allclose(after, np.minimum(before, after), atol=1e-6)
    np.testing.assert_allclose(after[admitted], before[admitted], rtol=0.5)


def test_admission_depends_on_nobody_but_the_parent():
    """t5: moving an agent that is no parent changes no decision about the same proposal."""
    game = Shielded(Rendezvous(agents=4, graph="path"), Shield(steps=40))
    states = some_states(game, 64)
    action = jax.random.uniform(jax.random.key(2), (64, 4, 2), minval=-1.0)
    decide = eqx.filter_jit(jax.vmap(game.decide))
    moved = eqx.tree_at(lambda s: s.x, states, states.x.at[:, 3].add(0.7))
    one, two = decide(states, action), decide(moved, action)
    for a, b in ((one.admitted, two.admitted), (one.action, two.action), (one.q, two.q)):
        assert (np.asarray(a)[:, :3] == np.asarray(b)[:, :3]).all()
    assert list(game.parents) == [-1, 0, 1, 2]


def test_a_shield_that_is_off_leaves_the_game_as_it_was(game):
    """t6, bit for bit."""
    off = Shielded(game, Shield(on=False))
    act = lambda state, key: jax.random.uniform(key, (3, 2), minval=-1.0)
    roll = eqx.filter_jit(lambda g: rollout(g, act, g.reset(jax.random.key(3)), jax.random.key(4)))
    plain, seen = roll(game), roll(off)
    assert same(plain.state.x, seen.state.x)
    assert same((plain.cost, plain.reward), (seen.cost, seen.reward))
    assert same(game.observations(game.reset(jax.random.key(3))), off.observations(
        off.reset(jax.random.key(3))
    ))  # fmt: skip


def ended(game, act, count, steps, key=0):
    """The last states of many episodes, and whether anything moved in their last step."""

    @eqx.filter_jit
    @jax.vmap
    def one(key):
        k_start, k_act = jax.random.split(key)
        seen = rollout(game, act, game.reset(k_start), k_act, steps)
        last = jax.tree.map(lambda x: x[-1], seen.state)
        gone = jnp.abs(seen.state.x[-1] - seen.state.x[-2])
        return last, game.distance(last), jnp.max(gone)

    return one(jax.random.split(jax.random.key(key), count))


def at_random(game):
    return lambda s, k: jax.random.uniform(k, (game.agents, game.du), minval=-1.0)


def rested(game, last, off, gone):
    """Theorem 2: rest, within (hops + 1) rho; and what a leader paid, over (1 + sigma) J_0."""
    assert float(gone.max()) == 0
    assert (np.asarray(off) <= (np.asarray(game.hops) + 1) * game.shield.rho + 1e-5).all()
    m = last.memory
    bound = (1 + game.shield.sigma) * m["first"][:, 0]
    assert float(jnp.max(m["paid"][:, 0] / jnp.maximum(bound, 1e-9))) <= 1 + 1e-4
    assert (np.asarray(m["asked"])[:, 0] * game.shield.tau <= np.asarray(bound) + 1e-3).all()


def test_a_random_policy_comes_to_rest_behind_the_shield():
    """t3, few starts; the two followers lose half of their messages."""
    game = Shielded(disturbed(Rendezvous(), drop=0.5), Shield(steps=45))
    rested(game, *ended(game, at_random(game), 12, 120))


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.0, 0.25])
@pytest.mark.parametrize("name", [n for n in GAMES if n != "single"])
def test_ill_policies_come_to_rest_behind_the_shield(name, sigma, full_compilation):
    """t3 and t4: random, full throttle, and away from the target."""
    game = Shielded(GAMES[name], Shield(sigma=sigma, steps=80))
    away = lambda s, k: -jnp.sign(game.goals(s) - s.x[:, :2])
    for act in (at_random(game), lambda s, k: jnp.ones((3, 2)), away):
        rested(game, *ended(game, act, 200, 400))


@pytest.mark.slow
@pytest.mark.parametrize("window", [0, 30])
def test_a_path_of_eight_comes_to_rest_although_messages_are_lost(window, full_compilation):
    """t3 and t8."""
    inner = disturbed(Rendezvous(agents=8, graph="path"), drop=0.5 if window == 0 else 0.0)
    game = Shielded(inner, Shield(window=window))
    rested(game, *ended(game, at_random(game), 40, 600))


def test_a_prediction_undoes_a_known_delay():
    """One step late, every agent by itself moves as it would have without the delay."""
    game = Rendezvous(agents=1)
    late = disturbed(game, delay=1)
    start = game.reset(jax.random.key(0))
    act = Predicting(TreePursuit(late), late)
    roll = eqx.filter_jit(lambda g, a, s: rollout(g, a, s, jax.random.key(1), 12).state.x)
    now = roll(game, TreePursuit(game), start)
    x = roll(late, act, late.reset(jax.random.key(0)))
    np.testing.assert_allclose(x[2:], now[1:-1], atol=1e-5)


def test_a_shield_plans_from_where_its_inputs_under_way_lead():
    game = Shielded(disturbed(Rendezvous(), delay=2), Shield(steps=10))
    s = some_states(Shielded(Rendezvous(), Shield(steps=10)), 1)
    inside = jax.tree.map(lambda x: x[0], s)
    start = game.reset(jax.random.key(0))
    start = eqx.tree_at(lambda t: t.x, start, inside.x)
    queue = jnp.full((2, 3, 2), 0.3)
    start = eqx.tree_at(lambda t: t.memory["inner"]["queue"], start, queue)
    plain = Rendezvous()
    after = plain.step(plain.step(State_of(start), queue[0]), queue[1])
    np.testing.assert_allclose(game._foreseen(game.inside(start)), after.x, atol=1e-6)


def State_of(state):
    """The state without memory."""
    return replace(state, memory=None)


def test_what_a_shield_cannot_do_is_one_sentence():
    for make, word in (
        (lambda: Shielded(Rendezvous(graph="disk:1")), "disk"),
        (lambda: Shielded(Formation()), "displacements"),
        (lambda: Shielded(Rendezvous(dynamics=Unicycle((5.0, 5.0), "rk4"))), "integrator"),
        (lambda: Shielded(TASKS["cartpoles"]), "no base law"),
        (lambda: Shielded(TASKS["rendezvous-late"]), "LateUnicycle"),
        (lambda: Shield(rho=0.0), "rho"),
        (lambda: Shield(steps=0), "steps"),
        (lambda: asked("rendezvous", {"shield.sigma": "0"}), "add --shield"),
        (lambda: asked("flock", {}, shield=True), "no base law"),
        (lambda: CERTIFICATES["shielded"].refuse(a_loop(Rendezvous())), "no shield"),
    ):
        with pytest.raises(UserError, match=word):
            make()


def a_loop(game):
    return ClosedLoop(game, TreePursuit(game))


def test_what_is_disturbed_lies_beneath_the_shield():
    game = Shielded(Rendezvous())
    loop = ClosedLoop(game, TreePursuit(game)).under(gain=2.0)
    assert isinstance(loop.game, Shielded) and isinstance(loop.game.inner, Perturbed)
    assert float(loop.game.plant.limits[0]) == 10
    assert loop.game.plan.game == Rendezvous()  # it plans with the motors that it knows
    assert seen_through(loop.game, TreePursuit(Rendezvous())).game.agents == 3


def test_a_run_that_was_trained_behind_a_shield_remembers_it(tmp_path):
    shield = Shield(action="residual", sigma=0.5)
    trainer = Trainer(Shielded(Rendezvous(), shield), MASAC(), Schedule(steps=1))
    names = {"task": "rendezvous", "algorithm": "masac", "preset": "tuned"}
    Run.create(tmp_path / "run", trainer, 0, names)
    run, game = subject(tmp_path / "run")
    assert game == run.game == trainer.game
    other = subject(tmp_path / "run", "rendezvous-path5", overrides={"shield.sigma": "0"})[1]
    assert split(other) == (TASKS["rendezvous-path5"], replace(shield, sigma=0.0))
    bigger = subject(tmp_path / "run", overrides={"task.size": "2"})[1]
    assert split(bigger) == (Rendezvous(size=2.0), shield)


def test_a_certificate_names_the_conditions_that_fail():
    game = Shielded(Rendezvous(), Shield(steps=30))
    none = {"goals": np.zeros(1), "late": np.zeros(1)}
    well = {"model": 0.0, "stops": 0.0, "sums": 0.0}
    assert faults(game, well, none) == []
    ill = faults(
        game, {"model": 1.0, "stops": 1.0, "sums": 1.0}, {k: v + 1 for k, v in none.items()}
    )
    assert [text.partition(":")[0] for text in ill] == [
        "model", "terminal set", "sums", "goals", "plans",
    ]  # fmt: skip
    alone = Shielded(disturbed(Rendezvous(graph="path"), cut=((0, 1),)), Shield(steps=30))
    assert "tree" in faults(alone, well, none)[0]


@pytest.mark.slow
def test_a_certificate_tests_the_model_that_is_planned_with(full_compilation):
    game = Shielded(Rendezvous(), Shield(steps=60))
    assert max(float(x) for x in inexact(game, jax.random.key(0)).values()) < 1e-3
    strong = game.beneath(lambda g: disturbed(g, gain=1.1))
    assert float(inexact(strong, jax.random.key(0))["model"]) > 0.01


@pytest.mark.slow
def test_a_shielded_team_is_certified_whatever_its_policy(full_compilation):
    game = Shielded(Rendezvous())
    verdict = replace(CERTIFICATES["shielded"], rollouts=20).check(
        ClosedLoop(game, at_random(game)), 0
    )
    assert verdict.holds and verdict.evidence == "observed" and "by construction" in verdict.claim
    assert verdict.figures["steps_of_a_leader"] <= verdict.bound
    assert verdict.figures["paid_over_bound"] <= 1 + 1e-4
    weak = game.beneath(lambda g: disturbed(g, gain=0.8))
    verdict = replace(CERTIFICATES["shielded"], rollouts=5).check(
        ClosedLoop(weak, at_random(weak)), 0
    )
    assert not verdict.holds and "model" in verdict.claim


def test_pushes_and_jumps_come_every_so_often_and_at_no_other_time():
    plain = Rendezvous()
    game = disturbed(plain, push=2.0, jump=3.0, every=4)
    act = jnp.zeros((3, 2))
    step = eqx.filter_jit(game.step)
    s = game.reset(jax.random.key(0))
    for t in range(9):
        before, s = s, step(s, act)
        struck = t > 0 and t % 4 == 0
        moved = np.abs(np.asarray(s.x[:, 3:] - before.x[:, 3:]))
        assert np.allclose(moved, 2.0 if struck else 0.0)
        assert struck == (not np.allclose(s.scenario.goal, before.scenario.goal))
    goal = np.asarray(s.scenario.goal)
    assert (np.abs(goal) <= 3).all() and np.ptp(goal, axis=0).max() < 1e-5
    with pytest.raises(UserError, match="cannot be pushed"):
        cart = disturbed(TASKS["cartpoles"], push=1.0)
        jax.eval_shape(cart.step, cart.reset(jax.random.key(0)), jnp.zeros((5, 1)))


def test_unstable_agents_are_held_by_their_pursuit_and_lost_without_it():
    game = Runaway(horizon=80)
    start = game.farther(game.reset(jax.random.key(0)), 4.0)
    run = eqx.filter_jit(lambda act: rollout(game, act, start, jax.random.key(0)))
    held = run(PointPursuit(game))
    assert not bool(held.failed[-1])
    assert float(jnp.max(game.distance(jax.tree.map(lambda x: x[-1], held.state)))) < 0.1
    rushed = rollout(
        game, lambda s, k: jnp.sign(game.goals(s) - s.x[:, :2]), start, jax.random.key(0)
    )
    assert bool(rushed.failed[-1]) and float(rushed.cost[-1].min()) == game.failure_cost


def test_a_point_drives_to_its_place_in_a_formation():
    game = DisplacementFormation()
    start = game.reset(jax.random.key(0))
    seen = eqx.filter_jit(rollout)(game, PointPursuit(game), start, jax.random.key(0), 40)
    assert float(jnp.max(game.distance(jax.tree.map(lambda x: x[-1], seen.state)))) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("graph", ["complete", "path"])
def test_recheck_derives_the_certificate_without_jax(tmp_path, graph, full_compilation):
    """And rejects one in which the shield had admitted more, or the bound were lower."""
    game = Shielded(Rendezvous(graph=graph), Shield(action="residual"))
    pi = Actors(shape(game), 16, False, key=jax.random.key(1))
    controller = Decentralised(Greedy(pi), game)
    chosen = {"shielded": replace(CERTIFICATES["shielded"], rollouts=20)}
    result = certify(game, controller, chosen, 0, 0.99)
    assert result["holds"]
    save(tmp_path / "good", result, game, controller)
    found = recheck(tmp_path / "good")
    assert found["agrees"] and found["rechecked"]["shielded"]["successes"] == 20
    for part, value in (("bound", 50.0), ("claim", "it never moves"), ("holds", False)):
        told = json.loads(json.dumps(result))
        told["verdicts"]["shielded"][part] = value
        told["holds"] = told["verdicts"]["shielded"]["holds"]
        save(tmp_path / part, told, game, controller)
        with pytest.raises(Rejected):
            recheck(tmp_path / part)
