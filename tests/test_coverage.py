"""Intervals and certificates hold what they promise: the quick forms of reliability/coverage.py."""

import importlib.util
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats


ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def coverage():
    """Loaded from its file: a package of the same name measures which lines tests run."""
    place = ROOT / "reliability" / "coverage.py"
    spec = importlib.util.spec_from_file_location("reliability_coverage", place)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_mean_bound_covers_every_distribution_on_three_values(coverage, capsys):
    rows = coverage.exact(quick=True)
    assert len(rows) == 4 and all(row["least"] >= row["asked"] for row in rows)


@pytest.mark.slow
def test_the_mean_bound_covers_every_distribution_on_three_values_of_a_fine_grid(coverage):
    rows = coverage.exact(quick=False)
    assert all(row["least"] >= row["asked"] - 1e-9 for row in rows)


def test_the_sum_over_all_outcomes_is_the_binomial_one(coverage):
    for n, confidence in ((4, 0.9), (9, 0.975)):
        p = np.arange(41)[:, None] / 40
        k = np.arange(n + 1)
        covered = stats.beta.ppf(confidence, k + 1, np.maximum(n - k, 1e-9)) >= p - 1e-9
        covered[:, -1] = True
        least = np.min(np.sum(stats.binom.pmf(k, n, p) * covered, axis=1))
        found = coverage.exact_coverage((0.0, 1.0), n, confidence, 40)
        assert found == pytest.approx(least, abs=1e-9)


def test_the_interval_over_seeds_covers_and_the_bootstrap_does_not(coverage):
    """With too few repetitions to prove a level, a method that misses a third of them is seen."""
    rng, missed = np.random.default_rng(1), {}
    for (name, rates), seeds in itertools.product(coverage.RATES.items(), (1, 3, 5, 10, 20)):
        found = coverage.misses(rates, seeds, 40, 20, 60, rng)
        missed[name, seeds] = found
        assert not coverage.above(round(40 * found["exact, mean"]), 40, 1 - coverage.LEVEL)
    rare = missed["ones, one in ten 0", 5]["two-level, mean"]
    assert coverage.above(round(40 * rare), 40, 1 - coverage.LEVEL)


def test_the_truth_about_simulated_seeds(coverage):
    found = {name: coverage.truth(rates) for name, rates in coverage.RATES.items()}
    assert found["uniform"] == pytest.approx((0.5, 0.5), abs=1e-4)
    assert found["ones, one in ten 0"] == pytest.approx((0.9, 1.0), abs=1e-4)
    assert found["0.5 or 1"] == pytest.approx((0.75, 0.75), abs=1e-4)
    assert found["ones, three in ten from 0.4"] == pytest.approx((0.91, 0.995), abs=1e-3)


@pytest.mark.slow
def test_no_sampled_certificate_is_wrong_more_often_than_it_says(coverage):
    rows = {row["kind"]: row for row in coverage.certificates(quick=True)}
    assert rows.keys() == coverage.KINDS.keys()
    for row in rows.values():
        assert row["claims"] == 40, row
        assert not coverage.above(row["wrong"], row["claims"], 1 - row["asked"]), row


def test_a_certificate_that_claims_its_own_estimate_is_found_out(coverage):
    """Without a margin a claimed share is too high half of the time."""
    reach = coverage.KINDS["reach"]
    true = coverage.seen(reach.judge, coverage.GAME.horizon, 20_000).holds.mean()
    check = lambda seed: reach.check(
        coverage.ClosedLoop(coverage.GAME, coverage.IDLE, coverage.V), seed
    )
    verdicts = [check(seed) for seed in range(60)]
    assert coverage.above(sum(v.successes / v.trials > true for v in verdicts), 60, 0.1)


def test_the_published_figures_are_those_of_the_full_form(coverage):
    kept = json.loads(coverage.RESULTS.read_text())
    assert kept.keys() == {*coverage.PARTS, "made"}
    assert all(row["least"] >= row["asked"] - 1e-9 for row in kept["exact"])
    for row in kept["certificates"]:
        assert row["certificates"] == 1000 and row["claims"] > 900
        assert not coverage.above(row["wrong"], row["claims"], 1 - row["asked"]), row
    for row in kept["intervals"]:
        wrong = round(row["repetitions"] * (1 - row["covered"]["exact, mean"]))
        assert not coverage.above(wrong, row["repetitions"], 1 - coverage.LEVEL)
