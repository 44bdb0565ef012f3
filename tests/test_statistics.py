"""marlyap.statistics against published tables, scipy, and simulated coverage."""

import math

import numpy as np
import pytest
from scipy import stats

from marlyap import statistics
from marlyap.errors import UserError
from marlyap.statistics import (
    bonferroni,
    clopper_pearson,
    iqm,
    lower_bound,
    mcnemar,
    mean_bound,
    mean_covered,
    mean_interval,
    probability_of_improvement,
    quantile_upper_bound,
    trials_needed,
    two_level_bootstrap,
)


# Newcombe, Statistics in Medicine 17, 1998, table I (method 5), and the usual n = 10 table.
PUBLISHED = [
    # k, n, interval
    (81, 263, (0.2527, 0.3676)),
    (15, 148, (0.0578, 0.1617)),
    (0, 20, (0.0000, 0.1684)),
    (1, 29, (0.0009, 0.1776)),
    (0, 10, (0.0000, 0.3085)),
    (5, 10, (0.1871, 0.8129)),
    (10, 10, (0.6915, 1.0000)),
]
GRID = [(k, n) for n in (1, 2, 7, 12) for k in range(n + 1)] + [
    (499, 500),
    (3000, 3000),
    (17, 9999),
]
SHAPES = [(p, n) for p in (0.002, 0.1, 0.5, 0.83, 0.995) for n in (1, 10, 60, 1000)]
REPETITIONS = 10_000


def at_least(hits, confidence):
    """Whether simulated hits are consistent with coverage of at least `confidence`."""
    return stats.binom.cdf(np.sum(hits), np.size(hits), confidence) > 1e-4


# Proportions.


@pytest.mark.parametrize(("k", "n", "interval"), PUBLISHED)
def test_intervals_match_the_published_tables(k, n, interval):
    assert clopper_pearson(k, n) == pytest.approx(interval, abs=5.1e-5)


@pytest.mark.parametrize("confidence", [0.95, 0.999])
def test_intervals_match_scipy(confidence):
    k, n = np.transpose(GRID)
    low, high = clopper_pearson(k, n, confidence)
    for i, (ki, ni) in enumerate(GRID):
        theirs = stats.binomtest(ki, ni).proportion_ci(confidence, method="exact")
        assert (low[i], high[i]) == pytest.approx((theirs.low, theirs.high), abs=1e-9)


@pytest.mark.parametrize("confidence", [0.9, 0.999])
def test_the_one_sided_bound_matches_scipy(confidence):
    for k, n in GRID:
        greater = stats.binomtest(k, n, alternative="greater").proportion_ci(confidence)
        assert lower_bound(k, n, confidence) == pytest.approx(greater.low, abs=1e-9)


def test_bounds_solve_their_defining_equations():
    k, n = np.transpose(GRID)
    inside = (k > 0) & (k < n)
    k, n = k[inside], n[inside]
    low = lower_bound(k, n, 0.97)
    np.testing.assert_allclose(stats.binom.sf(k - 1, n, low), 0.03, rtol=1e-9)
    two = clopper_pearson(k, n, 0.94)  # 3% in each tail.
    np.testing.assert_allclose(two.low, low, rtol=1e-9)
    np.testing.assert_allclose(stats.binom.cdf(k, n, two.high), 0.03, rtol=1e-9)


@pytest.mark.parametrize(
    ("n", "at_5_percent", "at_1_permille"),
    [(500, 0.9940, 0.9863), (3000, 0.9990, 0.9977), (10000, 0.9997, 0.9993)],
)
def test_zero_failures(n, at_5_percent, at_1_permille):
    assert lower_bound(n, n, 0.95) == pytest.approx(at_5_percent, abs=5e-5)
    assert lower_bound(n, n, 0.999) == pytest.approx(at_1_permille, abs=5e-5)
    assert lower_bound(n, n, 0.95) == pytest.approx(0.05 ** (1 / n), rel=1e-12)


