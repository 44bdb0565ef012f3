"""How often do the intervals and certificates cover what they are about?

    ./run python reliability/coverage.py            half an hour on one core; saves the results
    ./run python reliability/coverage.py --quick    seconds, to see that it works; saves nothing
    ./run python reliability/coverage.py --only intervals    intervals, exact or certificates

exact: the interval for the mean over training seeds (`statistics.mean_interval`) on every
distribution over three values of a grid, its coverage summed over all outcomes, without sampling.

intervals: the same interval, and the bootstraps that experiments/ uses, on simulated training
seeds: each has a success rate drawn from a known distribution and is measured on some episodes.

certificates: certificates are made again and again on a closed-form plant, each with its own
seed, and each claim is held against the truth, which is known from very many rollouts.

Everything is printed, and saved in reliability/results/coverage.json.
"""

import argparse
import itertools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap.certificates.basin import Basin
from marlyap.certificates.certificate import AbstractCertificate, Draw, Found, Verdict, judged
from marlyap.certificates.composition import Composition, _Windows, worst_excess
from marlyap.certificates.contraction import Contraction, rates
from marlyap.certificates.decrease import Decrease
from marlyap.certificates.loop import ClosedLoop
from marlyap.certificates.lyapunov import CostSum
from marlyap.certificates.quantiles import NAMES, Quantiles
from marlyap.certificates.reach import Reach, ReachAndStay
from marlyap.certificates.robustness import Robustness
from marlyap.certificates.safety import Apart, Safe
from marlyap.certificates.theorem1 import Theorem1, _Tuple
from marlyap.games.dynamics import AbstractDynamics, SingleIntegrator
from marlyap.games.perturbed import Perturbed, traced
from marlyap.games.planar import AbstractPlanar, Goals
from marlyap.runs.provenance import provenance
from marlyap.statistics import (
    iqm,
    lower_bound,
    mean_bound,
    mean_interval,
    probability_of_improvement,
    two_level_bootstrap,
)
from marlyap.storage import store
from marlyap.types import State


RESULTS = Path(__file__).parent / "results" / "coverage.json"
LEVEL = 0.95

# -------------------------------------------------------------------------------------------------
# Exact coverage of the interval for the mean
# -------------------------------------------------------------------------------------------------


def exact_coverage(values: tuple[float, ...], n: int, confidence: float, parts: int) -> float:
    """The least coverage of `mean_bound` for n draws, over distributions on these values.

    The probabilities are all multiples of 1 / parts; the multinomial is summed over every outcome.
    """
    counts = np.array([c for c in compositions(n, len(values))])
    bounds = np.array([mean_bound(np.repeat(values, c), confidence) for c in counts])
    ways = np.array([math.factorial(n) / math.prod(map(math.factorial, c)) for c in counts])
    weights = np.array([w for w in compositions(parts, len(values))]) / parts
    chances = ways * np.prod(weights[:, None, :] ** counts[None], axis=2)
    means = weights @ np.asarray(values)
    return float(np.min(np.sum(chances * (bounds >= means[:, None] - 1e-9), axis=1)))


def compositions(total: int, parts: int) -> list[tuple[int, ...]]:
    """All ways to write `total` as an ordered sum of `parts` numbers from 0."""
    bars = itertools.combinations(range(total + parts - 1), parts - 1)
    edges = [(-1, *bar, total + parts - 1) for bar in bars]
    return [tuple(b - a - 1 for a, b in itertools.pairwise(edge)) for edge in edges]


def exact(quick: bool) -> list[dict[str, Any]]:
    """The least coverage by the number of draws and the one-sided level."""
    sizes, steps, parts = ((1, 3), 2, 20) if quick else ((1, 2, 3, 5, 10), 20, 80)
    grid = np.linspace(0.0, 1.0, steps + 1)
    triples = [t for t in itertools.combinations(grid, 3) if quick or 0.0 in t or 1.0 in t]
    rows = []
    for n, confidence in itertools.product(sizes, (0.8, 0.975)):
        least = min((exact_coverage(t, n, confidence, parts), t) for t in triples)
        rows.append({"seeds": n, "asked": confidence, "least": least[0], "values": [*least[1]]})
        print(f"exact: {n} draws, asked {confidence:g}, at least {least[0]:.4f}", flush=True)
    return rows


