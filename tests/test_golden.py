"""Every game steps, costs, fails and succeeds as an independent NumPy oracle said it does.

The files in golden/ hold three trajectories of each game: random actions, a reference controller,
and actions beyond the limits, which have to clip.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.games.game import AbstractRegulation
from marlyap.games.planar import AbstractPlanar, Goals
from marlyap.games.quadrotors import Flight
from marlyap.tasks import TASKS
from marlyap.tasks.cartpoles import Row
from marlyap.tasks.consensus import Hearing
from marlyap.tasks.coverage import Density
from marlyap.tasks.estimation import Target
from marlyap.tasks.flock import Wind
from marlyap.tasks.frequency import Disturbance
from marlyap.tasks.gnn_flock import Push
from marlyap.tasks.microgrid import Loads
from marlyap.tasks.networks import new_england
from marlyap.tasks.platoon import Road
from marlyap.tasks.ring import Traffic
from marlyap.tasks.voltage import Injections
from marlyap.types import State


class Case(NamedTuple):
    """How the file of a game is to be read."""

    task: str
    parts: Callable[..., tuple[Any, ...]]  # x, scenario and memory, if any, of a state in the file
    errors: Callable[[Any], Any] = lambda e: e  # those of the game, ordered as in the file


def planar(start):
    return start["x"], Goals(start["goal"])


def points(start):
    x = jnp.concatenate([start["p"], start["v"]], axis=-1)
    places = jnp.asarray(TASKS["formation-di"].places, x.dtype)
    return x, Goals(start["centre"][None] + places)


def cartpoles(start):
    x = jnp.stack([start[name] for name in ("x", "v", "th", "w")], axis=-1)
    one = jnp.ones((), x.dtype)
    return x, Row(stiffness=one, push=0 * x[..., 0], begins=0 * one)


def microgrid(start):
    x, power = jnp.stack([start["V"], start["I"]], axis=-1), start["P"]
    one = jnp.ones_like(power)
    changes = jnp.zeros((), x.dtype)
    return x, Loads(power=power, change=0 * one, changes=changes, line=one, capacitance=one)


def platoon(start):
    h, lead = start["h"], start["v_start"]
    road = Road(start=lead, swing=0 * lead, gain=jnp.ones_like(h), lag=0 * h)
    return jnp.stack([h, start["v"], start["u"]], axis=-1), road


def quads(task):
    def parts(start):
        goal = start["goal"][None] + jnp.asarray(TASKS[task].places, start["goal"].dtype)
        one = jnp.ones_like(goal[:, 0])
        return start["x"], Flight(goal=goal, gust=0 * goal, begins=0 * one[0], inertia=one)

    return parts


SEED = jnp.zeros(2, jnp.uint32)  # of noise that is not there


def consensus(start):
    return start["d"][..., None], Hearing(SEED)


def estimation(start):
    return start["e"], Target(start["z"], SEED)


def frequency(start):
    """There angles count from those without a load, and effort from zero."""
    load, one = start["load"], jnp.ones((), start["w"].dtype)
    rest = jnp.asarray(new_england().angle, load.dtype)
    x = jnp.stack([start["delta"], start["w"]], axis=-1)
    each, lines = jnp.ones(10, x.dtype), jnp.ones((10, 10), x.dtype)
    return x, Disturbance(load, 0 * one, rest, inertia=each, damping=each, lines=lines)


def ring(task):
    def parts(start):
        game, length = replace(TASKS[task], noise=0.0), start["L"]
        order, n = game.plant.order(game.agents), game.plant.cars
        # Laps are counted here, and not in the file: every car is behind the first.
        line = start["x"][0] - jnp.cumsum(
            jnp.mod(-jnp.diff(start["x"], prepend=start["x"][:1]), length)
        )
        flow = game.plant.flow(length / n - game.plant.size)
        seed = jax.random.key_data(jax.random.key(0))
        x = jnp.stack([line, start["v"]], axis=-1)[order]
        return x, Traffic(length=length, flow=flow, noise=0 * length, seed=seed)

    return parts


def voltage(*inverters):
    """Where the oracle has no power flow, and NaN, the game has 0 V."""
    at = np.array(inverters) - 1

    def parts(start):
        one = jnp.ones((), start["q"].dtype)
        v = jnp.nan_to_num(start["v"])[..., at]
        power = Injections(start["P"], start["Q"], change=0 * one, changes=0 * one, lines=one)
        return jnp.stack([start["q"], v], axis=-1), power, start["u"]

    return parts


def coverage(start):
    return start["p"], Density(jnp.full(2, 0.7, start["p"].dtype))


def flock(start):
    q, v = start["q"], start["p"]
    return jnp.concatenate([q, v], axis=-1), Wind(velocity=start["pr"], push=0 * v)


def gnn_flock(start):
    return jnp.concatenate([start["q"], start["p"]], axis=-1), Push(0 * start["p"])


CASES = {
    "rendezvous-unicycle": Case("rendezvous", planar),
    "formation-unicycle": Case("formation", planar),
    "formation-di": Case("formation-di", points),
    "cartpoles": Case("cartpoles", cartpoles),
    "microgrid": Case("microgrid", microgrid),
    "platoon-catchup": Case("platoon-catchup", platoon),
    "platoon-slowdown": Case("platoon-slowdown", platoon),
    "quads-planar": Case(
        "quads-planar", quads("quads-planar"), lambda e: e[:, np.array([0, 1, 4, 2, 3, 5])]
    ),
    "quads-space": Case("quads-space", quads("quads-space")),
    "consensus": Case("consensus", consensus),
    "consensus-unstable": Case("consensus-unstable", consensus),
    "estimation": Case("estimation", estimation),
    "frequency": Case("frequency", frequency),
    "ring": Case("ring", ring("ring"), lambda e: e.reshape(-1, 2)),
    "ring2": Case("ring2", ring("ring2"), lambda e: e.reshape(-1, 2)),
    "coverage": Case("coverage", coverage),
    "coverage-bump": Case("coverage-bump", coverage),
    "flock": Case("flock", flock),
    "gnn-flock": Case("gnn-flock", gnn_flock),
    "voltage13": Case("voltage13", voltage(2, 7, 9)),
    "voltage33": Case("voltage33", voltage(12, 17, 21, 24, 28, 32)),
}


def loaded(name):
    return json.loads((Path(__file__).parent / "golden" / f"{name}.json").read_text())


def played(name, kind):
    """The states, costs, failures and last success of every trajectory, by the game."""
    case, game = CASES[name], TASKS[CASES[name].task]
    assert isinstance(game, AbstractRegulation)
    numbers = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, kind), tree)

    def one(start, actions):
        x, scenario, *memory = case.parts(start)
        begin = State(x=x, scenario=scenario, t=jnp.asarray(0), memory=(*memory, None)[0])

        def tick(state, action):
            after = game.step(state, action)
            return after, (after, game.costs(state, action), game.failed(after))

        last, (states, costs, failed) = jax.lax.scan(tick, begin, actions)
        return states.x, costs, failed, game.success(last), game.errors(last)

    trajectories = loaded(name)["trajectories"]
    starts = [array(t["start"], kind) for t in trajectories]
    run = jax.jit(one)
    return [
        run(s, numbers(np.array(t["actions"]))) for s, t in zip(starts, trajectories, strict=True)
    ]


def compared(name, kind, close):
    case = CASES[name]
    for told, seen in zip(loaded(name)["trajectories"], played(name, kind), strict=True):
        x, costs, failed, success, errors = seen
        states = [np.asarray(case.parts(array(s, kind))[0]) for s in told["next_states"]]
        agree(x, np.array(states), close)
        agree(costs, np.array(told["costs"]), close)
        assert np.array_equal(failed, told["failed"]), name
        assert bool(success) == told["success_at_end"], name
        want = np.array(told["errors_at_end"])
        got = np.asarray(case.errors(errors))
        if isinstance(TASKS[case.task], AbstractPlanar):  # in the world's frame there
            got, want = (np.linalg.norm(e[:, :2], axis=1) for e in (got, want))
        agree(got, want, close)


def agree(got, want, close):
    """Up to `close` of the largest number; where the oracle has none, NaN, ours is as good."""
    want = np.where(np.isnan(want), got, want)
    np.testing.assert_allclose(got, want, rtol=close, atol=close * (1 + np.abs(want).max()))


def array(tree, kind):
    """The numbers in the file, as arrays."""
    is_list = lambda x: isinstance(x, list)
    return jax.tree.map(lambda x: jnp.asarray(np.array(x), kind), tree, is_leaf=is_list)


@pytest.mark.parametrize("name", CASES)
def test_in_double_precision_to_a_billionth(name):
    with jax.enable_x64(True):
        compared(name, jnp.float64, 1e-9)


@pytest.mark.parametrize("name", CASES)
def test_in_single_precision_to_a_ten_thousandth(name):
    compared(name, jnp.float32, 1e-4)