def test_ends_are_exact_at_no_and_at_all_successes():
    for n in (1, 3, 10, 997):
        assert lower_bound(0, n, 0.9) == 0.0
        assert clopper_pearson(0, n).low == 0.0 < clopper_pearson(0, n).high < 1.0
        assert 0.0 < clopper_pearson(n, n).low < clopper_pearson(n, n).high == 1.0


def test_scalars_give_floats_and_arrays_broadcast():
    assert all(type(end) is float for end in clopper_pearson(3, 10))
    assert all(type(end) is float for end in clopper_pearson(np.int64(3), 10.0))
    assert clopper_pearson(np.array([[1], [2]]), np.array([4, 5, 6])).high.shape == (2, 3)
    assert clopper_pearson(np.array([2, 3]), 9).low[1] == clopper_pearson(3, 9).low
    assert type(lower_bound(3, 10, 0.9)) is float
    assert lower_bound(np.array([0, 3]), 10, 0.9)[1] == lower_bound(3, 10, 0.9)


@pytest.mark.parametrize(
    ("epsilon", "confidence", "needed"),
    [
        (1e-3, 0.95, 2995),
        (1e-3, 0.999, 6905),
        (0.05, 0.95, 59),
        (0.5, 0.75, 2),  # Reached with equality.
        (0.9, 0.99, 2),  # Equality in decimals, as in the next two; not in binary.
        (0.3, 0.51, 2),
        (0.7, 0.91, 2),
        (0.5, 0.76, 3),
        (0.9, 0.1, 1),
    ],
)
def test_trials_needed(epsilon, confidence, needed):
    assert trials_needed(epsilon, confidence) == needed
    assert type(trials_needed(epsilon, confidence)) is int


def test_trials_needed_is_the_fewest():
    for epsilon in (0.3, 0.02, 1e-4):
        for confidence in (0.6, 0.95, 0.9999):
            n = trials_needed(epsilon, confidence)
            assert lower_bound(n, n, confidence) >= 1 - epsilon
            assert n == 1 or lower_bound(n - 1, n - 1, confidence) < 1 - epsilon


@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.999])
def test_exact_coverage_is_never_below_nominal(confidence):
    """Sum the binomial over every outcome, for 401 probabilities: no simulation error."""
    p = np.linspace(0.0, 1.0, 401)[:, None]
    for n in (1, 2, 5, 10, 40, 150):
        k = np.arange(n + 1)
        weight = stats.binom.pmf(k, n, p)
        low, high = clopper_pearson(k, n, confidence)
        two_sided = np.sum(weight * ((low <= p) & (p <= high)), axis=1)
        above = np.sum(weight * (lower_bound(k, n, confidence) <= p), axis=1)
        for coverage in (two_sided, above):
            assert coverage.min() >= confidence - 1e-9
        # Some p sits close to nominal, so the one-sided bound is not the two-sided one.
        if n >= 40:
            assert above.min() < confidence + (1 - confidence) / 4


@pytest.mark.parametrize("confidence", [0.9, 0.95, 0.999])
def test_simulated_coverage(confidence):
    rng = np.random.default_rng(1)
    for p, n in SHAPES:
        k = rng.binomial(n, p, size=REPETITIONS)
        seen, back = np.unique(k, return_inverse=True)
        low, high = clopper_pearson(seen, n, confidence)
        assert at_least(((low <= p) & (p <= high))[back], confidence)
        assert at_least((lower_bound(seen, n, confidence) <= p)[back], confidence)


@pytest.mark.parametrize("function", [clopper_pearson, lower_bound])
@pytest.mark.parametrize(
    ("k", "n", "says"),
    [
        (0, 0, "trials must be at least 1"),
        (0, -3, "trials must be at least 1"),
        (-1, 10, "between 0 and trials"),
        (11, 10, "between 0 and trials"),
        (math.nan, 10, "successes must be whole"),
        (1, math.nan, "trials must be whole"),
        (1, math.inf, "trials must be whole"),
        (1.5, 10, "successes must be whole"),
        ([1.0, 1.5], 10, "successes must be whole"),
        ("3", 10, "successes must be whole"),
        (True, 10, "successes must be whole"),
        (np.array([1, 2, 11]), 10, "between 0 and trials"),
        (np.array([1, 2]), np.array([5, 0]), "trials must be at least 1"),
        (np.array([1, 2]), np.array([5, 5, 5]), "must broadcast"),
    ],
)
def test_bad_counts(function, k, n, says):
    with pytest.raises(UserError, match=says) as caught:
        function(k, n, 0.95)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize("bad", [0.0, 1.0, -0.1, 95, math.nan])
