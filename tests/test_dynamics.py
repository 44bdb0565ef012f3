"""Dynamics against float64 references written apart, and the facts the theory rests on."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from marlyap.certificates.theorem1 import l_f
from marlyap.errors import UserError
from marlyap.games.dynamics import (
    DYNAMICS,
    DoubleIntegrator,
    LateUnicycle,
    SingleIntegrator,
    Unicycle,
)
from marlyap.learning.constraints.lyapunov import Lyapunov


def unicycle(x, u):
    return np.array([x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), x[4], u[0], u[1]])


FIELDS = {
    "unicycle": unicycle,
    "late-unicycle": lambda x, u: np.array([*unicycle(x[:5], x[5:]), 0, 0]),
    "double-integrator": lambda x, u: np.array([x[2], x[3], u[0], u[1]]),
    "single-integrator": lambda x, u: np.array(u),
    "unstable-point": lambda x, u: np.array([x[2], x[3], x[2] + u[0], x[3] + u[1]]),
}
every = pytest.mark.parametrize("name", FIELDS)


@pytest.fixture(autouse=True)
def float64():
    """The package's own code in double precision, so that orders of convergence can be seen."""
    with jax.enable_x64(True):
        yield


@eqx.filter_jit
def drive(dynamics, x, actions, dt, repeat):
    """Hold each action for `repeat` steps of dt."""
    tick = lambda x, a: (dynamics.step(x, dynamics.inputs_of(a), dt), None)
    return jax.lax.scan(tick, x, jnp.repeat(actions, repeat, axis=0))[0]


def start(name, rng):
    return rng.uniform(-1, 1, DYNAMICS[name].dx)


def reference(name, x, actions, limits, hold):
    """DOP853, restarted at every jump of the input."""
    for a in actions:
        u = np.asarray(a) * np.asarray(limits)
        field = lambda t, x, u=u: FIELDS[name](x, u)
        x = solve_ivp(field, (0, hold), x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    return x


def test_every_dynamics_has_a_reference():
    assert set(DYNAMICS) == set(FIELDS)


@every
def test_field_is_the_written_one(name):
    rng = np.random.default_rng(0)
    for _ in range(5):
        x, u = start(name, rng), rng.uniform(-5, 5, 2)
        np.testing.assert_allclose(
            DYNAMICS[name].field(jnp.array(x), jnp.array(u)), FIELDS[name](x, u)
        )


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("rk4", 4)])
def test_order_of_convergence(integrator, order):
    rng = np.random.default_rng(1)
    x, actions = start("unicycle", rng), rng.uniform(-1, 1, (4, 2))
    dynamics = Unicycle((2.0, 3.0), integrator)
    exact = reference("unicycle", x, actions, dynamics.limits, 0.4)
    error = lambda n: np.linalg.norm(
        drive(dynamics, jnp.array(x), jnp.array(actions), 0.4 / n, n) - exact
    )
    errors = np.array([error(n) for n in (8, 16, 32)])
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), order, atol=0.15)
    assert errors[-1] < (0.2 if order == 1 else 1e-5)


@pytest.mark.parametrize("name", [name for name in FIELDS if name != "late-unicycle"])
@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_long_runs_follow_the_reference_in_single_precision(name, integrator):
    rng = np.random.default_rng(2)
    x, actions = start(name, rng), rng.uniform(-1, 1, (10, 2))
    dynamics = replace(DYNAMICS[name], integrator=integrator)
    exact = reference(name, x, actions, dynamics.limits, 0.1)
    single = lambda a: np.asarray(a, np.float32)
    with jax.enable_x64(False):
        got = drive(dynamics, single(x), single(actions), 0.1 / 8, 8)
    assert got.dtype == jnp.float32
    assert np.max(np.abs(got - exact)) < (2e-5 if integrator == "rk4" else 0.1)


def driven(dynamics, x, action, dt):
    """The state after a step under an action in [-1, 1]."""
    return dynamics.step(jnp.asarray(x), dynamics.inputs_of(jnp.asarray(action)), dt)


def test_semi_implicit_euler_moves_velocities_first_then_heading_then_position():
    x, y, psi, v, omega = 0.3, -0.2, 0.7, 1.1, -0.4
    dt, a, r = 0.1, 0.5 * 2.0, -0.25 * 3.0
    v1, omega1 = v + dt * a, omega + dt * r
    psi1 = psi + dt * omega1
    want = [x + dt * v1 * np.cos(psi1), y + dt * v1 * np.sin(psi1), psi1, v1, omega1]
    got = driven(Unicycle((2.0, 3.0)), [x, y, psi, v, omega], [0.5, -0.25], dt)
    np.testing.assert_allclose(got, want, rtol=1e-14)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_integrators_of_integrators_are_exact(integrator):
    x, v, u, dt = np.array([0.3, -1.0]), np.array([0.7, 0.2]), np.array([0.5, -0.25]), 0.1
    one = driven(SingleIntegrator((2.0, 3.0), integrator), x, u, dt)
    np.testing.assert_allclose(one, x + dt * u * [2, 3], rtol=1e-14)

    two = driven(DoubleIntegrator((2.0, 3.0), integrator), [*x, *v], u, dt)
    a = u * [2, 3]
    v1 = v + dt * a
    x1 = x + dt * v1 if integrator == "euler" else x + dt * v + dt**2 / 2 * a
    np.testing.assert_allclose(two, [*x1, *v1], rtol=1e-14)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_a_late_unicycle_does_one_step_later_what_a_unicycle_does(integrator):
    rng, limits = np.random.default_rng(5), (2.0, 3.0)
    x, late = jnp.array(start("unicycle", rng)), LateUnicycle(limits, integrator)
    y = jnp.concatenate([x, jnp.zeros(2)])
    before = Unicycle(limits, integrator).step(x, jnp.zeros(2), 0.1)
    np.testing.assert_array_equal(late.predict(y, 0.1)[:5], before)
    actions = rng.uniform(-1.5, 1.5, (6, 2))
    idle = jnp.zeros((1, 2))
    soon = drive(Unicycle(limits, integrator), x, jnp.concatenate([idle, actions]), 0.1, 1)
    then = drive(late, y, jnp.concatenate([actions, idle]), 0.1, 1)
    np.testing.assert_allclose(then[:5], soon, rtol=1e-14)
    np.testing.assert_array_equal(then[5:], 0)
    asked = driven(late, y, actions[0], 0.1)[5:]
    np.testing.assert_array_equal(asked, np.clip(actions[0], -1, 1) * limits)


