"""Analytic policy gradients: the gradient is exact, small games are solved, nothing leaks."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.games.dynamics import SingleIntegrator, Unicycle
from marlyap.learning.algorithms import ALGORITHMS, APG
from marlyap.learning.optimiser import ADAM
from marlyap.learning.schedule import Schedule
from marlyap.learning.source import shape
from marlyap.learning.trainer import Trainer, schedule_for
from marlyap.nets.nets import Actors
from marlyap.runs.fit import train
from marlyap.simulation.evaluation import evaluate
from marlyap.tasks import Rendezvous


GAME = Rendezvous(agents=2, horizon=6, dynamics=Unicycle())
KEY = jax.random.key(3)


def test_the_gradient_is_that_of_finite_differences():
    with jax.enable_x64(True):
        algorithm = APG(actor_width=4, weight=2.0, T=3, decrease=0.3)
        wide = lambda x: x.astype(jnp.float64) if eqx.is_inexact_array(x) else x
        pi = jax.tree.map(wide, Actors(shape(GAME), 4, False, key=KEY))
        keys = jax.random.split(KEY, 8)
        J = lambda pi: jnp.mean(jax.vmap(lambda k: algorithm.J(pi, GAME, k)[0])(keys))
        J, slope = eqx.filter_jit(J), eqx.filter_jit(eqx.filter_grad(J))(pi)
        rng = np.random.default_rng(0)
        for _ in range(3):
            way = jax.tree.map(
                lambda x: (
                    jnp.asarray(rng.standard_normal(x.shape)) if eqx.is_inexact_array(x) else None
                ),
                pi,
            )
            moved = lambda h, way=way: eqx.apply_updates(pi, jax.tree.map(lambda x: h * x, way))
            numeric = (J(moved(1e-6)) - J(moved(-1e-6))) / 2e-6
            exact = sum(
                jnp.sum(g * w)
                for g, w in zip(jax.tree.leaves(slope), jax.tree.leaves(way), strict=True)
            )
            np.testing.assert_allclose(numeric, exact, rtol=1e-4, atol=1e-6)


def test_the_decrease_condition_counts_what_it_should():
    rise = lambda c, **how: float(APG(**how).rise(jnp.asarray(c), GAME))
    falling = 2.0 * 0.8 ** np.arange(20)
    assert rise(falling, T=1, decrease=0.19) == 0
    assert rise(falling, T=1, decrease=0.3) > 0
    # Only what begins outside the ball counts; one window of four rises, by 0.6 - 0.9 * 0.5.
    assert rise([0.05, 0.09, 0.05, 0.09], T=1, decrease=0.1) == 0
    np.testing.assert_allclose(
        rise([1.0, 0.5, 0.6, 0.3, 0.2], T=1, decrease=0.1), 0.15 / 4, rtol=1e-5
    )


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_a_small_team_is_solved(weight):
    game = Rendezvous(agents=2, horizon=8, dynamics=SingleIntegrator(limits=(3.0, 3.0)), dt=0.2)
    algorithm = APG(actor_width=32, rate_pi=5e-3, ema_rate=0.1, weight=weight, T=4)
    schedule = Schedule(steps=8 * 64 * 150, environments=64, select_every=150, select_episodes=100)
    trained = train(game, algorithm, schedule)
    assert [line["iteration"] for line in trained.history] == list(range(1, 151))
    assert trained.history[-1]["updates"] == 150
    first, last = trained.history[0], trained.history[-1]
    assert last["J_pi"] < 0.5 * first["J_pi"] and last["return"] > first["return"]
    assert evaluate(game, trained.controller, 200).success_rate > 0.9


def test_a_gradient_that_is_not_finite_moves_nothing_and_is_told():
    class Poisoned(Rendezvous):
        def costs(self, state, action):
            return super().costs(state, action) + jnp.sqrt(-1.0 - action[:, 0] ** 2)

    algorithm = APG(actor_width=4)
    learner = algorithm.init(shape(GAME), KEY)
    poisoned = Poisoned(agents=2, horizon=6)
    after, log, health = eqx.filter_jit(algorithm.improve)(
        learner, poisoned, jax.random.split(KEY, 2), jnp.ones(())
    )
    assert int(health.cost) >= 0 and not np.isfinite(log["J_pi"])
    arrays = lambda l: jax.tree.leaves(eqx.filter(l.pi.value, eqx.is_array))
    assert all((a == b).all() for a, b in zip(arrays(learner), arrays(after), strict=True))


def test_a_step_is_no_longer_than_the_clip_allows():
    """Adam hides the length of a gradient; its first moment after one step is a tenth of it."""
    algorithm = dataclasses.replace(APG(actor_width=4), clip=0.01)
    learner = algorithm.init(shape(GAME), KEY)
    keys = jax.random.split(KEY, 2)
    after, log, _ = eqx.filter_jit(algorithm.improve)(learner, GAME, keys, jnp.ones(()))
    moment = jax.tree.leaves(after.pi.memory.mu)
    length = float(jnp.sqrt(sum(jnp.sum(m**2) for m in moment)))
    assert float(log["gradient"]) > 0.01
    np.testing.assert_allclose(length, 0.1 * 0.01, rtol=1e-3)
    assert type(after.pi.memory) is type(ADAM.init(eqx.filter(learner.pi.value, eqx.is_array)))


def test_its_schedule_counts_every_step_it_plays():
    for name in ("apg", "apg-lyapunov"):
        trainer = Trainer(GAME, ALGORITHMS[name], schedule_for(ALGORITHMS[name]))
        assert trainer.updates_per_iteration == 1
        assert trainer.steps_per_iteration == trainer.schedule.environments * GAME.horizon
    assert schedule_for(ALGORITHMS["masac"]) == Schedule()