def test_bad_fractions(bad):
    pair = np.array([1.0, 2.0])
    for call in (
        lambda: clopper_pearson(1, 2, bad),
        lambda: lower_bound(1, 2, bad),
        lambda: trials_needed(0.1, bad),
        lambda: bonferroni(bad, 2),
        lambda: quantile_upper_bound(pair, 0.5, bad),
        lambda: mean_interval([0.5], bad),
        lambda: mean_bound([0.5], bad),
        lambda: mean_covered([0.5], 0.5, bad),
        lambda: two_level_bootstrap([pair, pair], confidence=bad),
        lambda: probability_of_improvement(pair, pair, confidence=bad),
    ):
        with pytest.raises(UserError, match="confidence must lie strictly between 0 and 1"):
            call()
    with pytest.raises(UserError, match="epsilon must lie strictly"):
        trials_needed(bad, 0.95)
    with pytest.raises(UserError, match="q must lie strictly"):
        quantile_upper_bound(pair, bad, 0.95)


# Paired outcomes.


def paired(both, only_a, only_b, neither):
    counts = [both, only_a, only_b, neither]
    return np.repeat([True, True, False, False], counts), np.repeat(
        [True, False, True, False], counts
    )


@pytest.mark.parametrize(
    ("only_a", "only_b", "p"),
    [(0, 0, 1.0), (1, 0, 1.0), (0, 5, 0.0625), (6, 0, 0.03125), (2, 8, 0.109375), (4, 4, 1.0)],
)
def test_mcnemar_known_values(only_a, only_b, p):
    result = mcnemar(*paired(3, only_a, only_b, 2))
    assert result == (only_a, only_b, pytest.approx(p, rel=1e-12))
    assert type(result.only_a) is int
    assert type(result.p_value) is float


def test_mcnemar_matches_scipy():
    for only_a in range(0, 30, 3):
        for only_b in range(0, 30, 2):
            if only_a + only_b:
                expected = stats.binomtest(only_a, only_a + only_b).pvalue
                got = mcnemar(*paired(5, only_a, only_b, 1)).p_value
                assert got == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(
    ("a", "b", "says"),
    [
        (np.zeros(3), np.zeros(3, bool), "must be boolean"),
        (np.zeros(3, bool), np.zeros(3, int), "must be boolean"),
        (np.zeros(3, bool), np.zeros(4, bool), "one length"),
        (np.zeros(0, bool), np.zeros(0, bool), "one length"),
        (np.zeros((2, 2), bool), np.zeros((2, 2), bool), "one length"),
    ],
)
def test_mcnemar_bad_input(a, b, says):
    with pytest.raises(UserError, match=says):
        mcnemar(a, b)


# The mean of bounded values.


def test_the_mean_interval_is_clopper_pearson_for_zeros_and_ones():
    for confidence in (0.5, 0.95, 0.999):
        for k, n in [(0, 1), (1, 1), (2, 3), (5, 5), (0, 7), (9, 10), (13, 40), (199, 200)]:
            values = np.r_[np.ones(k), np.zeros(n - k)]
            expected = clopper_pearson(k, n, confidence)
            assert mean_interval(values, confidence) == pytest.approx(expected, abs=1e-9)


def test_the_mean_bound_is_the_quantile_of_randomly_weighted_values():
    rng = np.random.default_rng(13)
    for values in ([0.3], [0.2, 0.2, 0.9], rng.uniform(size=10), np.r_[np.ones(6), 0.5, 0.96]):
        weights = rng.dirichlet(np.ones(len(values) + 1), size=200_000)
        drawn = weights @ np.append(np.sort(values), 1.0)
        for confidence in (0.6, 0.975):
            bound = mean_bound(values, confidence)
            assert np.mean(drawn <= bound) == pytest.approx(confidence, abs=0.005)
            assert mean_covered(values, bound - 1e-6, confidence)
            assert not mean_covered(values, bound + 1e-6, confidence)


