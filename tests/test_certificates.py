"""Certificates on games whose answer is known: they accept the stable and refuse the rest."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.certificate import AbstractCertificate, start_of
from marlyap.certificates import CERTIFICATES
from marlyap.certificates.basin import Basin, largest_level
from marlyap.certificates.contraction import Contraction, failures_allowed
from marlyap.certificates.decrease import Decrease
from marlyap.certificates.quantiles import Quantiles
from marlyap.certificates.reach import Reach, ReachAndStay
from marlyap.certify import certify, policy_hash, save
from marlyap.dynamics import AbstractDynamics, SingleIntegrator
from marlyap.errors import UserError
from marlyap.game import AbstractGame
from marlyap.lyapunov_function import CostSum, Quadratic
from marlyap.statistics import lower_bound
from marlyap.tasks.rendezvous import Rendezvous
from marlyap.types import State


class Flow(AbstractGame):
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
        return State(x=x, goal=jnp.zeros((1, 2)), t=jnp.asarray(0))

    def observe(self, state):
        return state.x

    def step(self, state, action):
        x = state.x @ self.A.T + self.cubic * state.x**3 * jnp.array([[1.0, 0.0]])
        return State(x=x, goal=state.goal, t=state.t + 1)


class Idle(eqx.Module):
    def __call__(self, state, key):
        return jnp.zeros((1, 2))


class Scripted(eqx.Module):
    """Drive to the goal; from step `leave` on drive away; or circle; or break on some starts."""

    leave: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(10**6))
    spin: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(0.0))
    broken: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(0.0))

    def __call__(self, state, key):
        to_goal = state.goal - state.x
        action = jnp.where(state.t >= self.leave, -to_goal - 0.3, 4.0 * to_goal)
        turned = jnp.stack([-to_goal[:, 1], to_goal[:, 0]], axis=1)
        action = jnp.where(self.spin > 0, turned, action)
        return jnp.where(state.goal[0, 0] > 1 - 2 * self.broken, jnp.nan, action)


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


def test_bad_input_is_one_sentence():
    few = {"reach": Reach(rollouts=50, share=0.99)}
    with pytest.raises(UserError, match=r"at least \d+ are needed"):
        certified(POINT, Scripted(), few)
    with pytest.raises(UserError, match="on the target set"):
        certified(POINT, Scripted(spin=jnp.asarray(1.0)), few, V=Shifted())
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
