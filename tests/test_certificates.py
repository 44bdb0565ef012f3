"""Certificates on games whose answer is known: they accept the stable and refuse the rest."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.certificates import CERTIFICATES, bounds, quantiles
from marlyap.certificates.basin import Basin, largest_level
from marlyap.certificates.certificate import (
    AbstractCertificate,
    Verdict,
    failures_allowed,
    percent,
    sentence,
    start_of,
)
from marlyap.certificates.certify import certify, save
from marlyap.certificates.closed_form import ClosedForm
from marlyap.certificates.composition import Composition, fit_row
from marlyap.certificates.contraction import Contraction
from marlyap.certificates.decrease import Decrease
from marlyap.certificates.information import information
from marlyap.certificates.linearisation import Linearisation
from marlyap.certificates.loop import ClosedLoop
from marlyap.certificates.lyapunov import Approach, CostSum, Norm, Quadratic, cost_sum
from marlyap.certificates.proof import Loop, Proof, extents, halves, lyapunov
from marlyap.certificates.quantiles import Quantiles
from marlyap.certificates.reach import Reach, ReachAndStay
from marlyap.certificates.robustness import Robustness
from marlyap.certificates.safety import Apart, Safe
from marlyap.certificates.theorem1 import Theorem1, input_jacobian, l_f
from marlyap.controllers.point_offset import PointOffset
from marlyap.errors import UserError
from marlyap.games.dynamics import AbstractDynamics, DoubleIntegrator, SingleIntegrator, Unicycle
from marlyap.games.perturbed import Perturbed
from marlyap.games.planar import AbstractPlanar, Goals
from marlyap.nets.nets import Actors, Greedy, NormNet, Shape
from marlyap.simulation.rollout import Decentralised
from marlyap.statistics import lower_bound
from marlyap.storage.hashing import policy_hash
from marlyap.tasks.formation import Formation
from marlyap.tasks.rendezvous import Rendezvous
from marlyap.types import State


class Flow(AbstractPlanar):
    """One point in the plane, s_{t+1} = A s_t + cubic (s_t)^3 in its first coordinate."""

    A: jax.Array
    cubic: jax.Array
    agents: int = 1
    leaders: tuple[int, ...] = (0,)
    graph: str = "complete"
    radius: float = 0.1
    dt: float = 0.1
    horizon: int = 40
    dynamics: AbstractDynamics = SingleIntegrator()

    def reset(self, key):
        x = jax.random.uniform(key, (1, 2), minval=-2.0, maxval=2.0)
        return State(x=x, scenario=Goals(jnp.zeros((1, 2))), t=jnp.asarray(0))

    def observe(self, state, links):
        return state.x

    def step(self, state, action):
        x = state.x @ self.A.T + self.cubic * state.x**3 * jnp.array([[1.0, 0.0]])
        return State(x=x, scenario=state.scenario, t=state.t + 1)


class Idle(eqx.Module):
    def __call__(self, state, key):
        return jnp.zeros((1, 2))


class Scripted(eqx.Module):
    """Drive to the goal; from step `leave` on drive away; or circle; or break on some starts."""

    leave: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(10**6))
    spin: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(0.0))
    broken: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(0.0))

    def __call__(self, state, key):
        to_goal = state.scenario.goal - state.x
        action = jnp.where(state.t >= self.leave, -to_goal - 0.3, 4.0 * to_goal)
        turned = jnp.stack([-to_goal[:, 1], to_goal[:, 0]], axis=1)
        action = jnp.where(self.spin > 0, turned, action)
        return jnp.where(state.scenario.goal[0, 0] > 1 - 2 * self.broken, jnp.nan, action)


N = 600
TABLE = {
    "reach": Reach(rollouts=N, share=0.95),
    "reach-and-stay": ReachAndStay(rollouts=N, share=0.95),
    "decrease": Decrease(rollouts=N, share=0.95),
    "contraction": Contraction(rollouts=N, calibration=N, share=0.95),
    "basin": Basin(rollouts=N, calibration=N, share=0.95),
    "quantiles": Quantiles(rollouts=N),
}
POINT = Rendezvous(agents=1, dynamics=SingleIntegrator(limits=(2.0, 2.0)))


def flow(A, cubic=0.0):
    return Flow(jnp.asarray(A), jnp.asarray(cubic))


def holding(result):
    return {name for name, v in result["verdicts"].items() if v["holds"]}


def certified(game, controller, table=TABLE, **options):
    return certify(game, controller, table, seed=3, confidence=0.99, **options)


def test_the_table_is_complete():
    assert set(CERTIFICATES) >= set(TABLE)
    assert all(isinstance(c, AbstractCertificate) for c in CERTIFICATES.values())


def test_a_stable_linear_game_is_accepted():
    result = certified(flow([[0.8, 0.1], [-0.1, 0.8]]), Idle())
    assert holding(result) == set(TABLE)
    assert result["verdicts"]["contraction"]["figures"]["beta"] == pytest.approx(
        1 - (0.8**2 + 0.1**2) ** 10, abs=1e-3
    )
    for verdict in result["verdicts"].values():
        assert verdict["evidence"] == "statistical"
        assert verdict["confidence"] == pytest.approx(1 - 0.01 / 6)


@pytest.mark.parametrize(
    "A",
    [
        [[0.0, 1.0], [-1.0, 0.0]],  # marginal: a rotation
        [[1.0, 0.0], [0.0, 1.0]],  # marginal: nothing moves
        [[0.9, 0.0], [0.0, 1.0]],  # marginal in one direction
        [[1.05, 0.0], [0.0, 0.5]],  # unstable
        [[0.95, 5.0], [0.0, 0.95]],  # stable, but too slow for the horizon
    ],
)
def test_others_are_refused_with_a_counterexample(A):
    game = flow(A)
    result = certified(game, Idle())
    assert holding(result) - {"basin"} == set()
    worst = result["verdicts"]["reach"]["worst"]
    assert worst["failed"]
    start = start_of(game, worst["seed"], worst["purpose"], worst["episode"])
    assert np.allclose(start.x, worst["state"]["x"])
    x = np.asarray(start.x)[0]
    for _ in range(game.horizon):
        x = np.asarray(A) @ x
    assert np.linalg.norm(x) > game.radius


def test_a_basin_lies_inside_the_known_one():
    """s -> 0.9 s + 0.1 s^3 goes to 0 exactly from |s| < 1; the other coordinate always does."""
    game = flow([[0.9, 0.0], [0.0, 0.8]], 0.1)
    table = TABLE | {"basin": Basin(rollouts=3000, calibration=3000, share=0.95)}
    result = certified(game, Idle(), table, V=Quadratic(jnp.eye(2)))
    verdict = result["verdicts"]["basin"]
    assert "reach" not in holding(result) and verdict["holds"]
    assert 0.5 < verdict["figures"]["level"] <= 1.0
    low, high = verdict["figures"]["mass"]
    assert low <= np.pi * verdict["figures"]["level"] / 16 <= high


@pytest.mark.parametrize(
    "controller",
    [
        Scripted(leave=jnp.asarray(33)),  # fails late
        Scripted(leave=jnp.asarray(20)),  # reaches, and leaves
        Scripted(spin=jnp.asarray(1.0)),  # cycles inside the box
    ],
)
def test_pathological_controllers_are_refused(controller):
    result = certified(POINT, controller)
    # C2 and C3 do not look past the first entry of the ball, so that they may hold.
    assert holding(result) <= {"decrease", "contraction"} and not result["holds"]


def test_a_good_controller_passes_and_leaving_after_the_horizon_is_found():
    assert holding(certified(POINT, Scripted())) == set(TABLE)
    late = holding(certified(POINT, Scripted(leave=jnp.asarray(45))))
    assert not late & {"reach-and-stay", "basin"}


def test_one_nan_in_a_thousand_starts_is_not_certified():
    n, share = 12_000, 0.9993
    table = {
        "reach": Reach(n, share),
        "reach-and-stay": ReachAndStay(n, share=share),
        "decrease": Decrease(n, share=share),
        "contraction": Contraction(n, n, share=share),
        "basin": Basin(n, n, share=share),
        "quantiles": Quantiles(n, q=share),
    }
    assert holding(certified(POINT, Scripted(), table)) == set(table)
    result = certified(POINT, Scripted(broken=jnp.asarray(1e-3)), table)
    verdicts = result["verdicts"]
    assert 1 <= verdicts["reach"]["trials"] - verdicts["reach"]["successes"] <= 40
    assert verdicts["reach"]["worst"]["failed"]
    assert holding(result) == set()


class Straying(eqx.Module):
    """Drive to a place beside the goal (m)."""

    off: jax.Array

    def __call__(self, state, key):
        return 4.0 * (state.scenario.goal + jnp.array([[1.0, 0.0]]) * self.off - state.x)


def test_a_ball_is_taken_that_the_controller_keeps():
    ball = lambda off: cost_sum(POINT, Straying(jnp.asarray(off)), jax.random.key(0)).ball
    radius = POINT.radius
    balls = [ball(off * radius) for off in (0.0, 0.9, 1.1, 3.9, 9.0)]
    assert balls == [radius, radius, 2 * radius, 4 * radius, radius]
    beside = Straying(jnp.asarray(1.1 * radius))
    result = certified(POINT, beside)
    assert result["V"]["ball"] == 2 * radius
    claim = result["verdicts"]["decrease"]["claim"]
    assert "V, the sum of the next 20 costs beyond 0.2 m, falls" in claim
    assert not result["verdicts"]["reach"]["holds"]


def test_what_needs_v_is_left_out_by_name_and_the_others_run():
    """Of a controller that leaves the target all that does not speak of V can still be said."""
    away = Straying(jnp.asarray(9 * POINT.radius))
    spoken = {name for name, c in TABLE.items() if c.asks_V}
    assert spoken == {"decrease", "basin", "quantiles"}
    for name in spoken:
        with pytest.raises(UserError, match="certificates that do not ask for one"):
            certified(POINT, away, {name: TABLE[name]})
    result = certified(POINT, away)
    assert {*result["left_out"]} == spoken and {*result["verdicts"]} == {*TABLE} - spoken
    assert all("on the target set" in why for why in result["left_out"].values())
    # The confidence is shared by those that ran, and the left-out ones fail if asked for by name.
    assert result["confidence_each"] == pytest.approx(1 - 0.01 / 3)
    table = {"far": Apart(N, N), **{n: TABLE[n] for n in spoken}}
    team = Rendezvous(agents=2, leaders=(0, 1), dynamics=SingleIntegrator(limits=(2.0, 2.0)))
    table["far"] = dataclasses.replace(table["far"], least=1e-4)
    asked = certified(team, Straying(jnp.asarray(0.9)), table)
    usual = certified(team, Straying(jnp.asarray(0.9)), table, optional=table)
    assert {*asked["verdicts"]} == {"far"} and {*usual["left_out"]} == spoken
    assert not asked["holds"] and usual["holds"] == usual["verdicts"]["far"]["holds"]


def test_bad_input_is_one_sentence():
    few = {"reach": Reach(rollouts=50, share=0.99)}
    with pytest.raises(UserError, match=r"at least \d+ are needed"):
        certified(POINT, Scripted(), few)
    with pytest.raises(UserError, match="on the target set"):
        spoken = {"decrease": TABLE["decrease"]}
        certified(POINT, Scripted(spin=jnp.asarray(1.0)), spoken, V=Shifted())
    with pytest.raises(UserError, match="one row for each agent"):
        certified(POINT, lambda state, key: jnp.zeros(3))
    with pytest.raises(UserError, match="fixed beforehand"):
        certified(POINT, Scripted(), few, policy="0" * 64)
    with pytest.raises(UserError, match="at least one"):
        certified(POINT, Scripted(), {})


class Shifted(Quadratic):
    P: jax.Array = eqx.field(default_factory=lambda: jnp.eye(2))

    def value(self, game, state):
        return jnp.ones(())


def test_the_policy_hash_sees_every_number():
    assert policy_hash(Scripted()) == policy_hash(Scripted())
    assert policy_hash(Scripted()) != policy_hash(Scripted(spin=jnp.asarray(1e-6)))


def test_a_result_is_json_and_repeats(tmp_path):
    table = {"reach": TABLE["reach"]}
    first, second = (certified(POINT, Scripted(), table) for _ in range(2))
    assert json.dumps(first, allow_nan=False) == json.dumps(second, allow_nan=False)
    save(tmp_path / "c", first, POINT, Scripted())
    with pytest.raises(UserError, match="not the one"):
        save(tmp_path / "d", first, POINT, Scripted(spin=jnp.asarray(1.0)))


def test_a_sentence_says_what_was_asked_and_what_was_shown():
    """The claim is true whatever was asked: what fails is the share asked for."""
    verdict = Verdict("reach", "at least 95.22 % of starts arrive", "statistical", False, 0.95229,
                      0.99983, {}, figures={"share_asked": 0.98})  # fmt: skip
    said = "Asked 98 %, shown 95.22 % (confidence 99.98 %): not reached."
    assert sentence(verdict) == f"reach: at least 95.22 % of starts arrive. {said}"
    better = dataclasses.replace(verdict, bound=0.9812, holds=True)
    assert sentence(better).endswith("Asked 98 %, shown 98.12 % (confidence 99.98 %): reached.")
    other = dataclasses.replace(better, holds=False)  # for another reason than the share
    assert sentence(other).endswith("arrive: does not hold.")
    none = dataclasses.replace(better, figures={})
    assert sentence(none) == "reach: at least 95.22 % of starts arrive: holds."
    # 0.98 is shown in full, and what is just below it is not called 98 %.
    assert [percent(x) for x in (0.98, 0.97999, 0.57, 1.0)] == [
        "98.00 %",
        "97.99 %",
        "57.00 %",
        "100.00 %",
    ]
    assert percent(0.12341, up=True) == "12.35 %"


def test_every_claim_says_until_when_and_nothing_of_later():
    claims = {name: v["claim"] for name, v in certified(POINT, Scripted())["verdicts"].items()}
    assert claims["reach"].endswith("% of starts end with every agent within 0.1 m of its goal "
                                    "at 4 s")  # fmt: skip
    assert "until step 80 (8 s)" in claims["reach-and-stay"]
    assert "by step 40 (4 s)" in claims["decrease"]
    assert all("until step 40 (4 s)" in claims[name] for name in ("contraction", "quantiles"))
    assert not any("share" in claim for claim in claims.values())


def test_levels_and_failures_by_hand():
    values = np.array([0.1, 0.5, 0.9, 1.2, np.nan])
    assert largest_level(values, np.array([True, True, False, True, False])) == 0.5
    assert largest_level(values, np.array([False, True, True, True, True])) == -np.inf
    k = failures_allowed(1000, 0.98, 0.99)
    assert lower_bound(1000 - k, 1000, 0.99) >= 0.98 > lower_bound(999 - k, 1000, 0.99)


def test_the_cost_sum_changes_by_the_identity():
    """L(s_{t+1}) - L(s_t) = c(s_{t+T}) - c(s_t)."""
    game, V = POINT, CostSum(Scripted(), T=7, ball=0.0)
    state = game.reset(jax.random.key(1))
    states = [state]
    for _ in range(8):
        states.append(game.step(states[-1], V.controller(states[-1], jax.random.key(0))))
    change = V.value(game, states[1]) - V.value(game, states[0])
    cost = lambda s: V.cost(game, s)
    assert float(change) == pytest.approx(float(cost(states[7]) - cost(states[0])), abs=1e-6)


def test_a_perturbation_changes_what_it_says():
    game = Rendezvous(agents=3, graph="path")
    plain, key = game.reset(jax.random.key(0)), jax.random.key(0)
    action = jnp.full((3, 2), 0.4)
    step = lambda **change: Perturbed(game, **change).step(
        Perturbed(game, **change).reset(key), action
    )
    nominal = game.step(plain, action)
    assert np.array_equal(step().x, nominal.x)
    assert np.allclose(step(gain=2.0).x[:, 3:], 2 * nominal.x[:, 3:])
    assert np.array_equal(step(delay=1).x, plain.x)
    assert not np.allclose(step(noise=0.1).x, nominal.x)
    far = Perturbed(game, spread=2.0).reset(key)
    assert np.allclose(far.x[:, :2], 2 * plain.x[:, :2])
    obs, at = game.observations(plain), Perturbed(game, cut=((1, 2),))
    apart = np.asarray(at.observations(at.reset(key)))
    assert np.array_equal(apart[0], obs[0])
    assert not apart[2][-7:].any() and np.asarray(obs[2]).any()
    lost = Perturbed(game, gone=(2,))
    there = lost.reset(key)
    assert float(lost.distance(there)[2]) == 0.0
    assert not np.asarray(lost.linked(there))[2].any()
    silent = Perturbed(game, drop=1.0)
    assert not np.asarray(silent.linked(silent.reset(key))).any()


def test_robustness_finds_what_breaks():
    table = {"robustness": Robustness(400, (0.5, 1.0), (), (0,), spreads=(1.0,), share=0.9)}
    verdict = certified(POINT, Scripted(), table)["verdicts"]["robustness"]
    assert verdict["holds"] and len(verdict["figures"]["curve"]) == 4
    table = {"robustness": Robustness(400, (0.01,), (), (), spreads=(), share=0.9)}
    verdict = certified(POINT, Scripted(), table)["verdicts"]["robustness"]
    assert not verdict["holds"] and verdict["worst"]["change"] == {"gain": 0.01}


@pytest.mark.parametrize("speed", [0.0, 1.3, 5.0])
def test_l_f_is_exact(speed):
    """The formula of the unicycle against automatic differentiation."""
    model, dt = Unicycle(), 0.1
    x = jnp.array([0.3, -0.2, 0.7, speed, 0.4])
    assert l_f(model, dt, speed) == pytest.approx(
        float(np.linalg.norm(input_jacobian(model, x, dt), 2)), rel=1e-5
    )


@pytest.mark.parametrize("A, fine", [(0.8, True), (1.0, False), (1.02, False)])
def test_theorem1(A, fine):
    table = {"theorem1": Theorem1(rollouts=N, share=0.95, rate=0.05)}
    verdict = certified(flow([[A, 0.0], [0.0, A]]), Idle(), table, V=Quadratic(jnp.eye(2)))
    verdict = verdict["verdicts"]["theorem1"]
    assert verdict["holds"] == fine and verdict["worst"]["failed"] != fine


def test_theorem1_charges_for_the_change_of_policy():
    table = {"theorem1": Theorem1(noise=1.0, rollouts=N, share=0.95)}
    verdict = certified(POINT, Scripted(), table, V=Quadratic(jnp.eye(2)))["verdicts"]["theorem1"]
    assert not verdict["holds"] and verdict["figures"]["margin_worst"] < 0


@pytest.mark.parametrize("A, fine", [(0.8, True), (1.0, False), (1.02, False)])
def test_composition(A, fine):
    table = {"composition": Composition(rollouts=N, calibration=N, share=0.9)}
    result = certified(flow([[A, 0.0], [0.0, A]]), Idle(), table)
    assert result["holds"] == fine


class Near(Flow):
    """The same from starts within a small box (m)."""

    start: float = 0.03

    def reset(self, key):
        state = super().reset(key)
        return State(x=state.x * self.start / 2, scenario=state.scenario, t=state.t)


@pytest.mark.parametrize(
    "growth, start", [(1.2 ** (1 / 40), 0.03), (2 ** (1 / 40), 0.01), (1.00001, 0.03)]
)
def test_composition_of_what_grows_is_refused(growth, start):
    """From starts inside their own bound the inequalities hold for a while, and say nothing."""
    game = Near(growth * jnp.eye(2), jnp.asarray(0.0), start=start)
    verdict = Composition(rollouts=N, calibration=N).check(
        ClosedLoop(game, Idle(), Quadratic(jnp.eye(2))), 0
    )
    assert not verdict.holds and verdict.claim.startswith("nothing was contracted")
    assert verdict.bound is None and sentence(verdict).endswith(": does not hold.")


def test_composition_says_until_when():
    verdict = Composition(rollouts=N, calibration=N).check(
        ClosedLoop(flow([[0.8, 0.0], [0.0, 0.8]]), Idle(), Quadratic(jnp.eye(2))), 0
    )
    assert verdict.holds and "until step 90 (9 s)" in verdict.claim
    assert verdict.figures["begin_above"] > N / 2 and np.any(verdict.figures["M"])


class Dips(Quadratic):
    """A quadratic form that is negative on a strip which some rollouts cross."""

    P: jax.Array = eqx.field(default_factory=lambda: jnp.eye(2))

    def value(self, game, state):
        strip = jnp.abs(state.x[0, 0] - 1.0) < 0.002
        return super().value(game, state) * jnp.where(strip, -1e-3, 1.0)


def test_a_negative_v_is_no_lyapunov_function():
    game = flow([[0.8, 0.0], [0.0, 0.8]])
    table = {name: TABLE[name] for name in ("decrease", "basin", "quantiles")}
    table["theorem1"] = Theorem1(rollouts=N, share=0.95)
    assert holding(certified(game, Idle(), table, V=Quadratic(jnp.eye(2)))) == set(table)
    result = certified(game, Idle(), table, V=Dips())
    for verdict in result["verdicts"].values():
        assert not verdict["holds"] and verdict["bound"] is None
        assert "rollouts, so it is no Lyapunov function" in verdict["claim"]


def test_a_verdict_on_nothing_does_not_hold():
    """Starts inside the ball and an unstable plant: no transition and no window to judge."""
    game = Near(1.02 * jnp.eye(2), jnp.asarray(0.0), start=0.02)
    for certificate in (TABLE["decrease"], TABLE["contraction"]):
        verdict = certificate.check(ClosedLoop(game, Idle(), Quadratic(jnp.eye(2))), 0)
        assert not verdict.holds and verdict.claim.startswith("nothing to judge: 0 of 600")
        assert verdict.trials == verdict.bound == 0


def test_trials_are_what_leaves_something_to_judge():
    """Half of the starts lie inside the ball; of them a decrease says nothing."""
    game = Near(0.8 * jnp.eye(2), jnp.asarray(0.0), start=0.15)
    verdict = TABLE["decrease"].check(ClosedLoop(game, Idle(), Quadratic(jnp.eye(2))), 0)
    outside = 1 - np.pi * 0.1**2 / 0.3**2
    assert verdict.holds and verdict.trials == pytest.approx(outside * N, rel=0.1)
    assert verdict.figures["drawn"] == N


def test_growth_is_not_called_contraction():
    game = flow([[1.05, 0.0], [0.0, 1.05]])
    verdict = TABLE["contraction"].check(ClosedLoop(game, Idle(), Quadratic(jnp.eye(2))), 0)
    assert not verdict.holds and verdict.figures["beta"] == pytest.approx(1 - 1.05**20, rel=1e-3)
    assert verdict.claim.startswith("the cost does not contract") and "grows by" in verdict.claim
    assert verdict.bound > 0.95 and sentence(verdict).endswith(": does not hold.")


def test_an_infinite_bound_reads_unbounded():
    verdict = TABLE["quantiles"].check(
        ClosedLoop(flow([[1.0, 0.0], [0.0, 1.0]]), Idle(), Quadratic(jnp.eye(2))), 0
    )
    assert "settling time unbounded;" in verdict.claim and not verdict.holds
    bounds = {"final_distance": 0.04121, "settling_time": 3.8, "largest_rise": np.inf}
    said = quantiles.claim(0.95, bounds, "a form", "m", "until step 40 (4 s)")
    assert "final distance at most 0.04121 m; settling time at most 3.8 s" in said
    assert "largest rise unbounded of V" in said
    assert quantiles.at_most(0.123401) == "at most 0.1235"  # an upper bound is rounded up


def test_perturbations_that_cannot_be_applied_are_named():
    class Judged(Rendezvous):
        def success(self, state):
            return jnp.all(self.distance(state) <= self.radius)

    few = Robustness(400, (0.5,), (), (), (), (), share=0.9)
    game = Judged(agents=2, graph="path", dynamics=SingleIntegrator())
    verdict = few.check(ClosedLoop(game, lambda s, k: s.scenario.goal - s.x, CostSum(Idle())), 0)
    assert "without agent 1" in verdict.figures["without"]
    assert "(left out: without agent 1, because an agent of Judged" in verdict.claim
    assert (
        "without agent" not in verdict.scope["disturbance"] and len(verdict.figures["curve"]) == 2
    )
    with pytest.raises(UserError, match="gain 0.5, because the inputs of this game"):
        few.check(ClosedLoop(flow([[0.8, 0.0], [0.0, 0.8]]), Idle(), CostSum(Idle())), 0)


def test_composition_fits_a_known_row():
    """V_0+ = 0.5 V_0 + 0.25 V_1 exactly."""
    linked = np.array([[False, True], [True, False]])
    values = np.abs(np.random.default_rng(0).normal(size=(50, 2, 2)))
    values[:, 1, 0] = 0.5 * values[:, 0, 0] + 0.25 * values[:, 0, 1]
    row, delta = fit_row(linked, values, 1, 0, 1e-3)
    assert np.allclose(row, [0.5, 0.25], atol=1e-5) and delta < 1e-6


def test_closed_form_of_a_path_of_two():
    game = Rendezvous(agents=2, graph="path")
    law = PointOffset(game, offset=0.1, leader_gain=1.0, k_p=4.0, k_d=4.0)
    verdict = ClosedForm().check(ClosedLoop(game, law, CostSum(law)), 0)
    assert np.allclose(verdict.figures["eigenvalues"], 1 - np.array([1, -1]) / 2**0.5)
    roots = np.roots([1.0, 4.0, 4.0 * (1 - 1 / 2**0.5)])
    assert verdict.holds and verdict.bound == pytest.approx(-max(roots.real))
    for P, mu in zip(verdict.figures["P"], verdict.figures["eigenvalues"], strict=True):
        A = np.array([[0.0, 1.0], [-4.0 * mu, -4.0]])
        assert np.allclose(A.T @ P + np.array(P) @ A, -np.eye(2))
    unstable = PointOffset(game, k_p=4.0, k_d=-1.0)
    assert not ClosedForm().check(ClosedLoop(game, unstable, CostSum(law)), 0).holds
    with pytest.raises(UserError, match="PointOffset"):
        ClosedForm().check(ClosedLoop(game, Idle(), CostSum(law)), 0)


def test_the_linearisation_says_no_to_the_unicycle():
    game = Rendezvous(agents=1)
    verdict = Linearisation().check(ClosedLoop(game, Idle(), CostSum(Idle())), 0)
    assert not verdict.holds and verdict.figures["controllability_rank"] == 4
    assert verdict.claim.startswith("NO") and verdict.evidence == "proved"
    assert verdict.figures["uncontrollable_eigenvalues"] == pytest.approx([1.0])
    assert Linearisation().check(ClosedLoop(POINT, Scripted(), CostSum(Idle())), 0).holds
    assert not Linearisation().check(ClosedLoop(POINT, Idle(), CostSum(Idle())), 0).holds


class Holonomic(Rendezvous):
    """Robots called unicycles that its own step moves straight to the goal, by 0.6 a step."""

    def step(self, state, action):
        p = state.scenario.goal + 0.6 * (state.x[:, :2] - state.scenario.goal)
        x = jnp.concatenate([p, 0.6 * state.x[:, 2:]], axis=1)
        return State(x=x + 0.0 * jnp.sum(action), scenario=state.scenario, t=state.t + 1)

    def errors(self, state):
        return jnp.concatenate([state.x[:, :2] - state.scenario.goal, state.x[:, 2:]], axis=1)

    def reset(self, key):
        start = super().reset(key)
        return eqx.tree_at(lambda s: s.x, start, start.x.at[:, 2].set(0.0))


def test_the_linearisation_is_of_the_games_own_step():
    verdict = Linearisation().check(ClosedLoop(Holonomic(agents=1), Idle(), CostSum(Idle())), 0)
    assert verdict.evidence == "observed" and verdict.holds
    assert verdict.bound == pytest.approx(0.6, abs=1e-12)


@pytest.mark.parametrize("A, fine", [(0.99, True), (0.9995, False), (0.99999994, False),
                                     (1.0, False), (1.00001, False)])  # fmt: skip
def test_the_linearisation_keeps_a_margin(A, fine):
    verdict = Linearisation().check(
        ClosedLoop(flow([[A, 0.0], [0.0, A]]), Idle(), CostSum(Idle())), 0
    )
    assert verdict.holds == fine


def test_the_linearisation_asks_for_an_equilibrium_that_does_not_move():
    beside = Linearisation().check(
        ClosedLoop(POINT, Straying(jnp.asarray(0.05)), CostSum(Idle())), 0
    )
    assert not beside.holds and beside.claim.startswith("the goal is no equilibrium: on it the")
    assert "agents move by 0.04 in a step" in beside.claim
    late = Linearisation().check(
        ClosedLoop(POINT, Scripted(leave=jnp.asarray(45)), CostSum(Idle())), 0
    )
    assert not late.holds and "depends on the time" in late.claim

    class Drifting(Flow):
        def step(self, state, action):
            after = super().step(state, action)
            return eqx.tree_at(lambda s: s.x, after, after.x + 0.01)

    moving = Drifting(jnp.eye(2) * 0.5, jnp.asarray(0.0))
    verdict = Linearisation().check(ClosedLoop(moving, Idle(), CostSum(Idle())), 0)
    assert not verdict.holds and "under the holding action the agents move" in verdict.claim
    kinked = lambda state, key: -3.0 * jnp.abs(state.x - state.scenario.goal)
    verdict = Linearisation().check(ClosedLoop(POINT, kinked, CostSum(Idle())), 0)
    assert not verdict.holds and "no derivative" in verdict.claim


class Meeting(Flow):
    """Two points on lines whose error is their gap alone: the target set is a line."""

    agents: int = 2

    def reset(self, key):
        x = jax.random.normal(key, (2, 2))
        return State(x=x, scenario=Goals(jnp.zeros((2, 2))), t=jnp.asarray(0))

    def errors(self, state):
        return state.x - state.x[::-1]

    def step(self, state, action):
        x = state.x + 0.1 * (action - jnp.mean(action, axis=0, keepdims=True))
        return State(x=x, scenario=state.scenario, t=state.t + 1)


def test_an_eigenvalue_along_the_target_set_is_harmless():
    """No input moves the mean of the two, and no error sees it: nothing is impossible."""
    game = Meeting(jnp.eye(2), jnp.asarray(0.0))
    verdict = Linearisation().check(
        ClosedLoop(game, lambda s, k: -(s.x - s.scenario.goal), CostSum(Idle())), 0
    )
    assert verdict.figures["controllability_rank"] == 2 and not verdict.holds
    assert verdict.figures["uncontrollable_eigenvalues"] == []
    assert verdict.evidence == "observed" and "no stability is shown" in verdict.claim


def test_formulas_are_about_their_own_model_only():
    class Sticky(Rendezvous):
        def step(self, state, action):
            return super().step(state, 0.9 * action)

    one, law = Sticky(agents=1), PointOffset(Sticky(agents=1))
    with pytest.raises(UserError, match="Sticky has another `step`"):
        ClosedForm().check(ClosedLoop(one, law, CostSum(law)), 0)
    policy = Decentralised(
        policy_of(GAINS)[1].policy, Sticky(agents=1, dynamics=DoubleIntegrator())
    )
    with pytest.raises(UserError, match="another `step`"):
        ANNULUS.check(ClosedLoop(policy.game, policy, FORM), 0)
    other = Rendezvous(agents=1, dynamics=Unicycle(limits=(1.0, 1.0)))
    with pytest.raises(UserError, match="made for another game"):
        ClosedForm().check(ClosedLoop(Rendezvous(agents=1), PointOffset(other), CostSum(law)), 0)

    class Slippery(DoubleIntegrator):
        def step(self, x, action, dt):
            return 0.999 * super().step(x, action, dt)

    with pytest.raises(UserError, match="not Slippery"):
        game = Rendezvous(agents=1, dynamics=Slippery())
        ANNULUS.check(ClosedLoop(game, Decentralised(policy.policy, game), FORM), 0)


def test_a_proof_about_nothing_is_refused():
    game, stable = policy_of(GAINS)
    for wrong in (dict(c=1e6, rho=1e5, inner=1e5), dict(eta=-1.0), dict(eta=0.0)):
        with pytest.raises(UserError, match="nothing to prove|V must fall"):
            dataclasses.replace(ANNULUS, **wrong).check(ClosedLoop(game, stable, FORM), 0)


def test_split_boxes_overlap_however_far_out():
    boxes = np.array([[[1e3, 0.0, 0.0, 0.0], [1e-6, 0.0, 0.0, 0.0]]])
    left, right = halves(boxes, np.ones((1, 4)))
    assert left[0, 0] + left[1, 0] > right[0, 0] - right[1, 0]
    assert left[0, 0] - left[1, 0] < 1e3 - 1e-6 and right[0, 0] + right[1, 0] > 1e3 + 1e-6


def policy_of(K, hidden=16):
    """A network of one agent that computes tanh(K (e, rates)) exactly."""
    game = Rendezvous(agents=1, dynamics=DoubleIntegrator())
    actors = Actors(Shape(1, 7, 6, 4, 2), hidden, key=jax.random.key(0))
    W = [np.zeros(l.weight.shape, np.float32) for l in actors.net.layers]
    for i, column in enumerate((3, 4, 0, 1)):  # e, then rates, in what the agent sees
        for row, sign in ((2 * i, 1.0), (2 * i + 1, -1.0)):
            W[0][0, row, column], W[1][0, row, row] = sign, 1.0
            W[2][0, :2, row] = sign * np.asarray(K)[:, i]
    leaves = lambda a: [l.weight for l in a.net.layers] + [l.bias for l in a.net.layers]
    zeros = [jnp.zeros_like(l.bias) for l in actors.net.layers]
    actors = eqx.tree_at(leaves, actors, [*map(jnp.asarray, W), *zeros])
    return game, Decentralised(Greedy(actors), game)


GAINS = np.array([[0.8, 0, -0.8, 0], [0, 0.8, 0, -0.8]])
FORM = Quadratic(
    jnp.array([[11.1, 0, -0.52, 0], [0, 11.1, 0, -0.52], [-0.52, 0, 1.68, 0], [0, -0.52, 0, 1.68]])
)
ANNULUS = Proof(c=1.0, rho=0.7, inner=0.7, half=(0.31, 0.31, 0.8, 0.8), eta=1e-4)


def test_a_proof_succeeds_resumes_and_refutes(tmp_path):
    game, stable = policy_of(GAINS)
    assert ANNULUS.check(ClosedLoop(game, stable, FORM), 0).figures["answer"] == "proved"
    place = str(tmp_path / "proof")
    short = dataclasses.replace(ANNULUS, most=5_000, resume=place)
    verdict = short.check(ClosedLoop(game, stable, FORM), 0)
    assert not verdict.holds and verdict.figures["answer"] == "undecided"
    assert 0 < verdict.figures["volume_left"] <= 1
    assert dataclasses.replace(short, most=10**6).check(ClosedLoop(game, stable, FORM), 0).holds
    for K in (-GAINS, 0 * GAINS):  # unstable and marginal
        verdict = ANNULUS.check(ClosedLoop(*policy_of(K), FORM), 0)
        assert verdict.figures["answer"] == "refuted" and verdict.worst["V_next"] > 0
    with pytest.raises(UserError, match="another proof"):
        short.check(ClosedLoop(*policy_of(-GAINS), FORM), 0)


APPROACH = Approach(
    *map(jnp.asarray, (1.716, 0.743, 0.131, 3.284, 1.076, 0.439, 0.209))  # as experiments/proof.py
)


def test_approach_is_zero_on_the_target_and_at_least_the_distance_elsewhere():
    e = jax.random.normal(jax.random.key(0), (1000, 4))
    values = jax.vmap(lambda e: APPROACH.of(e, 0.1))(e)
    assert float(APPROACH.of(jnp.zeros(4), 0.1)) == pytest.approx(0.0, abs=1e-7)
    assert np.all(np.asarray(values) >= np.linalg.norm(e[:, :2], axis=1) - 1e-6)
    assert float(APPROACH.of(jnp.array([0.0, 0.0, 1.0, 0.0]), 0.1)) > 0.5
    wide = extents(APPROACH, np.array([1.0]), np.full(4, np.inf))[0]
    assert float(APPROACH.of(jnp.array([0.0, 0.0, wide[2], 0.0]), 0.1)) == pytest.approx(
        1, rel=1e-4
    )


def test_a_proof_says_by_when():
    proof = dataclasses.replace(ANNULUS, c=1.0, rho=0.1, inner=0.2, eta=1e-9, decay=0.1)
    assert proof.steps == int(np.ceil(np.log(10) / -np.log(0.9)))
    assert dataclasses.replace(proof, eta=0.45, decay=0.0).steps == 2


@pytest.mark.parametrize("kind", ["norm", "approach"])
def test_the_bounds_of_the_unicycle_hold_at_random_points(kind):
    game = Rendezvous(agents=1)
    shape = Shape(1, 7, 6, 4, 2)
    controller = Decentralised(Greedy(Actors(shape, 32, key=jax.random.key(3))), game)
    V = Norm(NormNet(shape, key=jax.random.key(1))) if kind == "norm" else APPROACH
    rng = np.random.default_rng(0)
    centre, radius = rng.uniform(-1, 1, (500, 4)), rng.uniform(0, 0.2, (500, 4))
    box = bounds.box(centre, radius)
    moved, V_of = Loop(ClosedLoop(game, controller, V))(box), lyapunov(V, game.radius)
    before, after = V_of(box), V_of(moved)
    change = bounds.add(after, before, -1.0)

    @eqx.filter_jit
    def truth(x):
        state = State(
            x=jnp.array([[0.0, 0.0, 0.0, x[2], x[3]]]),
            scenario=Goals(x[None, :2]),
            t=jnp.asarray(0),
        )
        later = game.step(state, controller(state, jax.random.key(0)))
        return game.errors(later)[0], V.value(game, state)[None], V.value(game, later)[None]

    x = centre + radius * rng.uniform(-1, 1, centre.shape)
    f, V0, V1 = (np.asarray(a, float) for a in jax.vmap(truth)(jnp.asarray(x)))
    for bound, value in ((moved, f), (before, V0), (after, V1), (change, V1 - V0)):
        assert (bound.low <= value + 1e-5).all() and (value <= bound.high + 1e-5).all()


class Rules(Rendezvous):
    """Two points that have to keep apart, and may violate a rule of their own."""

    gap: float = 0.5

    def violations(self, state):
        return self.crowded(state, self.gap)


def steady(state, key):
    """Nobody moves."""
    return jnp.zeros((2, 2))


def test_safe_counts_rollouts_in_which_a_rule_is_broken():
    points = dict(agents=2, leaders=(0, 1), dynamics=SingleIntegrator((2.0, 2.0)))
    few = Safe(rollouts=N, share=0.8)
    meets = few.check(
        ClosedLoop(Rules(**points), lambda s, k: s.scenario.goal - s.x, CostSum(Idle())), 0
    )
    assert not meets.holds and meets.successes == 0 and meets.worst["failed"]
    still = few.check(ClosedLoop(Rules(**points, gap=0.2), steady, CostSum(Idle())), 0)
    # Two points uniform in a square of side 2 are closer than r with probability pi r^2 / 4, less
    # what lies outside.
    assert still.holds and still.successes / N == pytest.approx(1 - 0.0293, abs=0.02)
    assert "no agent breaks a rule of Rules" in still.claim and "until step 80 (8 s)" in still.claim


def test_safe_refuses_a_game_without_a_rule():
    with pytest.raises(UserError, match="Rendezvous has no rule to break"):
        Safe().check(ClosedLoop(POINT, Scripted(), CostSum(Idle())), 0)
    with pytest.raises(UserError, match="Formation never fire"):
        Safe().check(ClosedLoop(Formation(), Scripted(), CostSum(Idle())), 0)
    result = certified(POINT, Scripted(), {"reach": TABLE["reach"], "safe": Safe()})
    assert "no rule to break" in result["left_out"]["safe"] and not result["holds"]


def test_apart_finds_the_gap_and_tests_it_on_fresh_starts():
    points = dict(agents=2, leaders=(0, 1), dynamics=SingleIntegrator((2.0, 2.0)))
    verdict = Apart(rollouts=N, calibration=N, share=0.8).check(
        ClosedLoop(Rules(**points), steady, CostSum(Idle())), 0
    )
    gap = verdict.figures["gap"]
    assert verdict.holds and 0.3 < gap < 0.6 and f"closer than {gap:g} m" in verdict.claim
    meets = Apart(rollouts=N, calibration=N).check(
        ClosedLoop(Rules(**points), lambda s, k: s.scenario.goal - s.x, CostSum(Idle())), 0
    )
    assert not meets.holds and "less than the 0.01 m asked" in meets.claim
    with pytest.raises(UserError, match="team of one"):
        Apart().check(ClosedLoop(POINT, Scripted(), CostSum(Idle())), 0)


PATH = Rendezvous(graph="path", dynamics=SingleIntegrator())  # 0 leads, 2 is linked to 1 alone
PATH_OBS = PATH.observations(PATH.reset(jax.random.key(0))).shape[1]


def goal(state):
    return state.scenario.goal


def local(state):
    """Everybody goes to the mean of itself and its neighbours, the leader to its goal."""
    x, link = state.x, jnp.asarray(np.eye(3) + PATH.adjacency, jnp.float32)
    pull = link @ x / jnp.sum(link, axis=1, keepdims=True) - x
    return pull.at[0].add(goal(state)[0] - x[0])


@pytest.mark.parametrize(
    "act, found",
    [
        (local, "each agent acts on itself and its neighbours"),
        (lambda s: local(s) * (1.0 - (s.t > 80)), "agent 0's action changes with the time"),
        (lambda s: goal(s) - s.x, "agent 1's action changes with the target that it is not told"),
        (lambda s: local(s) + goal(s)[1:2], "agent 0's action changes with the target of agent 1"),
        (lambda s: local(s).at[0].add(s.x[2]), "agent 0's action changes with agent 2, which"),
    ],
)  # fmt: skip
def test_information_is_found_by_test(act, found):
    said = information(PATH, lambda s, k: act(s), jax.random.key(0))
    assert said.startswith(found) or said.startswith(f"NOT decentralised: {found}")


def test_information_of_policies_and_of_a_verdict():
    actors = Actors(Shape(3, PATH_OBS, 6, 2, 2), 8, key=jax.random.key(0))
    alone = Decentralised(Greedy(actors), PATH)
    assert information(PATH, alone, jax.random.key(0)) == "each agent acts on its own observation"

    class Summed(eqx.Module):
        def __call__(self, obs, key):
            return jnp.tanh(jnp.sum(obs, axis=0, keepdims=True)[:, :2]) * jnp.ones((3, 1))

    said = information(PATH, Decentralised(Summed(), PATH), jax.random.key(0))
    assert said == "NOT decentralised: agent 0's action changes with agent 1's observation"
    result = certified(POINT, Scripted(leave=jnp.asarray(33)), {"reach": TABLE["reach"]})
    assert "with the time" in result["information"]
    assert result["verdicts"]["reach"]["scope"]["information"] == result["information"]