# -------------------------------------------------------------------------------------------------
# Simulated coverage of intervals over training seeds
# -------------------------------------------------------------------------------------------------

# Success rates of training seeds as functions of a uniform number: their quantile functions.
RATES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "ones, one in ten 0": lambda u: (u >= 0.1).astype(float),
    "0.5 or 1": lambda u: np.where(u < 0.5, 0.5, 1.0),
    "uniform": lambda u: u,
    "ones, three in ten from 0.4": lambda u: np.where(u < 0.3, 0.4 + 2.0 * u, 1.0),
}
MIDDLES = (np.arange(200_000) + 0.5) / 200_000


def truth(rates: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
    """Expectation and interquartile mean of a distribution."""
    inner = (MIDDLES > 0.25) & (MIDDLES < 0.75)
    return float(rates(MIDDLES).mean()), float(rates(MIDDLES)[inner].mean())


def misses(
    rates: Callable[[np.ndarray], np.ndarray],
    seeds: int,
    repetitions: int,
    episodes: int,
    resamples: int,
    rng: np.random.Generator,
) -> dict[str, float]:
    """How often each interval at `LEVEL` lacks what it is about."""
    mean, middle = truth(rates)
    outside = lambda interval, value: not interval[0] - 1e-9 <= value <= interval[1] + 1e-9
    count: dict[str, int] = {}
    for k in range(repetitions):
        draw = lambda: rng.binomial(episodes, rates(rng.uniform(size=seeds)))
        hits, others = draw(), draw()
        counts = [np.repeat([1.0, 0.0], [h, episodes - h]) for h in hits]
        share = hits / episodes
        options = {"confidence": LEVEL, "resamples": resamples, "seed": k}
        found = {"exact, mean": outside(mean_interval(share, LEVEL), mean)}
        if seeds > 1:
            better = probability_of_improvement(share, others / episodes, **options).interval
            found |= {
                "percentile, mean": outside(percentile(share, np.mean, **options), mean),
                "percentile, iqm": outside(percentile(share, iqm, **options), middle),
                "two-level, mean": outside(two_level_bootstrap(counts, np.mean, **options), mean),
                "two-level, iqm": outside(two_level_bootstrap(counts, iqm, **options), middle),
                "probability of improvement": outside(better, 0.5),
            }
        for name, missed in found.items():
            count[name] = count.get(name, 0) + missed
    return {name: missed / repetitions for name, missed in count.items()}


def percentile(
    share: np.ndarray,
    statistic: Callable[[np.ndarray], Any],
    confidence: float,
    resamples: int,
    seed: int,
) -> np.ndarray:
    """The usual bootstrap: quantiles of the statistic over seeds drawn with replacement."""
    drawn = np.random.default_rng(seed).integers(len(share), size=(resamples, len(share)))
    return np.quantile(
        [statistic(share[row]) for row in drawn], [(1 - confidence) / 2, (1 + confidence) / 2]
    )


def intervals(quick: bool) -> list[dict[str, Any]]:
    """Coverage by distribution, number of seeds and method."""
    repetitions, episodes, resamples = (40, 20, 100) if quick else (1000, 100, 400)
    rng, rows = np.random.default_rng(0), []
    for (name, drawn), seeds in itertools.product(RATES.items(), (1, 3, 5, 10, 20)):
        missed = misses(drawn, seeds, repetitions, episodes, resamples, rng)
        rows.append(
            {"rates": name, "seeds": seeds, "repetitions": repetitions}
            | {"covered": {method: 1 - share for method, share in missed.items()}}
        )
        said = ", ".join(f"{method} {1 - share:.3f}" for method, share in missed.items())
        print(f"{name}, {seeds} seeds: {said}", flush=True)
    return rows


def above(missed: int, trials: int, allowed: float) -> bool:
    """Whether so many misses are too many for their allowed share, at 1 - 1e-4."""
    return float(lower_bound(missed, trials, 1 - 1e-4)) > allowed


# -------------------------------------------------------------------------------------------------
# Simulated coverage of sampled certificates
# -------------------------------------------------------------------------------------------------

ASKED = 0.9  # confidence of each certificate
TRUTH = 1_000_000  # seed of the rollouts that the truth is known from


class Ray(AbstractPlanar):
    """Points that keep their bearing from the goal, which alone says how fast they come or go.

    x_{t+1} = (1 - rate(bearing)) x_t + dt u, so that where a point is at any time is closed-form.
    """

    agents: int = 2
    leaders: tuple[int, ...] = (0,)
    graph: str = "complete"
    radius: float = 0.1
    dt: float = 0.1
    horizon: int = 40
    dynamics: AbstractDynamics = SingleIntegrator()
    slowest: float = -0.01  # rate of the slowest bearing, from which points go away

    def reset(self, key):
        x = jax.random.uniform(key, (self.agents, 2), minval=-1.0, maxval=1.0)
        return State(x=x, scenario=Goals(jnp.zeros((self.agents, 2))), t=jnp.asarray(0))

    def observe(self, state, links):
        return state.x

    def step(self, state, action):
        bearing = jnp.arctan2(state.x[:, 1], state.x[:, 0]) / (2 * jnp.pi) + 0.5
        rate = self.slowest + 0.27 * bearing[:, None]
        x = (1 - rate) * state.x + 0.05 * self.dt * action
        return State(x=x, scenario=state.scenario, t=state.t + 1, memory=state.memory)

    def violations(self, state):
        return self.crowded(state, 0.02)


class Idle(eqx.Module):
    """Do nothing."""

    def __call__(self, state, key):
        return jnp.zeros(state.x.shape)


GAME, IDLE = Ray(), Idle()
V = CostSum(controller=IDLE, T=10, ball=0.05)
COMING = Ray(slowest=0.03)  # where no agent goes away, so that there is a basin
# Each kind, small; what is claimed is a share, whose truth is that of the claim's own level.
FEW = {"rollouts": 200, "share": 0.2, "confidence": ASKED}
CHOSEN = FEW | {"calibration": 200, "share": 0.9}
KINDS: dict[str, AbstractCertificate] = {
    "reach": Reach(**FEW),
    "reach-and-stay": ReachAndStay(**FEW),
    "decrease": Decrease(**FEW),
    "safe": Safe(**FEW),
    "contraction": Contraction(**CHOSEN),
    "apart": Apart(**CHOSEN),
    "basin": Basin(**CHOSEN),
    "quantiles": Quantiles(rollouts=200, q=0.9, confidence=ASKED),
    "composition": Composition(**CHOSEN),
    "theorem1": Theorem1(**FEW, noise=0.1),
    "robustness": Robustness(
        **FEW, gains=(), noises=(1.0,), delays=(), drops=(), spreads=(0.7, 1.5), remove=False
    ),
}


def seen(judge: Any, steps: int, rollouts: int, game: AbstractPlanar = GAME) -> Found:
    """What a certificate's judge makes of very many rollouts."""
    return judged(judge, ClosedLoop(game, IDLE, V), Draw(TRUTH, "certify", rollouts), steps)


def truths(rollouts: int) -> dict[str, Callable[[Verdict], bool]]:
    """For each kind of certificate: whether what a verdict claims is true."""
    H = GAME.horizon
    late = H + 40

    def share(judge: Any, steps: int) -> Callable[[Verdict], bool]:
        true = float(np.mean(seen(judge, steps, rollouts).holds))
        return lambda v: v.bound <= true

    falls = rates(seen(KINDS["contraction"].judge, H + 1, rollouts))  # pyright: ignore
    gaps = seen(KINDS["apart"].judge, late, rollouts).figures["gap"]  # pyright: ignore
    inside = seen(KINDS["basin"].judge, H + max(40, V.beyond), rollouts, COMING)  # pyright: ignore
    ends = seen(KINDS["quantiles"].judge, H + V.beyond, rollouts).figures  # pyright: ignore
    C = Composition()
    windows = seen(_Windows(C.T), late + C.T, rollouts // 4, COMING).figures["V"]
    one = _Tuple(IDLE, None, KINDS["theorem1"].noise)  # pyright: ignore
    tuples = seen(one, H + V.beyond, rollouts).figures
    curve = {
        name: float(np.mean(seen(Reach().judge, H, rollouts, perturbed(change)).holds))
        for name, change in KINDS["robustness"].perturbations(GAME).items()  # pyright: ignore
    }

    def basin(v: Verdict) -> bool:
        below = inside.figures["V"] <= v.figures["level"]
        low, high = v.figures["mass"]
        known = not below.any() or v.bound <= np.mean(inside.holds[below])
        return known and low <= np.mean(below) <= high

    def quantiles(v: Verdict) -> bool:
        bounds = v.figures["bounds"]
        return all(np.mean(ends[name] <= bounds[name]) >= v.figures["q"] for name in NAMES)

    def composition(v: Verdict) -> bool:
        M, delta = (np.asarray(v.figures[name]) for name in ("M", "delta"))
        return v.bound <= np.mean(worst_excess(windows, M, delta, C.T) <= 0)

    def theorem1(v: Verdict) -> bool:
        excess = tuples["next_V"] - tuples["V"]
        excess = excess + v.figures["l_L"] * v.figures["l_f"] * tuples["moved"]
        return v.bound <= np.mean((excess <= 0)[tuples["outside"] > 0])

    robust = lambda v: all(p["bound"] <= curve[p["perturbation"]] for p in v.figures["curve"])
    return {
        "reach": share(Reach().judge, H),
        "reach-and-stay": share(ReachAndStay().judge, late),
        "decrease": share(KINDS["decrease"].judge, H + V.beyond),  # pyright: ignore
        "safe": share(Safe().judge, late),
        "contraction": lambda v: v.bound <= np.mean(falls >= v.figures["beta"]),
        "apart": lambda v: v.bound <= np.mean(gaps >= v.figures["gap"]),
        "basin": basin,
        "quantiles": quantiles,
        "composition": composition,
        "theorem1": theorem1,
        "robustness": robust,
    }


def perturbed(change: dict[str, Any]) -> AbstractPlanar:
    return traced(Perturbed(inner=GAME, **change))


def certificates(quick: bool) -> list[dict[str, Any]]:
    """How often each kind of certificate claims what is not true."""
    count, rollouts = (40, 5_000) if quick else (1000, 200_000)
    true, rows = truths(rollouts), []
    for name, certificate in KINDS.items():
        game = COMING if name in ("basin", "composition") else GAME
        verdicts = [certificate.check(ClosedLoop(game, IDLE, V), seed) for seed in range(count)]
        claims = [v for v in verdicts if v.bound is not None]  # others claim nothing
        wrong = sum(not true[name](v) for v in claims)
        about = {"kind": name, "certificates": count, "claims": len(claims)}
        rows.append(about | {"asked": ASKED, "wrong": int(wrong)})
        print(f"{name}: {wrong} of {len(claims)} are wrong, {1 - ASKED:.0%} may be", flush=True)
    return rows


# -------------------------------------------------------------------------------------------------
# The command line
# -------------------------------------------------------------------------------------------------

PARTS: dict[str, Callable[[bool], list[dict[str, Any]]]] = {
    "exact": exact,
    "intervals": intervals,
    "certificates": certificates,
}


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--only", choices=list(PARTS), nargs="+", default=list(PARTS))
    p.add_argument("--quick", action="store_true", help="seconds; saves nothing")
    args = p.parse_args()
    found = {name: PARTS[name](args.quick) for name in args.only}
    if not args.quick:
        kept = store.read_json(RESULTS) if RESULTS.is_file() else {}
        RESULTS.parent.mkdir(exist_ok=True)
        text = json.dumps(kept | found | {"made": provenance()}, indent=1) + "\n"
        store.write_text_atomic(RESULTS, text)


if __name__ == "__main__":
    main()
