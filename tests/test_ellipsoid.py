"""The proof by intervals encloses what the program computes, and believes no false derivative."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.certificates import CERTIFICATES, ellipsoid, intervals as I
from marlyap.certificates.ellipsoid import Ellipsoid, Program, shorter
from marlyap.certificates.linearisation import as_double
from marlyap.certificates.loop import ClosedLoop
from marlyap.controllers import CONTROLLERS
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.tasks import TASKS


PROVED = (
    ("consensus", "laplacian"),
    ("consensus-unstable", "laplacian"),
    ("formation-di", "formation-linear"),
    ("formation-di", "formation-consensus"),
    ("estimation", "consensus-filter"),
    ("platoon-catchup", "platoon-ovm"),
    ("platoon-catchup", "platoon-linear"),
    ("platoon-slowdown", "platoon-linear"),
    ("microgrid", "grid-feedback"),
    ("cartpoles", "cart-lqr"),
    ("cartpoles", "cart-feedback"),
    ("quads-planar", "quad-chain"),
    ("frequency", "droop"),
    ("frequency-weak", "droop"),
)
FAST = PROVED[:2]
slow = [pytest.param(*pair, marks=pytest.mark.slow) for pair in PROVED[2:]]

FUNCTIONS = (
    lambda x: jnp.sin(3 * x) + jnp.cos(x) * x,
    lambda x: jnp.tanh(x) / (2 + x**2),
    lambda x: jnp.clip(x, -0.3, 0.5) * jnp.abs(x),
    lambda x: jnp.sqrt(1 + x**2) - jnp.exp(-x),
    lambda x: jax.nn.relu(x) - jax.nn.softplus(x),
    lambda x: x[::-1] @ jnp.outer(x, x),
    lambda x: jnp.arctan2(x, 6 + x) + jnp.maximum(x, x[0]),
    lambda x: jnp.zeros(3).at[jnp.array([0, 0, 2])].add(x) + x[jnp.array([2, 1, 1])],
    lambda x: jax.lax.fori_loop(0, 5, lambda k, y: 0.5 * y + jnp.sin(y), x),
    lambda x: jnp.where(jnp.arange(3) > 1, x**3, jax.nn.sigmoid(x)),
)


@pytest.mark.parametrize("f", FUNCTIONS, ids=range(len(FUNCTIONS)))
def test_intervals_contain_values_and_derivatives(f):
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        program = I.traced(f, jnp.zeros(3))
        slope = I.derivative(program, jnp.zeros(3))
        both = jax.jit(jax.vmap(lambda x: (f(x), jax.jacfwd(f)(x))))
        for width in (1e-9, 1e-3, 0.1, 1.0, 3.0):
            low = rng.uniform(-2, 2, 3)
            box = I.Interval(low, low + width)
            values = I.enclosed(program, [box], decided=False)[0]
            slopes = I.enclosed(slope, [box, I.point(np.eye(3))], decided=False)[0]
            seen = map(np.asarray, both(jnp.asarray(rng.uniform(low, low + width, (100, 3)))))
            for bounds, found in zip((values, slopes), seen, strict=True):
                assert (bounds.low <= found + 1e-14).all() and (found - 1e-14 <= bounds.high).all()
        at = I.enclosed(program, [I.point(low)], decided=False)[0]
        assert (at.high - at.low < 1e-11).all()  # a point stays one


def loop(task, law):
    game = TASKS[task]
    return ClosedLoop(game, CONTROLLERS[law](game))


@pytest.mark.parametrize(("task", "law"), [*FAST, *slow])
def test_it_is_proved_and_the_step_does_what_was_proved(task, law):
    """From points on the level, in every direction, by the game's own step in float64."""
    own = loop(task, law)
    with jax.enable_x64(True):
        program = Program(as_double(own.game), as_double(own.controller), jax.random.key(5))
        region = ellipsoid.proved(program)
        assert isinstance(region, ellipsoid.Region), region
        m = region.across
        rng = np.random.default_rng(1)
        ways = rng.standard_normal((200, len(region.W)))
        ways[:, :m] /= np.linalg.norm(ways[:, :m], axis=1, keepdims=True) / region.level
        ways[:, m:] *= region.along / max(np.abs(ways[:, m:]).sum(axis=1).max(initial=0.0), 1e-9)
        x = region.centre + np.linalg.solve(region.W, ways.T).T
        assert (np.abs(x - region.centre) <= region.reach * (1 + 1e-9)).all()
        f = lambda x: jax.core.eval_jaxpr(
            program.step.jaxpr, program.step.consts, x, jnp.asarray(int(program.t.low), jnp.int32)
        )[0]
        V = lambda x: np.linalg.norm((x - region.centre) @ region.W[:m].T, axis=1)
        after = np.asarray(jax.vmap(f)(jnp.asarray(x)))
        most = region.rate * V(x) + region.rest
        assert (V(after) <= most * (1 + 1e-9) + 1e-12).all()
        assert V(after).max() > 0.3 * most.max()  # the bound says something