def test_the_mean_interval_of_one_value_is_markovs():
    for x in (0.0, 0.4, 1.0):
        assert mean_interval([x]) == pytest.approx((0.025 * x, 1 - 0.025 * (1 - x)))


def test_the_mean_interval_holds_the_mean_and_turns_with_its_values():
    rng = np.random.default_rng(14)
    for n in (1, 2, 5, 30, 300):
        values = rng.beta(5, 1, size=n)
        low, high = mean_interval(values)
        assert 0 <= low < values.mean() < high <= 1
        assert mean_interval(1 - values) == pytest.approx((1 - high, 1 - low))
        wide = mean_interval(values, 0.999)
        assert wide.low < low and high < wide.high
    assert mean_interval(np.ones(3)) == pytest.approx((0.025 ** (1 / 3), 1.0))


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ([], "at least 1"),
        ([[0.5]], "1 dimension"),
        ([1.1], "between 0 and 1"),
        ([-0.1, 0.5], "between 0 and 1"),
        ([math.nan], "finite"),
        (["a"], "real numbers"),
    ],
)
def test_mean_interval_bad_input(values, says):
    with pytest.raises(UserError, match=says):
        mean_interval(values)
    with pytest.raises(UserError, match=says):
        mean_bound(values, 0.9)


# Scores.


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([7.0], 7.0),
        ([0.0, 1.0, 100.0], 101.0 / 3),  # Too few to trim.
        ([100.0, 0.0, 3.0, 1.0], 2.0),
        ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 100.0], 4.0),  # One off each end, not 1.75.
        ([-50.0, 9.0, 1.0, 2.0, 4.0, 90.0, 8.0, -3.0], 15.0 / 4),
        ([[0.0, 10.0], [2.0, 4.0]], 3.0),
    ],
)
def test_iqm_of_known_vectors(scores, expected):
    assert iqm(np.array(scores)) == pytest.approx(expected, rel=1e-14)


def test_iqm_is_the_trim_mean_of_rliable():
    rng = np.random.default_rng(3)
    for n in range(1, 30):
        scores = rng.standard_cauchy((n, 3))
        assert iqm(scores) == pytest.approx(stats.trim_mean(scores, 0.25, axis=None), rel=1e-12)
        assert iqm(scores[:, 0]) == pytest.approx(stats.trim_mean(scores[:, 0], 0.25), rel=1e-12)


def mean(scores):
    return scores.mean()


def test_bootstraps_follow_their_seed():
    scores = np.random.default_rng(5).normal(size=(8, 8))
    first = two_level_bootstrap(scores, resamples=99, seed=1)
    assert first == two_level_bootstrap(scores, iqm, 0.95, 99, 1)
    assert first != two_level_bootstrap(scores, resamples=99, seed=2)
    first = probability_of_improvement(scores[0], scores[1], seed=1, resamples=99)
    assert first == probability_of_improvement(scores[0], scores[1], 0.95, 99, 1)


def test_two_level_bootstrap_has_the_variance_of_both_levels():
    rng = np.random.default_rng(6)
    for spread in (0.0, 0.3, 3.0):
        outcomes = rng.normal(size=(10, 12)) + spread * rng.normal(size=(10, 1))
        between, within = outcomes.mean(axis=1).var(), outcomes.var(axis=1).mean()
        half = stats.norm.ppf(0.95) * np.sqrt(between / 10 + within / (10 * 12))
        low, high = two_level_bootstrap(outcomes, mean, confidence=0.9, resamples=4000)
        assert (low, high) == pytest.approx(
            (outcomes.mean() - half, outcomes.mean() + half), abs=0.1 * half
        )


def test_two_level_bootstrap_takes_ragged_seeds_and_weighs_them_alike():
    ragged = [np.full(1, 0.0), np.full(50, 1.0), np.full(3, 2.0)]
    assert two_level_bootstrap(ragged, mean, resamples=300) == pytest.approx((0.0, 2.0), abs=0.34)
    assert two_level_bootstrap(ragged[1:2] * 4, resamples=9) == (1.0, 1.0)
    booleans = np.array([[True, False], [True, True], [False, False]])
    floats = booleans.astype(float)
    assert two_level_bootstrap(booleans, seed=3) == two_level_bootstrap(floats, seed=3)


