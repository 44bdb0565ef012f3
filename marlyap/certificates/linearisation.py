"""The honest negative: what a linearisation at the target can show, and for unicycles cannot."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap.certificate import AbstractCertificate, Evidence, Verdict
from marlyap.lyapunov_function import at_target


class Linearisation(AbstractCertificate):
    """Local exponential stability of "at rest on the goal" by the linearised step x+ = A x + B u:

        rank [A - lambda I, B] = dx for every eigenvalue lambda of A with |lambda| >= 1

    (Popov-Belevitch-Hautus), or no feedback can move that eigenvalue. If it is, the spectral radius
    of the team's closed loop has to be below 1. For a unicycle at rest lambda = 1 is uncontrollable
    in the lateral direction (the heading is free, but can be moved): no Lipschitz feedback that
    rests on the goal makes it exponentially stable, and
    c(s_{t+T}) <= (1 - beta) c(s_t) fails near it for every beta > 0 and T. A ball (C1', C3 with
    c_min) or a point ahead of the agent (C9) is what can be certified.
    """

    confidence: float = 1.0
    evidence: ClassVar[Evidence] = "proved"

    def check(self, game, controller, V, seed):
        model, names = game.dynamics, game.dynamics.names
        x = model.rest(jnp.zeros(2), jnp.zeros(()))
        step = lambda x, a: model.step(x, a, game.dt)
        A = np.asarray(jax.jacfwd(step, 0)(x, jnp.zeros(model.du)), float)
        B = np.asarray(jax.jacfwd(step, 1)(x, jnp.zeros(model.du)), float)
        free = uncontrollable(A, B)
        lateral = len(free)
        radius = None if lateral > 0 else self.radius(game, controller)
        holds = lateral <= 0 and radius is not None and radius < 1
        if lateral > 0:
            claim = (
                "transverse-exponential: NO. The linearisation at the goal has "
                f"{lateral} uncontrollable eigenvalue(s) 1, in the lateral direction, so that no "
                "smooth feedback makes it exponentially stable; certify a ball, or a point offset"
            )
        else:
            claim = f"the linearised closed loop at the goal has spectral radius {radius:.4f}"
        return Verdict(
            name="linearisation",
            claim=claim,
            evidence=self.evidence if lateral > 0 else "observed",
            holds=holds,
            bound=radius,
            confidence=None,
            scope={"starts": "a neighbourhood of the goal", "horizon_steps": None}
            | {"disturbance": "none"},
            figures={
                "controllability_rank": reachable(A, B),
                "dimension": len(names),
                "uncontrollable_eigenvalues": free,
            },
        )

    def radius(self, game, controller) -> float:
        """Spectral radius of the closed loop of the whole team, linearised at rest on the goal."""
        rest = at_target(game, game.reset(jax.random.key(0)))

        def step(flat):
            state = eqx.tree_at(lambda s: s.x, rest, flat.reshape(rest.x.shape))
            return game.step(state, controller(state, jax.random.key(0))).x.ravel()

        # One copy of the state for each row: networks are differentiated backwards, in batches.
        copies = jnp.tile(rest.x.ravel(), (rest.x.size, 1))
        _, pull = jax.vjp(jax.vmap(step), copies)
        J = np.asarray(pull(jnp.eye(rest.x.size))[0], float)
        return float(np.max(np.abs(np.linalg.eigvals(J))))


def reachable(A: np.ndarray, B: np.ndarray) -> int:
    """The rank of [B, AB, A^2 B, ...]."""
    blocks = [B]
    for _ in range(len(A) - 1):
        blocks.append(A @ blocks[-1])
    scaled = [b / max(float(np.linalg.norm(b)), 1e-30) for b in blocks]
    return int(np.linalg.matrix_rank(np.hstack(scaled), tol=1e-6))


def uncontrollable(A: np.ndarray, B: np.ndarray) -> list[float]:
    """Eigenvalues on or outside the unit circle that no feedback moves."""
    n, found = len(A), []
    for value in np.unique(np.round(np.linalg.eigvals(A), 5)):
        rank = np.linalg.matrix_rank(np.hstack([A - value * np.eye(n), B]), tol=1e-6)
        if abs(value) > 1 - 1e-6 and rank < n:
            found += [float(abs(value))] * int(n - rank)
    return found