def test_certify_says_proved():
    verdict = dataclasses.replace(Ellipsoid(), scenes=1).check(loop("consensus", "laplacian"), 0)
    assert verdict.holds and verdict.evidence == "proved" and verdict.bound < 0.77
    assert "0.7600" in verdict.claim and "1 targets" in verdict.claim
    assert type(CERTIFICATES["ellipsoid"]) is Ellipsoid


class Changed(eqx.Module):
    """The Laplacian law with its action passed through another function."""

    game: AbstractGame
    through: object = eqx.field(static=True)

    def __call__(self, state, key):
        return self.through(CONTROLLERS["laplacian"](self.game)(state, key), key)


@jax.custom_jvp
def lying(a):
    return -a  # drives the agents apart


lying.defjvp(lambda at, ways: (-at[0], ways[0]))


@pytest.mark.parametrize(
    ("through", "said"),
    [
        (lambda a, key: lying(a), "spectral radius"),
        (lambda a, key: jnp.zeros_like(a), "leaves every state"),
        (lambda a, key: a + jax.random.normal(key, a.shape) * 1e-12, "is not covered"),
        (lambda a, key: jnp.where(a > 0, a + 0.01, a), "choice that depends"),
        (lambda a, key: a + 0.01 * jnp.sign(a), "a sign that depends"),
        (lambda a, key: a + 1e-3 * jnp.floor(1e3 * a), "a rounding that depends"),
        (lambda a, key: a + jax.lax.stop_gradient(-a), "leaves every state"),
        (lambda a, key: a + 0.9, "may drift"),
    ],
    ids=("custom", "nothing", "random", "jump", "sign", "floor", "stopped", "offset"),
)
def test_it_refuses(through, said):
    game = TASKS["consensus"]
    own = ClosedLoop(game, Changed(game, through))
    try:
        Ellipsoid().refuse(own)
    except UserError as error:
        assert said in str(error)
        return
    verdict = Ellipsoid(scenes=1).check(own, 0)
    assert not verdict.holds and verdict.evidence == "observed" and said in verdict.claim


def test_a_region_ends_before_the_controller_jumps():
    jumps = Changed(TASKS["consensus"], lambda a, key: jnp.where(a > 1e-3, a + 0.01, a))
    found = Ellipsoid(scenes=1).check(ClosedLoop(TASKS["consensus"], jumps), 0)
    assert found.holds and max(found.figures["reach"]) < 1e-3 / 0.2


def test_the_norm_is_confirmed_in_fractions():
    M = np.array([[3.0, 4.0], [0.0, 0.0]])
    assert shorter(M, np.nextafter(5.0, 6.0)) and not shorter(M, 5.0)
    assert not shorter(M, np.nextafter(5.0, 4.0)) and shorter(0 * M, 1e-300)


def test_a_game_whose_target_moves_is_refused():
    with pytest.raises(UserError, match="the target set moves in time"):
        Ellipsoid().refuse(loop("ring", "follower-stopper"))
