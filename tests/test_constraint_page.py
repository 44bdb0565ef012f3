"""The constraint and the reading of docs/add-a-constraint.md do what the page says."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import filled
from test_docs import blocks

from marlyap.learning.constraints import Lyapunov
from marlyap.learning.constraints.readings import READINGS
from marlyap.nets.nets import Sample
from marlyap.runs import config


PAGE = Path(__file__).parents[1] / "docs" / "add-a-constraint.md"
CONSTRAINT, _, READING = blocks(PAGE)


@pytest.fixture(scope="module")
def page():
    names: dict = {"__name__": "page"}
    for block in (CONSTRAINT, READING):
        exec(compile(block, PAGE.name, "exec"), names)
    return names


def sample(action):
    zero = jnp.zeros(action.shape[:-1])
    return Sample(action, zero, zero)


def test_the_weight_follows_the_bound(page, shape, batch):
    """It rises where the agents' mean squared action exceeds the bound, and falls where not."""
    effort = float(jnp.mean(jnp.sum(batch.action**2, axis=2)))
    for bound, way in ((effort / 2, 1), (effort * 2, -1)):
        constraint = page["Effort"](bound=bound, rate=0.1)
        L = constraint.init(shape, jax.random.key(0))
        b = jax.tree.map(lambda x: x[0], batch)
        drawn = sample(batch.action)
        after, info = eqx.filter_jit(constraint.update)(L, batch, drawn, drawn, jnp.ones(()))
        assert np.sign(after.value) == way == np.sign(info["excess"])
        now = sample(b.action)
        want = np.exp(after.value) * (np.sum(np.asarray(b.action) ** 2) / 3 - bound)
        assert constraint.penalty(after, b, now, now) == pytest.approx(want, rel=1e-4, abs=1e-6)


def test_a_reading_is_a_class_and_a_line(page, shape, batch, monkeypatch):
    with pytest.raises(Exception, match="^reading: 'squared' is unknown; take one of han, "):
        Lyapunov(reading="squared")
    monkeypatch.setitem(READINGS, "squared", page["Squared"]())
    constraint = Lyapunov(reading="squared", weight=0.5)
    L = filled(constraint.init, shape, jax.random.key(0))
    found = 0
    for i in range(4):
        b = jax.tree.map(lambda x, i=i: x[i], batch)
        rise = float(constraint.rise(L, b, -b.action))
        got = constraint.penalty(L, b, sample(b.action), sample(-b.action))
        np.testing.assert_allclose(got, 0.5 * max(rise, 0.0) ** 2, rtol=1e-5)
        found += rise > 0
    assert found
    with pytest.raises(Exception, match="^function: 'norm' .* take function squares or a reading"):
        Lyapunov(reading="squared", function="norm")


def test_the_help_lists_every_reading():
    (note,) = (n for option, _, n in config.describe(Lyapunov(), "L") if option == "L.reading")
    assert note.endswith(f"one of {', '.join(READINGS)}")
