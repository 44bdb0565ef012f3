"""C7: a team's certificate put together from one function per agent; the route to many agents."""

import dataclasses
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are loaded when they are first used

from marlyap import graph as graphs
from marlyap.certificates.certificate import (
    AbstractCertificate,
    Claim,
    Draw,
    Evidence,
    Judgement,
    enough,
    judged,
    measured,
    of_share,
    percent,
    until_step,
)
from marlyap.games.game import AbstractRegulation


def claim(bound: float, rho: float, farthest: str, until: str) -> str:
    return (
        f"at least {percent(bound)} of starts obey the fitted inequalities between neighbours "
        f"(spectral radius {rho:.3f}) {until}; they pull every distance towards "
        f"at most {farthest} as long as they are obeyed, and nothing is said of later steps"
    )


class Composition(AbstractCertificate):
    """The team converges, from one function for each agent (statistical small gain).

    C7. With V_i the largest distance of agent i to its goal over the
    next T steps and M = diag(1 - a) + Gamma >= 0, Gamma_ij > 0 for neighbours j of i only:

        V_i(s_{t+T}) <= (1 - a_i) V_i(s_t) + sum_j Gamma_ij V_j(s_t) + delta_i  for all i, t   (*)
        rho(M) < 1  =>  limsup V <= (I - M)^-1 delta, componentwise (the ultimate bound).

    Two shapes of M are tried: all neighbours, and only those nearer to a leader, which makes M
    triangular, so that rho(M) is the largest 1 - a_i whatever the gains.

    M and delta come from one linear programme per agent on one set of rollouts, with delta enlarged
    by `slack`. With the confidence asked for, P[ (*) holds along the whole rollout ] >= bound on
    fresh rollouts; where (*) holds, the bound on V follows without any chance.
    """

    rollouts: int = 5_000
    calibration: int = 3_000
    T: int = 10  # steps
    stay: int = 40  # steps past the horizon that are judged
    weights: tuple[float, ...] = (0.01, 0.03, 0.1, 0.3, 1.0)  # price of a gain against delta
    slack: float = 0.2  # relative, on delta
    within: float | None = None  # largest ultimate bound worth claiming; None: the edge
    share: float = 0.9
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"

    def check(self, loop, seed):
        enough(self.rollouts, self.share, self.confidence)
        game, windows = loop.game, _Windows(self.T)
        steps = game.horizon + self.stay + self.T
        draw = lambda purpose, n: judged(windows, loop, Draw(seed, purpose, n), steps)
        data = draw("calibrate", self.calibration)
        M, delta, ultimate = self.fit(game, data.figures["V"][data.holds])
        rho = float(np.max(np.abs(np.linalg.eigvals(M)))) if np.isfinite(M).all() else np.inf
        found = draw("certify", self.rollouts)
        excess = worst_excess(found.figures["V"], M, delta, self.T)
        above = np.any(found.figures["V"][:, 0] > ultimate[None], axis=1)
        found = dataclasses.replace(
            found,
            holds=found.holds & (excess <= 0),
            badness=excess,
            figures={"excess": excess},
        )
        farthest = float(np.max(ultimate))
        within = game.edge if self.within is None else self.within
        far = measured(farthest, game.unit, 3)
        say = lambda bound: claim(bound, rho, far, until_step(steps, game.dt))
        what = Claim(
            "composition",
            say,
            steps,
            void=nothing_contracted(rho, far, int(above.sum()), len(above)),
            also=farthest <= within,
            figures={
                "rho": rho,
                "M": M.tolist(),
                "delta": delta.tolist(),
                "ultimate": ultimate.tolist(),
                "begin_above": int(above.sum()),
                "T": self.T,
            },
        )
        return of_share(self, loop, seed, found, what)

    def fit(
        self, game: AbstractRegulation, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M, delta and the ultimate bound, for the weight whose ultimate bound is the least."""
        N = game.agents
        best = np.full((N, N), np.inf), np.full(N, np.inf), np.full(N, np.inf)
        if len(values) == 0:
            return best
        hops = graphs.hops(game.adjacency, game.informed)
        upstream = game.adjacency & (hops[None, :] < hops[:, None])
        for linked in (upstream, game.adjacency):
            for weight in self.weights:
                rows = [fit_row(linked, values, self.T, i, weight) for i in range(N)]
                M = np.stack([row for row, _ in rows])
                delta = np.array([(1 + self.slack) * d for _, d in rows]) + 1e-6
                if not M.any() or np.max(np.abs(np.linalg.eigvals(M))) >= 1 - 1e-6:
                    continue
                ultimate = np.linalg.solve(np.eye(N) - M, delta)
                if np.max(ultimate) < np.max(best[2]):
                    best = M, delta, ultimate
        return best


def nothing_contracted(rho: float, farthest: str, above: int, rollouts: int) -> str | None:
    """Why the inequalities say nothing about a team that comes together; None where they do."""
    if rho == math.inf:
        return "nothing was contracted: no inequalities with a spectral radius below 1 were found"
    if 2 * above < rollouts:
        return (
            f"nothing was contracted: {above} of {rollouts} rollouts begin above the bound "
            f"of {farthest} that the inequalities give, and at least half have to"
        )
    return None


class _Windows(eqx.Module):
    """V_i of every agent at every time of a rollout."""

    T: int

    def __call__(self, game, V, trajectory, key) -> Judgement:
        distance = jax.vmap(game.distance)(trajectory.state)
        time = distance.shape[0] - self.T + 1
        window = jnp.arange(time)[:, None] + jnp.arange(self.T)[None, :]
        values = jnp.max(distance[window], axis=1)
        return Judgement(jnp.asarray(True), jnp.max(values[-1]), {"V": values})


def fit_row(
    linked: np.ndarray, values: np.ndarray, T: int, i: int, weight: float, rounds: int = 30
) -> tuple[np.ndarray, float]:
    """min delta + weight sum_j M_ij  so that (*) holds for agent i on all transitions.

    Of the millions of inequalities a handful binds: they are added as they turn out violated.
    """
    who = [i, *(int(j) for j in np.flatnonzero(linked[i]))]
    now = values[:, :-T][..., who].reshape(-1, len(who))
    ahead = values[:, T:, i].ravel()
    pick = np.linspace(0, len(ahead) - 1, min(500, len(ahead))).astype(int)
    cost = np.append(np.full(len(who), weight), 1.0)
    bounds = [(0.0, 0.98), *[(0.0, None)] * (len(who) - 1), (0.0, None)]
    solution = np.zeros(len(who) + 1)
    for _ in range(rounds):
        left = -np.column_stack([now[pick], np.ones(len(pick))])
        solved = scipy.optimize.linprog(cost, left, -ahead[pick], bounds=bounds, method="highs")
        solution = solved.x
        excess = ahead - now @ solution[:-1] - solution[-1]
        if np.max(excess) <= 1e-7:
            break
        pick = np.unique(np.append(pick, np.argsort(excess)[-200:]))
    delta = float(
        solution[-1] + max(0.0, float(np.max(ahead - now @ solution[:-1] - solution[-1])))
    )
    row = np.zeros(len(linked))
    row[who] = solution[:-1]
    return row, delta


def worst_excess(values: np.ndarray, M: np.ndarray, delta: np.ndarray, T: int) -> np.ndarray:
    """The largest violation of (*) along each rollout; infinite if there is no M."""
    if not np.isfinite(M).all():
        return np.full(len(values), np.inf)
    excess = values[:, T:] - values[:, :-T] @ M.T.astype(values.dtype) - delta[None, None]
    worst = np.max(excess, axis=(1, 2))
    return np.where(np.isnan(worst), np.inf, worst)
