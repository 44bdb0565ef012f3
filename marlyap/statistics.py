"""Intervals and tests for what was counted or scored: exact where one exists, else bootstrapped."""

import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts are loaded when they are first used

from marlyap.errors import UserError


# These functions say themselves what is wrong with their arguments, in one sentence.
Counts = Any  # int, float or Num["..."]
Reals = Any  # float, or Float["..."] where arrays went in

_BLOCK = 4_000_000  # Most episode draws held in memory at once by the two-level bootstrap.


class StatisticsError(UserError, ValueError):
    """Bad input to a function of this module; also a ValueError."""


class Interval(NamedTuple):
    """The two ends of a confidence interval: floats, or arrays of one shape."""

    low: Reals
    high: Reals


class PairedTest(NamedTuple):
    """Pairs that only a won, pairs that only b won, and the two-sided p-value."""

    only_a: int
    only_b: int
    p_value: float


class Improvement(NamedTuple):
    """The estimate of P(a > b) + P(a = b) / 2, and its interval."""

    probability: float
    interval: Interval


def _fraction(name: str, value: Any) -> float:
    if not 0.0 < value < 1.0:  # Written so that NaN fails too.
        raise StatisticsError(f"{name} must lie strictly between 0 and 1, but is {value}.")
    return float(value)


def _positive_integer(name: str, value: Any) -> int:
    try:
        whole = operator.index(value)
    except TypeError:
        whole = 0
    if whole < 1:
        raise StatisticsError(f"{name} must be a whole number of at least 1, but is {value}.")
    return whole


def _whole_numbers(name: str, value: Counts) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "iuf":
        raise StatisticsError(f"{name} must be whole numbers, but has type {array.dtype}.")
    array = array.astype(float)
    if not np.all(np.isfinite(array) & (array == np.floor(array))):
        raise StatisticsError(f"{name} must be whole numbers, without NaN or infinity.")
    return array


def _counts(successes: Counts, trials: Counts) -> tuple[np.ndarray, np.ndarray]:
    k, n = _whole_numbers("successes", successes), _whole_numbers("trials", trials)
    try:
        k, n = np.broadcast_arrays(k, n)
    except ValueError:
        raise StatisticsError(
            f"successes and trials must broadcast, but have shapes {k.shape} and {n.shape}."
        ) from None
    if np.any(n < 1):
        raise StatisticsError("trials must be at least 1.")
    if np.any((k < 0) | (k > n)):
        raise StatisticsError("successes must lie between 0 and trials.")
    return k, n


def _numbers(name: str, value: Any, ndim: int | None, least: int, finite: bool) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise StatisticsError(f"{name} must be a rectangular array of real numbers.") from None
    if ndim is not None and array.ndim != ndim:
        raise StatisticsError(f"{name} must have {ndim} dimension(s), but has {array.ndim}.")
    if array.size == 0 or (array.ndim and len(array) < least):
        raise StatisticsError(f"{name} must hold at least {least} value(s) on its first axis.")
    if np.any(np.isnan(array)) or (finite and np.any(np.isinf(array))):
        wanted = "finite" if finite else "free of NaN"
        raise StatisticsError(f"{name} must be {wanted}.")
    return array


def _scalar(array: Any) -> Any:
    return float(array) if np.ndim(array) == 0 else array


def _lower(k: np.ndarray, n: np.ndarray, tail: float) -> Reals:
    inner = scipy.special.betaincinv(np.maximum(k, 1.0), n - k + 1.0, tail)
    return _scalar(np.where(k == 0, 0.0, inner))


def _upper(k: np.ndarray, n: np.ndarray, tail: float) -> Reals:
    inner = scipy.special.betainccinv(k + 1.0, np.maximum(n - k, 1.0), tail)
    return _scalar(np.where(k == n, 1.0, inner))


def _percentiles(replicates: np.ndarray, confidence: Any) -> Interval:
    tail = (1.0 - confidence) / 2.0
    low, high = np.quantile(replicates, [tail, 1.0 - tail])
    return Interval(float(low), float(high))


