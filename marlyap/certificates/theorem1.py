"""Theorem 1 (section 3.2), repaired, on fresh tuples."""

import dataclasses
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from marlyap.certificates.certificate import (
    AbstractCertificate,
    Claim,
    Draw,
    Evidence,
    Judgement,
    enough,
    judged,
    no_lyapunov,
    of_share,
    percent,
)
from marlyap.certificates.jacobian import jacobian
from marlyap.certificates.loop import seen_through
from marlyap.certificates.lyapunov import Norm
from marlyap.games.dynamics import AbstractDynamics, Independent, Unicycle
from marlyap.games.game import AbstractGame, AbstractRegulation
from marlyap.nets.layout import grad
from marlyap.simulation.rollout import Controller


def claim(bound: float, V: str) -> str:
    return (
        f"at least {percent(bound)} of the states met outside the ball, one of each rollout, "
        f"satisfy condition (13) for V, {V}; the theorem asks for all of them"
    )


class Theorem1(AbstractCertificate):
    """{V <= c} is invariant under a new policy, by Theorem 1.

    Let V be continuous, 0 on the target set, positive elsewhere and l_L-Lipschitz, and let
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
    estimate from below (the evidence is then no more than observed), or V's spectral bound. For a
    game with a step of its own l_f is such an estimate too.
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

    def check(self, loop, seed):
        enough(self.rollouts, self.share, self.confidence)
        game, V, H = loop.game, loop.V, loop.game.horizon
        judge = _Tuple(loop.controller, seen_through(game, self.old, "old"), self.noise)
        draw = lambda purpose: judged(
            judge, loop, Draw(seed, purpose, self.rollouts), H + V.beyond, uses_V=True
        )
        before, found = draw("calibrate"), draw("certify")
        fig = found.figures
        constants = self.constants(game, V, before.figures)
        l = constants[self.lipschitz] if self.lipschitz in constants else constants["empirical"]
        asked, sound = fig["outside"] > 0, found.holds
        excess = fig["next_V"] + l * constants["l_f"] * fig["moved"] - (1 - self.rate) * fig["V"]
        found = dataclasses.replace(
            found,
            holds=sound & (excess <= 0),
            badness=np.where(np.isnan(excess), np.inf, excess),
            asked=asked | ~sound,
        )
        exact = l == constants.get("spectral") and not own_step(game)
        say = lambda bound: claim(bound, V.meaning)
        what = Claim(
            "theorem1",
            say,
            H,
            void=no_lyapunov(before, found),
            to_judge="gave a state outside the ball",
            evidence=self.evidence if exact else "observed",
            scope={"tuples": "one per rollout, at a random time"},
            figures=constants
            | {"l_L": l, "V": type(V).__name__}
            | {"margin_median": float(np.median(-excess[asked])) if asked.any() else None}
            | {"margin_worst": float(np.min(-excess[asked])) if asked.any() else None},
        )
        return of_share(self, loop, seed, found, what)

    def constants(
        self, game: AbstractRegulation, V: Any, seen: dict[str, np.ndarray]
    ) -> dict[str, Any]:
        """l_f, and l_L by each means there is, over the calibration's region."""
        speed, reach = float(np.nanmax(seen["speed"])), float(np.nanmax(seen["reach"]))
        out = {"speed": speed, "reach": reach}
        plant = game.plant
        if own_step(game) or not isinstance(plant, Independent):
            out["l_f"] = float(np.nanmax(seen["input_gain"]))
        else:
            out["l_f"] = l_f(plant.dynamics, game.dt, speed)
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
        scale = jnp.asarray(game.plant.limits)[None]
        gradient = grad(lambda x: V.value(game, eqx.tree_at(lambda s: s.x, state, x)))(state.x)
        scene = game.scene(state)
        fastest = 0.0 if scene is None else jnp.max(jnp.linalg.norm(scene.velocity, axis=1))
        speed = fastest + game.dt * jnp.max(scale)
        figures = {
            "V": V.value(game, state),
            "next_V": V.value(game, game.step(state, old)),
            "moved": jnp.linalg.norm((jnp.clip(new, -1.0, 1.0) - old) * scale),
            "gradient": jnp.linalg.norm(ravel_pytree(gradient)[0]),
            "speed": speed,
            "reach": jnp.max(game.distance(state)),
            "outside": (~game.success(state)).astype(float),
        }
        if own_step(game):
            after = lambda u: ravel_pytree(game.step(state, u.reshape(new.shape) / scale).x)[0]
            gain = jacobian(after, (jnp.clip(new, -1.0, 1.0) * scale).ravel())
            figures["input_gain"] = jnp.linalg.norm(gain, ord=2)
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


def own_step(game: AbstractRegulation) -> bool:
    """Whether the game moves its agents otherwise than each by the same dynamics."""
    return type(game).step is not AbstractGame.step or not isinstance(game.plant, Independent)


def input_jacobian(dynamics: AbstractDynamics, x: Any, dt: float) -> np.ndarray:
    """ds'/du in physical units, by automatic differentiation."""
    step = lambda u: dynamics.step(x, u, dt)
    return np.asarray(jacobian(step, jnp.zeros(dynamics.du)), float)