def test_two_level_bootstrap_in_blocks(monkeypatch):
    outcomes = np.random.default_rng(7).normal(size=(5, 40))
    whole = two_level_bootstrap(outcomes)
    monkeypatch.setattr(statistics, "_BLOCK", 1000)
    assert two_level_bootstrap(outcomes) == pytest.approx(whole, abs=0.05)


def test_probability_of_improvement_of_known_vectors():
    a, b = np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.0, 5.0])
    assert probability_of_improvement(a, b).probability == pytest.approx(3 / 9)
    assert probability_of_improvement(b, a).probability == pytest.approx(6 / 9)
    assert probability_of_improvement(b + 9, a) == (1.0, (1.0, 1.0))
    assert probability_of_improvement(a, b + 9) == (0.0, (0.0, 0.0))
    infinite = np.array([math.inf, -math.inf])
    assert probability_of_improvement(infinite, infinite).probability == 0.5


def test_probability_of_improvement_matches_scipy_and_a_plain_bootstrap():
    rng = np.random.default_rng(8)
    a, b = rng.integers(0, 9, 14).astype(float), rng.integers(1, 12, 9).astype(float)
    result = probability_of_improvement(a, b, confidence=0.8, resamples=20_000)
    u = stats.mannwhitneyu(a, b).statistic
    assert result.probability == pytest.approx(u / (14 * 9), rel=1e-12)
    x, y = rng.choice(a, (20_000, 14, 1)), rng.choice(b, (20_000, 1, 9))
    plain = np.mean((x > y) + 0.5 * (x == y), axis=(1, 2))
    assert result.interval == pytest.approx(tuple(np.quantile(plain, [0.1, 0.9])), abs=0.01)


def test_bootstrap_coverage_is_near_nominal():
    rng = np.random.default_rng(9)
    level, shift = 0.9, 0.5
    hits = {"two levels": [], "improvement": []}
    for seed in range(100):
        success = rng.beta(4, 4, (20, 1))
        low, high = two_level_bootstrap(
            rng.random((20, 50)) < success, iqm, level, resamples=120, seed=seed
        )
        hits["two levels"].append(low <= 0.5 <= high)
        a, b = rng.normal(shift, 1.0, 20), rng.normal(0.0, 1.0, 25)
        low, high = probability_of_improvement(a, b, level, resamples=120, seed=seed).interval
        hits["improvement"].append(low <= stats.norm.cdf(shift / np.sqrt(2)) <= high)
    for name, hit in hits.items():
        assert 0.79 <= np.mean(hit) <= 0.98, (name, np.mean(hit))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_scores_must_be_finite(bad):
    scores = np.array([[1.0, 2.0], [3.0, bad]])
    for call in (iqm, two_level_bootstrap):
        with pytest.raises(UserError, match="must be finite"):
            call(scores)


def test_bad_samples():
    pair = np.array([1.0, 2.0])
    for says, call in (
        ("at least 1 value", lambda: iqm(np.zeros(0))),
        ("rectangular", lambda: iqm([[1.0], [2.0, 3.0]])),
        ("real numbers", lambda: iqm(["high"])),
        ("at least 2 seeds", lambda: two_level_bootstrap(pair[None])),
        ("1 dimension", lambda: two_level_bootstrap(pair)),
        ("at least 1 value", lambda: two_level_bootstrap([pair, pair[:0]])),
        ("a must hold at least 2", lambda: probability_of_improvement(pair[:1], pair)),
        ("b must hold at least 2", lambda: probability_of_improvement(pair, pair[:1])),
        ("b must be free of NaN", lambda: probability_of_improvement(pair, pair * math.nan)),
        ("sample must hold at least 1", lambda: quantile_upper_bound(pair[:0], 0.5, 0.5)),
        ("sample must be free of NaN", lambda: quantile_upper_bound(pair * math.nan, 0.5, 0.5)),
        ("sample must have 1 dim", lambda: quantile_upper_bound(pair[None], 0.5, 0.5)),
        ("resamples", lambda: two_level_bootstrap([pair, pair], resamples=2.5)),
        ("resamples", lambda: two_level_bootstrap([pair, pair], resamples=0)),
        ("resamples", lambda: probability_of_improvement(pair, pair, resamples=-1)),
    ):
        with pytest.raises(UserError, match=says):
            call()


