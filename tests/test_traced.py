"""Numbers that a program is given: another value compiles nothing and computes the same."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from conftest import same

from marlyap import Schedule, Trainer, UserError
from marlyap.compute import export_cache
from marlyap.games.dynamics import SingleIntegrator
from marlyap.learning.algorithms import ALGORITHMS, APG, MASAC
from marlyap.learning.constraints import Lyapunov
from marlyap.learning.traced import AbstractTraced, is_traced, program, with_arrays
from marlyap.learning.training import row, stack, stacked
from marlyap.runs.run import begin
from marlyap.tasks import Rendezvous


GAME = Rendezvous(agents=2, horizon=4, dynamics=SingleIntegrator())
SCHEDULE = Schedule(
    steps=24, environments=2, steps_per_update=4, warmup=8, capacity=40, select_episodes=2
)
TINY = MASAC(actor_width=4, critic_width=4, batch=4, constraint=Lyapunov(horizon=2))


SMALL = {"apg": APG(actor_width=4), "masac": TINY}  # the first is compiled in a fifth of the time
OTHER = {
    "apg": {"rate_pi": 1e-3, "clip": 0.5, "ema_rate": 0.5},
    "masac": {"rate_Q": 1e-3, "gamma": 0.9, "tau": 0.1, "entropy": -1.0},
}
each = pytest.mark.parametrize("name", ["apg", pytest.param("masac", marks=pytest.mark.slow)])


def trainer(name="masac", **more):
    return Trainer(GAME, dataclasses.replace(SMALL[name], **more), SCHEDULE)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_what_is_traced_are_numbers_and_what_is_not_stays(name):
    algorithm = ALGORITHMS[name]
    made = with_arrays(algorithm)
    arrays = jax.tree.leaves(eqx.filter(made, eqx.is_array))
    assert arrays and all(x.shape == () and x.dtype == np.float32 for x in arrays)
    assert type(made) is type(algorithm) and with_arrays(made) is not made
    if isinstance(algorithm, AbstractTraced):
        assert {*algorithm.traced} <= {f.name for f in dataclasses.fields(algorithm)}
    assert same(with_arrays(made), made)  # again changes nothing


def test_a_path_says_whether_its_number_is_given():
    assert is_traced(TINY, "rate_Q") and is_traced(TINY, "constraint.decrease")
    assert not is_traced(TINY, "actor_width") and not is_traced(TINY, "constraint.ball")
    assert not is_traced(TINY, "constraint.weight")  # None: another program than with a number
    weighted = dataclasses.replace(TINY, constraint=Lyapunov(weight=0.5))
    assert is_traced(weighted, "constraint.weight") and program(weighted) != program(TINY)
    assert program(trainer(tau=0.1)) == program(trainer(tau=0.2)) != program(trainer(batch=8))


def trained(trainers, seed=3):
    carry = stack([begin(t, seed) for t in trainers])
    for _, after, _ in stacked(trainers).advance(carry):
        carry = after
    return [row(carry, i) for i in range(len(trainers))]


@pytest.fixture
def traces(monkeypatch, tmp_path):
    """Counts what is traced, with kept programs in an empty folder."""
    found = []
    monkeypatch.setenv(export_cache.FOLDER, str(tmp_path / "programs"))
    whole = export_cache.export.export
    monkeypatch.setattr(export_cache.export, "export", lambda f: found.append(f) or whole(f))
    return found


@each
def test_another_rate_traces_nothing_and_is_not_the_same_training(name, traces, monkeypatch):
    (first,) = trained([trainer(name)])
    count = len(traces)
    (again,) = trained([trainer(name)])
    (other,) = trained([trainer(name, **OTHER[name])])
    assert count == len(traces) == 3  # begin, iterate, select
    assert same(first, again) and not same(first, other)
    if name == "masac":
        monkeypatch.setenv(export_cache.FOLDER, "")
        assert same(trained([trainer(name, **OTHER[name])])[0], other)


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_cells_advance_together_as_they_do_with_one_rate(name, traces):
    a, b = trainer(name), trainer(name, **OTHER[name])
    both = trained([a, b])
    assert not same(both[0], both[1])
    for k, pair in enumerate(([a, a], [b, b])):  # the same batch mode, as the seeds of one cell
        alike = trained(pair)
        assert same(alike[0], alike[1]) and same(alike[0], both[k])


def test_runs_of_different_programs_do_not_advance_together():
    with pytest.raises(UserError, match="differ in more than numbers"):
        stacked([trainer(), trainer(batch=8)])