def lower_bound(successes: Counts, trials: Counts, confidence: Any) -> Reals:
    """Exact one-sided lower confidence bound on a success probability.

    The p at which P(X >= successes) equals 1 - confidence; 0 when successes = 0.

    Arguments: successes and trials, whole numbers or arrays that broadcast to one shape "*batch";
    confidence in (0, 1). Returns a float, or Float["*batch"].
    Raises: StatisticsError (a UserError and a ValueError) unless 0 <= successes <= trials,
    trials >= 1, all are whole numbers, and 0 < confidence < 1.
    Source: Clopper and Pearson, "The use of confidence or fiducial limits illustrated in the case
    of the binomial", Biometrika 26, 1934.
    """
    k, n = _counts(successes, trials)
    return _lower(k, n, 1.0 - _fraction("confidence", confidence))


def clopper_pearson(successes: Counts, trials: Counts, confidence: Any = 0.95) -> Interval:
    """Exact two-sided interval on a success probability, with (1 - confidence) / 2 in each tail.

    Arguments, shapes, errors raised and source are those of `lower_bound`; both ends of the
    returned Interval have the broadcast shape "*batch". For a claim about one side only, such as
    "at most 1e-3 fail", `lower_bound` is the tighter one.
    """
    k, n = _counts(successes, trials)
    tail = (1.0 - _fraction("confidence", confidence)) / 2.0
    return Interval(_lower(k, n, tail), _upper(k, n, tail))


def trials_needed(epsilon: Any, confidence: Any) -> int:
    """The fewest trials, all without failure, that bound the failure probability by epsilon.

    The smallest n with (1 - epsilon) ** n <= 1 - confidence, where
    `lower_bound(n, n, confidence)` first reaches 1 - epsilon.

    Arguments: epsilon and confidence, floats in (0, 1).
    Raises: StatisticsError (a UserError and a ValueError) when either is outside (0, 1).
    Source: Clopper and Pearson, Biometrika 26, 1934, at zero failures.
    """
    epsilon, confidence = _fraction("epsilon", epsilon), _fraction("confidence", confidence)
    ratio = math.log1p(-confidence) / math.log1p(-epsilon)
    # The slack keeps a ratio that is whole in decimals, as at (0.9, 0.99), from rounding up by one.
    return max(1, math.ceil(ratio * (1.0 - 1e-12)))


def mcnemar(a: Any, b: Any) -> PairedTest:
    """Exact two-sided test that two methods succeed equally often on the same n cases.

    Only the pairs where the two differ count: under the null, each falls to a with probability 1/2.

    Arguments: a and b, Bool["n"], the success of each method on case i.
    Returns only_a, only_b and the p-value, which is 1 when no pair differs.
    Raises: StatisticsError (a UserError and a ValueError) unless a and b are boolean vectors of one
    length of at least 1.
    Source: McNemar, Psychometrika 12, 1947; the exact form is in Fagerland, Lydersen and Laake,
    BMC Medical Research Methodology 13:91, 2013.
    """
    a, b = np.asarray(a), np.asarray(b)
    if a.dtype != bool or b.dtype != bool:
        raise StatisticsError(f"a and b must be boolean, but are {a.dtype} and {b.dtype}.")
    if a.ndim != 1 or a.shape != b.shape or a.size == 0:
        raise StatisticsError(
            f"a and b must be vectors of one length of at least 1, not {a.shape} and {b.shape}."
        )
    only_a, only_b = int(np.sum(a & ~b)), int(np.sum(b & ~a))
    tail = scipy.special.bdtr(min(only_a, only_b), only_a + only_b, 0.5)
    return PairedTest(only_a, only_b, min(1.0, 2.0 * float(tail)))


def iqm(scores: Any) -> float:
    """Interquartile mean of all the scores together.

    As rliable does with `scipy.stats.trim_mean(scores, 0.25, axis=None)`, it drops the floor(n / 4)
    lowest and as many of the highest values whole, and weighs the rest alike; no value at the
    quartile gets a fractional weight. So 3 or fewer scores give the plain mean.

    Arguments: scores, finite, of any shape, such as Float["run task"].
    Raises: StatisticsError (a UserError and a ValueError) when scores is empty or not finite.
    Source: Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
    NeurIPS 2021.
    """
    ordered = np.sort(_numbers("scores", scores, None, 1, finite=True), axis=None)
    cut = ordered.size // 4
    return float(ordered[cut : ordered.size - cut].mean())