def test_bootstraps_take_two_runs():
    pair = np.array([1.0, 2.0])
    assert two_level_bootstrap(pair[:, None], resamples=200) == (1.0, 2.0)
    assert probability_of_improvement(pair, pair).interval == (0.0, 1.0)
    assert two_level_bootstrap(pair[:, None], resamples=1) is not None


# Quantiles and families of claims.


@pytest.mark.parametrize(("n", "rank"), [(59, 59), (92, 92), (93, 92), (123, 122), (124, 122)])
def test_quantile_bound_has_the_ranks_of_wilks(n, rank):
    """At 95%/95% the largest serves from n = 59, the second from 93 and the third from 124."""
    sample = np.random.default_rng(10).permutation(np.arange(1.0, n + 1))
    assert quantile_upper_bound(sample, 0.95, 0.95) == rank


def test_quantile_bound_edges():
    assert quantile_upper_bound(np.zeros(58), 0.95, 0.95) == math.inf
    # P(Binomial(3, 1/2) <= 1) is 1/2 exactly, so confidence 1/2 is reached and 0.51 is not.
    sample = np.array([3.0, 1.0, 2.0])
    assert quantile_upper_bound(sample, 0.5, 0.5) == 2.0
    assert quantile_upper_bound(sample, 0.5, 0.51) == 3.0
    assert quantile_upper_bound(sample, 0.5, 0.875) == 3.0
    assert quantile_upper_bound(sample, 0.5, 0.876) == math.inf
    late = np.array([4.0, math.inf, -math.inf, 5.0, math.inf])
    assert quantile_upper_bound(late, 0.5, 0.5) == 5.0
    assert quantile_upper_bound(late, 0.5, 0.9) == math.inf
    assert type(quantile_upper_bound(sample, 0.5, 0.5)) is float


def test_quantile_bound_is_the_smallest_rank_that_suffices():
    for n in (1, 4, 17, 80, 300):
        for q in (0.1, 0.5, 0.9):
            for confidence in (0.3, 0.9, 0.99):
                ranks = np.arange(1, n + 1)
                good = ranks[stats.binom.cdf(ranks - 1, n, q) >= confidence]
                expected = good[0] if good.size else math.inf
                assert quantile_upper_bound(ranks, q, confidence) == expected


def test_quantile_bound_coverage():
    rng = np.random.default_rng(11)
    for q, n, confidence in ((0.5, 15, 0.9), (0.9, 60, 0.95), (0.95, 59, 0.95), (0.99, 700, 0.99)):
        samples = np.sort(rng.exponential(size=(REPETITIONS // (10 if n > 100 else 1), n)))
        ranked = quantile_upper_bound(np.arange(n), q, confidence)
        bounds = samples[:, int(ranked)]
        assert bounds[0] == quantile_upper_bound(samples[0], q, confidence)
        assert at_least(bounds >= stats.expon.ppf(q), confidence)
    discrete = rng.integers(0, 4, size=(2000, 20))  # The 0.5-quantile of {0, 1, 2, 3} is 1.
    assert at_least([quantile_upper_bound(row, 0.5, 0.9) >= 1 for row in discrete], 0.9)


def test_bonferroni():
    assert bonferroni(0.95, 1) == pytest.approx(0.95, rel=1e-15)
    assert bonferroni(0.95, 5) == pytest.approx(0.99, rel=1e-15)
    assert bonferroni(0.9, np.int64(4)) == pytest.approx(0.975, rel=1e-15)
    for bad in (0, -1, 2.0, math.nan):
        with pytest.raises(UserError, match="claims must be a whole number of at least 1"):
            bonferroni(0.95, bad)
