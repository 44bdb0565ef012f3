"""Disturbances and parameters drawn at random: off unless asked for, and bad values are named."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.controllers import CONTROLLERS
from marlyap.errors import UserError
from marlyap.simulation.rollout import rollout
from marlyap.tasks import TASKS


OPTIONS = [
    ("platoon-catchup", "platoon-linear", "swing", 3.0),
    ("platoon-catchup", "platoon-linear", "lag", 0.3),
    ("platoon-catchup", "platoon-linear", "gain_spread", 0.2),
    ("quads-planar", "quad-chain", "gust", 0.3),
    ("quads-planar", "quad-chain", "inertia_spread", 0.2),
    ("quads-space", "quad-chain-space", "gust", 2.0),
    ("quads-space", "quad-chain-space", "inertia_spread", 0.2),
    ("ring", "ring-linear", "noise", 0.4),
]


@eqx.filter_jit
def played(game, law, key):
    """Six episodes under a law that may know the nominal game only."""
    one = lambda key: rollout(game, law, game.reset(key), key)
    return jax.vmap(one)(jax.random.split(key, 6))


LARGE = ("quads-space", "ring")  # which take long to compile
slowly = lambda task: [pytest.mark.slow] if task in LARGE else []


@pytest.mark.parametrize(
    ("task", "law", "option", "value"), [pytest.param(*o, marks=slowly(o[0])) for o in OPTIONS]
)
def test_an_option_disturbs_the_motion_and_not_the_target(task, law, option, value):
    nominal = replace(TASKS[task], horizon=200)
    game = replace(nominal, **{option: value})
    drive = CONTROLLERS[law](nominal)
    seen, usual = (played(g, drive, jax.random.key(3)) for g in (game, nominal))
    x, before = np.asarray(seen.state.x), np.asarray(usual.state.x)
    assert np.isfinite(x).all() and not seen.failed.any()
    assert (np.abs(x - before).max(axis=(1, 2, 3)) > 1e-4).all()
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