@every
def test_actions_are_clipped_and_scaled_by_the_limits(name):
    x, dt = jnp.array(start(name, np.random.default_rng(3))), 0.1
    tight = replace(DYNAMICS[name], limits=(0.5, 2.0))
    unit = replace(DYNAMICS[name], limits=(1.0, 1.0))
    step = lambda f, a: np.asarray(f.step(x, f.inputs_of(jnp.array(a)), dt))
    np.testing.assert_array_equal(step(tight, [5.0, -1.01]), step(tight, [1.0, -1.0]))
    np.testing.assert_allclose(step(tight, [0.6, 0.2]), step(unit, [0.3, 0.4]), rtol=1e-14)
    assert np.any(step(tight, [0.99, -0.99]) != step(tight, [1.0, -1.0]))


@every
def test_what_an_agent_shows_of_itself(name):
    f, rng = DYNAMICS[name], np.random.default_rng(4)
    x = jnp.array(start(name, rng))
    where = f.rest(jnp.array([0.4, -0.6]), jnp.array(2.0))
    np.testing.assert_array_equal(f.position(where), [0.4, -0.6])
    assert not np.any(f.rates(where))
    np.testing.assert_array_equal(f.field(where, jnp.zeros(2)), np.zeros(f.dx))
    if "psi" in f.names:
        np.testing.assert_allclose(f.heading(where), [np.cos(2.0), np.sin(2.0)])
    assert np.linalg.norm(f.heading(x)) == pytest.approx(1)
    # Position moves with the velocity shown, and at rest is the same as no rates.
    _, moves = jax.jvp(f.position, (x,), (f.field(x, jnp.zeros(2)),))
    np.testing.assert_allclose(f.velocity(x), moves, atol=1e-15)
    assert f.rates(x).shape[0] == f.dx - len(set(f.names) & {"x", "y", "psi"})


def linearisation(f, x, dt=0.1):
    step = lambda x, a: f.step(x, f.inputs_of(a), dt)
    return (np.asarray(j) for j in jax.jacobian(step, (0, 1))(jnp.array(x), jnp.zeros(2)))


def controllability(A, B):
    return np.hstack([np.linalg.matrix_power(A, k) @ B for k in range(len(A))])


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_a_unicycle_at_rest_cannot_be_moved_sideways(integrator):
    """t4: rank 4 of 5, the missing direction is lateral and keeps the eigenvalue 1 (2.10)."""
    psi, f = 0.7, Unicycle(integrator=integrator)
    A, B = linearisation(f, [0.2, -0.1, psi, 0, 0])
    C = controllability(A, B)
    assert np.linalg.matrix_rank(C, tol=1e-9) == 4
    lateral = np.array([-np.sin(psi), np.cos(psi), 0, 0, 0])
    np.testing.assert_allclose(lateral @ C, 0, atol=1e-12)
    np.testing.assert_allclose(lateral @ A, lateral, atol=1e-12)
    moving = controllability(*linearisation(f, [0.2, -0.1, psi, 1.0, 0]))
    assert np.linalg.matrix_rank(moving, tol=1e-9) == 5


@pytest.mark.parametrize("name", ["double-integrator", "single-integrator"])
def test_integrators_are_controllable(name):
    f = DYNAMICS[name]
    assert np.linalg.matrix_rank(controllability(*linearisation(f, np.zeros(f.dx)))) == f.dx


def test_the_lipschitz_constant_in_the_action():
    """l_f = sqrt(dt^2 + dt^4 + dt^6 v^2) times the limit, v the new speed (2.7)."""
    dt, limit, f = 0.1, 5.0, Unicycle()
    gain = jax.jit(
        lambda v, psi: jnp.linalg.norm(
            jax.jacobian(lambda a: driven(f, jnp.stack([0.0, 0.0, psi, v, 0.3]), a, dt))(
                jnp.zeros(2)
            ),
            ord=2,
        )
    )
    for v in (0.0, 1.0, -3.0, 5.0):
        analytic = np.sqrt(dt**2 + dt**4 + dt**6 * v**2) * limit
        assert gain(v, 0.4) == pytest.approx(analytic, rel=1e-9)
    # A late input moves nothing within its step but itself.
    assert l_f(LateUnicycle(), dt, 3.0) == pytest.approx(1.0)
    # The default of the constraint bounds it for |v| <= 5 m/s, and not by far.
    assert gain(5.0, 0.0) <= Lyapunov().input_gain <= 1.01 * gain(5.0, 0.0)


def test_bad_parameters_are_named():
    with pytest.raises(UserError, match="limits.*2 positive"):
        Unicycle(limits=(1.0, 0.0))
    with pytest.raises(UserError, match="limits"):
        DoubleIntegrator(limits=(1.0,))
    with pytest.raises(UserError, match="limits"):
        SingleIntegrator(limits=(float("nan"), 1.0))
    with pytest.raises(Exception, match="integrator"):
        Unicycle(integrator="heun")
