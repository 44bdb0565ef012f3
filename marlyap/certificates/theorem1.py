"""Theorem 1 (section 3.2), repaired, on fresh tuples."""

from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap.certificate import (
    AbstractCertificate,
    Evidence,
    Judgement,
    Verdict,
    at_least,
    enough,
    judged,
    percent,
    scope,
    worst_of,
)
from marlyap.dynamics import AbstractDynamics, Unicycle
from marlyap.game import AbstractGame
from marlyap.layout import grad
from marlyap.lyapunov_function import Norm
from marlyap.rollout import Controller


def claim(bound: float, V: str) -> str:
    return (
        f"at least {percent(bound)} of the states met outside the ball, one of each rollout, "
        f"satisfy condition (13) for V, {V}; the theorem asks for all of them"
    )


class Theorem1(AbstractCertificate):
    """Let V be continuous, 0 on the target set, positive elsewhere and l_L-Lipschitz, and let
    f(s, .) be l_f-Lipschitz. If for every s with V(s) <= c, with alpha(V) = rate V,

        V(f(s, mu_old(s))) + l_L l_f |mu_new(s) - mu_old(s)| - V(s) <= -rate V(s)       (13)

    and one step cannot leave the region where V is Lipschitz, then {V <= c} is invariant under
    mu_new and, for rate > 0, in the basin of the target set. It needs no feasible mu_old and no
    optimality, and mu_old may differ from tuple to tuple.

    Here (13) is evaluated on one tuple per fresh rollout, at a time drawn at random, outside the
    ball: with the confidence asked for, P[ (13) ] >= bound. That is a share of states, not every
    state, so that the conclusion of the theorem does not follow from it. The new policy is the
    controller. The old one is `old`, or else its action plus noise. Actions are in physical units,
    distances those of the physical state. l_L is the largest gradient of V that was seen, an
    estimate from below (the evidence is then no more than observed), or V's spectral bound.
    """

    old: Controller | None = None
    noise: float = 0.0  # standard deviation, in units of the limits, if there is no `old`
    rate: float = 0.0
    lipschitz: Literal["spectral", "empirical"] = "empirical"
    rollouts: int = 5_000
    share: float = 0.98
    confidence: float = 0.999
    evidence: ClassVar[Evidence] = "statistical"
    asks_V: ClassVar[bool] = True

    def check(self, game, controller, V, seed):
        enough(self.rollouts, self.share, self.confidence)
        n, H = self.rollouts, game.horizon
        judge = _Tuple(controller, self.old, self.noise)
        before = judged(judge, game, controller, V, seed, "calibrate", n, H + V.beyond)
        found = judged(judge, game, controller, V, seed, "certify", n, H + V.beyond)
        fig = found.figures
        constants = self.constants(game, V, before.figures)
        l = constants[self.lipschitz] if self.lipschitz in constants else constants["empirical"]
        asked = fig["outside"] > 0
        excess = fig["next_V"] + l * constants["l_f"] * fig["moved"] - (1 - self.rate) * fig["V"]
        fine = found.holds & (excess <= 0)
        m, k = int(asked.sum()), int((fine & asked).sum())
        bound, shown = at_least(k, m, self.share, self.confidence)
        found = type(found)(fine, np.where(np.isnan(excess), np.inf, excess), fig)
        return Verdict(
            name="theorem1",
            claim=claim(bound, V.meaning),
            evidence=self.evidence if l == constants.get("spectral") else "observed",
            holds=shown,
            bound=bound,
            confidence=self.confidence,
            scope=scope(game, H) | {"tuples": "one per rollout, at a random time"},
            trials=m,
            successes=k,
            worst=worst_of(game, seed, "certify", found, asked) if m else None,
            figures=constants
            | {"share_asked": self.share, "l_L": l, "V": type(V).__name__}
            | {"margin_median": float(np.median(-excess[asked])) if m else None}
            | {"margin_worst": float(np.min(-excess[asked])) if m else None},
        )

    def constants(self, game: AbstractGame, V: Any, seen: dict[str, np.ndarray]) -> dict[str, Any]:
        """l_f, and l_L by each means there is, over the calibration's region."""
        speed, reach = float(np.nanmax(seen["speed"])), float(np.nanmax(seen["reach"]))
        out = {"l_f": l_f(game.dynamics, game.dt, speed), "speed": speed, "reach": reach}
        out["empirical"] = float(np.nanmax(seen["gradient"]))
        if isinstance(V, Norm):
            out["spectral"] = float(V.net.lipschitz()) * float(np.sqrt(1 + reach**2))
        return out


class _Tuple(eqx.Module):
    """Condition (13) at one state of a rollout, before the constants are known."""

    new: Controller
    old: Controller | None
    noise: float

    def __call__(self, game, V, trajectory, key) -> Judgement:
        k_time, k_noise = jax.random.split(key)
        t = (game.horizon * jax.random.uniform(k_time)).astype(int)
        state = jax.tree.map(lambda leaf: leaf[t], trajectory.state)
        new = self.new(state, jax.random.key(0))
        noisy = new + self.noise * jax.random.normal(k_noise, new.shape)
        old = jnp.clip(noisy if self.old is None else self.old(state, jax.random.key(0)), -1.0, 1.0)
        scale = jnp.asarray(game.dynamics.limits)[None]
        gradient = grad(lambda x: V.value(game, eqx.tree_at(lambda s: s.x, state, x)))(state.x)
        velocity = jax.vmap(game.dynamics.velocity)(state.x)
        speed = jnp.max(jnp.linalg.norm(velocity, axis=1)) + game.dt * jnp.max(scale)
        figures = {
            "V": V.value(game, state),
            "next_V": V.value(game, game.step(state, old)),
            "moved": jnp.linalg.norm((jnp.clip(new, -1.0, 1.0) - old) * scale),
            "gradient": jnp.linalg.norm(gradient),
            "speed": speed,
            "reach": jnp.max(game.distance(state)),
            "outside": (~game.success(state)).astype(float),
        }
        return Judgement(jnp.asarray(True), jnp.zeros(()), figures)


def l_f(dynamics: AbstractDynamics, dt: float, speed: float) -> float:
    """The Lipschitz constant of one step in physical inputs, for speeds after it up to `speed`.

    One semi-implicit step of the unicycle has the orthogonal columns ds'/da = (dt^2 h, 0, dt, 0)
    and ds'/dr = (dt^3 v' n, dt^2, 0, dt), so that it is sqrt(dt^2 + dt^4 + dt^6 v'^2) exactly. For
    the other dynamics, of which a step is linear in the input, the spectral norm of ds'/du. Of a
    team it is the largest.
    """
    if type(dynamics) is Unicycle and dynamics.integrator == "euler":
        return float(np.sqrt(dt**2 + dt**4 + dt**6 * speed**2))
    x = jnp.zeros(dynamics.dx)
    if isinstance(dynamics, Unicycle):
        x = x.at[3].set(speed)
    return float(np.linalg.norm(input_jacobian(dynamics, x, dt), 2))


def input_jacobian(dynamics: AbstractDynamics, x: Any, dt: float) -> np.ndarray:
    """ds'/du in physical units, by automatic differentiation."""
    step = lambda u: dynamics.step(x, u / jnp.asarray(dynamics.limits), dt)
    return np.asarray(jax.jacfwd(step)(jnp.zeros(dynamics.du)), float)