def two_level_bootstrap(
    outcomes: Any,
    statistic: Callable[[Any], float] = iqm,
    confidence: Any = 0.95,
    resamples: Any = 2000,
    seed: Any = 0,
) -> Interval:
    """Percentile bootstrap interval that resamples training seeds, then episodes within each.

    A seed drawn twice gets fresh episodes each time. Replacement at both levels counts the
    within-seed variance about twice, so the interval errs wide when the seeds hardly differ.

    Arguments: outcomes, finite, Float["seed episode"] or one Float["episode"] for each seed, with
    lengths that may differ, and at least 2 seeds; statistic, from the per-seed means Float["seed"]
    to a float; confidence in (0, 1); resamples, at least 1; seed of the resampling.
    Raises: StatisticsError (a UserError and a ValueError) when an argument breaks these limits.
    Source: Davison and Hinkley, "Bootstrap methods and their application", 1997, section 3.8.
    """
    groups = [_numbers("outcomes of a seed", group, 1, 1, finite=True) for group in outcomes]
    if len(groups) < 2:
        raise StatisticsError(f"outcomes must hold at least 2 seeds, but hold {len(groups)}.")
    confidence = _fraction("confidence", confidence)
    resamples, rng = _positive_integer("resamples", resamples), np.random.default_rng(seed)
    picks = rng.integers(len(groups), size=(resamples, len(groups)))
    means = np.empty(picks.shape)
    for index, group in enumerate(groups):
        where = np.flatnonzero(picks == index)
        for part in np.array_split(where, 1 + where.size * group.size // _BLOCK):
            draws = rng.integers(group.size, size=(part.size, group.size))
            means.flat[part] = group[draws].mean(axis=1)
    return _percentiles(np.asarray([float(statistic(row)) for row in means]), confidence)


def probability_of_improvement(
    a: Any,
    b: Any,
    confidence: Any = 0.95,
    resamples: Any = 2000,
    seed: Any = 0,
) -> Improvement:
    """How likely a random run of a scores above a random run of b, ties counted as one half.

    The interval is a percentile bootstrap over the runs of a and of b, drawn independently. When
    the samples do not overlap it shrinks to a point, which is no certainty.

    Arguments: a, Float["seed_a"], and b, Float["seed_b"], at least 2 scores each, infinities
    allowed; confidence in (0, 1); resamples, at least 1; seed of the resampling.
    Raises: StatisticsError (a UserError and a ValueError) when an argument breaks these limits.
    Source: Agarwal et al., NeurIPS 2021; Mann and Whitney, Annals of Mathematical Statistics 18,
    1947.
    """
    a, b = _numbers("a", a, 1, 2, finite=False), _numbers("b", b, 1, 2, finite=False)
    confidence = _fraction("confidence", confidence)
    resamples, rng = _positive_integer("resamples", resamples), np.random.default_rng(seed)
    wins = (a[:, None] > b) + 0.5 * (a[:, None] == b)
    times_a = rng.multinomial(a.size, np.full(a.size, 1.0 / a.size), size=resamples)
    times_b = rng.multinomial(b.size, np.full(b.size, 1.0 / b.size), size=resamples)
    replicates = np.sum((times_a @ wins) * times_b, axis=1) / wins.size
    return Improvement(float(wins.mean()), _percentiles(replicates, confidence))


def mean_bound(values: Any, confidence: Any) -> float:
    """One-sided upper confidence bound on the expectation of values that lie in [0, 1].

    The `confidence` quantile of sum_i G_i x_(i), with x_(n+1) = 1 and G uniform on the simplex of
    n + 1 weights (Dirichlet(1, ..., 1)): what the mean would be if the distribution put random
    masses between the ordered values, always at the upper end of each gap. The density of that sum
    is a B-spline with the ordered values as its knots, so the quantile is found without sampling.
    For values of 0 and 1 it is the one-sided bound of Clopper and Pearson, and for one value
    Markov's inequality. For n > 1 and other values its coverage is conjectured, not proved; no
    counterexample is known, and reliability/coverage.py searches for one.

    Arguments: values, Float["n"], independent draws from one distribution on [0, 1]; confidence in
    (0, 1).
    Raises: StatisticsError (a UserError and a ValueError) when a value is outside [0, 1] or the
    confidence outside (0, 1).
    Source: Gaffke, "Three test statistics for a nonparametric one-sided hypothesis on the mean of a
    nonnegative variable", Mathematical Methods of Statistics 14, 2005; Learned-Miller and Thomas,
    "A new confidence interval for the mean of a bounded random variable", arXiv:1905.06208, 2020;
    Curry and Schoenberg, Journal d'Analyse Mathematique 17, 1966, for the B-spline.
    """
    confidence, knots = _fraction("confidence", confidence), _knots(values)
    if knots[0] == 1.0:
        return 1.0
    below = _mixture(knots)
    return float(scipy.optimize.brentq(lambda m: below(m) - confidence, knots[0], 1.0, xtol=1e-12))


def mean_covered(values: Any, mean: Any, confidence: Any) -> bool:
    """Whether `mean <= mean_bound(values, confidence)`, without finding the bound."""
    confidence, knots = _fraction("confidence", confidence), _knots(values)
    return bool(knots[0] >= mean or _mixture(knots)(mean) <= confidence)


def mean_interval(values: Any, confidence: Any = 0.95) -> Interval:
    """Interval for the expectation of values in [0, 1], with (1 - confidence) / 2 in each tail.

    No distribution is assumed and few values will do, so success rates of a handful of training
    seeds qualify: it is then about the expected rate of a policy trained with a new seed, on the
    starts that all of them were measured on. For values of 0 and 1 it is `clopper_pearson`.
    Arguments, errors raised, source and the state of its proof are those of `mean_bound`.
    """
    side = (1.0 + _fraction("confidence", confidence)) / 2.0
    values = _numbers("values", values, 1, 1, finite=True)
    return Interval(1.0 - mean_bound(1.0 - values, side), mean_bound(values, side))


def _knots(values: Any) -> np.ndarray:
    values = np.sort(_numbers("values", values, 1, 1, finite=True))
    if values[0] < 0.0 or values[-1] > 1.0:
        raise StatisticsError("values must lie between 0 and 1.")
    return np.append(values, 1.0)


def _mixture(knots: np.ndarray) -> Callable[[float], float]:
    """The distribution function of sum_i G_i knots_i, between two knots that differ."""
    density = scipy.interpolate.BSpline.basis_element(knots, extrapolate=False)
    total = density.antiderivative()
    scale = (len(knots) - 1) / (knots[-1] - knots[0])
    # A spline with a knot of full multiplicity at its right end has no value there.
    return lambda m: scale * float(total(m) - total(knots[0])) if m < knots[-1] else 1.0


def quantile_upper_bound(sample: Any, q: Any, confidence: Any) -> float:
    """Distribution-free one-sided upper confidence bound on the q-quantile.

    It is the j-th smallest value, for the smallest j with P(Binomial(n, q) <= j - 1) >= confidence,
    and infinity when n is too small for any j (n = 58 at q = confidence = 0.95, but not 59).

    Arguments: sample, Float["n"], independent, infinities allowed; q and confidence in (0, 1).
    Raises: StatisticsError (a UserError and a ValueError) when sample is empty, not a vector or
    holds NaN, or when q or confidence is outside (0, 1).
    Source: Wilks, "Determination of sample sizes for setting tolerance limits", Annals of
    Mathematical Statistics 12, 1941; David and Nagaraja, "Order statistics", 2003, section 7.1.
    """
    ordered = np.sort(_numbers("sample", sample, 1, 1, finite=False))
    q, confidence = _fraction("q", q), _fraction("confidence", confidence)
    covered = scipy.special.bdtr(np.arange(ordered.size, dtype=float), ordered.size, q)
    index = int(np.searchsorted(covered, confidence, side="left"))
    return float(ordered[index]) if index < ordered.size else math.inf


def bonferroni(confidence: Any, claims: Any) -> float:
    """The confidence each of several claims needs for all to hold together at `confidence`.

    Arguments: confidence in (0, 1); claims, a whole number from 1. Returns a float in (0, 1).
    Raises: StatisticsError (a UserError and a ValueError) when either breaks its limit.
    Source: Dunn, "Multiple comparisons among means", JASA 56, 1961.
    """
    share = (1.0 - _fraction("confidence", confidence)) / _positive_integer("claims", claims)
    return 1.0 - share
