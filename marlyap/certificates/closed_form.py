"""C9: the point-offset law by eigenvalues, without a single rollout."""

from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from marlyap import graph as graphs
from marlyap.certificates.certificate import AbstractCertificate, Evidence, Verdict
from marlyap.certificates.model import SAMPLES, drawn, require_model, require_step
from marlyap.controllers.point_offset import PointOffset
from marlyap.errors import UserError
from marlyap.games.dynamics import Unicycle
from marlyap.games.planar import AbstractPlanar


def claim(offset: float, rate: float, level: float, sampled: float) -> str:
    """In words; `level` 0 where an eigenvalue is not stable."""
    if level == 0:
        return f"the points z_i = p_i + {offset:g} h_i do not converge: the rate is {rate:.3g} /s"
    return (
        f"in continuous time every point z_i = p_i + {offset:g} h_i converges to the goal at the "
        f"rate {rate:.3g} /s from every state with V <= {level:.3g}, V the sum of the quadratic "
        "forms of all modes, where no input saturates; of the game's own steps only the linear "
        f"part was examined (spectral radius {sampled:.4f})"
    )


class ClosedForm(AbstractCertificate):
    """Stability of the point-offset law from eigenvalues, without a rollout.

    C9. The points z_i = p_i + d h_i of unicycles under z_i'' = k_p e_i - k_d z_i', with
    e = -D^-1 (L + B)(z - p*), D = diag(degree_i + b_i), and mu_k the eigenvalues of D^-1 (L + B):

        mu_k > 0 for all k (the grounded Laplacian is positive definite),
        A_k' P_k + P_k A_k = -I,  P_k > 0,  A_k = [[0, 1], [-k_p mu_k, -k_d]],
        V = sum over modes and axes of y_k' P_k y_k falls at the rate V' = -sum |y_k|^2,
        |u_i| + |z_i'|^2 / d <= a_max and |u_i| / d + |z_i'|^2 / (2 d^2) <= r_max on {V <= level}.

    The last line keeps the inputs within their limits, where the linearisation by feedback is
    exact: |d w^2| <= |z'|^2 / d and |v w| <= |z'|^2 / (2 d). So {V <= level} is invariant and z
    converges exponentially from it, in continuous time. For the game's own steps of dt only the
    sampled linear system is checked: rho_sampled < 1, with both z and z' held over a step.
    """

    confidence: float = 1.0
    evidence: ClassVar[Evidence] = "proved"

    def refuse(self, loop):
        controller: Any = loop.controller
        if type(controller) is not PointOffset:
            raise UserError(
                f"closed-form: {type(controller).__name__} is not the controller PointOffset, the "
                "only one this certificate is about."
            )
        game = require_model("closed-form", loop, (Unicycle,))
        stiffness(game, controller)
        spread = np.array([0.2, 0.2, np.pi, 0.2, 0.2])
        states = drawn(game, spread, np.zeros((SAMPLES, game.agents, 2)))
        model = lambda states: successor(game, controller, np.asarray(states.x))
        require_step("closed-form", loop, states, model, lambda game, s: s.x)

    def check(self, loop, seed):
        self.refuse(loop)
        game: Any = loop.game
        controller: Any = loop.controller
        K, root = stiffness(game, controller)
        modes = [mode(mu, controller) for mu in np.linalg.eigvalsh(K)]
        sampled = max(sampled_radius(m["mu"], controller, game.dt) for m in modes)
        stable = all(m["mu"] > 1e-12 and m["rate"] > 0 for m in modes)
        level = sublevel(game, controller, K, root, modes) if stable else 0.0
        rate = min(m["rate"] for m in modes)
        return Verdict(
            name="closed-form",
            claim=claim(controller.offset, rate, level, sampled),
            evidence=self.evidence,
            holds=bool(stable and level > 0 and sampled < 1),
            bound=rate,
            confidence=None,
            scope={
                "starts": f"V <= {level:.6g}, any headings",
                "horizon_steps": None,
                "disturbance": "none",
                "time": "continuous; sampled for the linear system only",
            },
            figures={
                "eigenvalues": [m["mu"] for m in modes],
                "rates": [m["rate"] for m in modes],
                "P": [m["P"].tolist() for m in modes],
                "level": level,
                "rho_sampled": sampled,
            },
        )


def stiffness(
    game: AbstractPlanar, controller: PointOffset
) -> tuple[Float[np.ndarray, "agent agent"], Float[np.ndarray, "agent"]]:
    """D^-1/2 (L + B) D^-1/2, similar to D^-1 (L + B), and the diagonal of D^1/2."""
    if graphs.disk_radius(game.graph) is not None:
        raise UserError("closed-form: the graph must not change with the state, as a disk does.")
    linked = np.asarray(game.adjacency, float)
    b = np.where(game.leads, controller.leader_gain, 0.0)
    degree = linked.sum(axis=1) + b
    root = np.sqrt(degree)
    grounded = np.diag(degree) - linked
    return grounded / root[:, None] / root[None, :], root


def successor(
    game: AbstractPlanar, controller: PointOffset, x: Float[np.ndarray, "sample agent 5"]
) -> Float[np.ndarray, "sample agent 5"]:
    """One semi-implicit step under the law of this certificate, all goals at the origin."""
    linked, b = np.asarray(game.adjacency, float), np.where(game.leads, controller.leader_gain, 0.0)
    d, psi, v, w = controller.offset, x[..., 2], x[..., 3, None], x[..., 4, None]
    h = np.stack([np.cos(psi), np.sin(psi)], axis=-1)
    n = np.stack([-h[..., 1], h[..., 0]], axis=-1)
    z = x[..., :2] + d * h
    degree = linked.sum(axis=1) + b
    e = (linked @ z - degree[:, None] * z) / degree[:, None]
    u = controller.k_p * e - controller.k_d * (v * h + d * w * n)
    a = (u * h).sum(axis=-1) + d * w[..., 0] ** 2
    r = ((u * n).sum(axis=-1) - v[..., 0] * w[..., 0]) / d
    most = np.array(game.dynamics.limits)
    inputs = np.clip(np.stack([a, r], axis=-1), -most, most)
    rates = x[..., 3:] + game.dt * inputs
    psi = psi + game.dt * rates[..., 1]
    ahead = np.stack([np.cos(psi), np.sin(psi)], axis=-1)
    p = x[..., :2] + game.dt * rates[..., :1] * ahead
    return np.concatenate([p, psi[..., None], rates], axis=-1)


def mode(mu: float, controller: PointOffset) -> dict[str, Any]:
    """One eigenvalue: its 2 x 2 system, the solution of its Lyapunov equation, its decay rate."""
    k, c = controller.k_p * float(mu), controller.k_d
    A = np.array([[0.0, 1.0], [-k, -c]])
    rate = -float(np.max(np.linalg.eigvals(A).real))
    if rate <= 0:
        return {"mu": float(mu), "rate": rate, "P": np.full((2, 2), np.nan)}
    # A'P + PA = -I, solved by hand for a companion matrix.
    p12 = 1 / (2 * k)
    p22 = (1 + 2 * p12) / (2 * c)
    P = np.array([[c * p12 + k * p22, p12], [p12, p22]])
    return {"mu": float(mu), "rate": rate, "P": P}


def sampled_radius(mu: float, controller: PointOffset, dt: float) -> float:
    """Spectral radius of one mode under semi-implicit Euler with u held over dt."""
    k, c = controller.k_p * mu, controller.k_d
    A = np.array([[1 - dt * dt * k, dt * (1 - dt * c)], [-dt * k, 1 - dt * c]])
    return float(np.max(np.abs(np.linalg.eigvals(A))))


def sublevel(
    game: AbstractPlanar,
    controller: PointOffset,
    K: np.ndarray,
    root: np.ndarray,
    modes: list[dict[str, Any]],
) -> float:
    """The largest level at which neither input can reach its limit.

    On {V <= c} a linear form f of the modes is at most sqrt(c f P^-1 f'), for vectors in the plane
    too, for both axes share P. With s = sqrt(c) each limit is a quadratic inequality in s.
    """
    mu, U = np.linalg.eigh(K)
    inverse = [np.linalg.inv(m["P"]) for m in modes]
    a_max, r_max = game.dynamics.limits
    d, kp, kd, best = controller.offset, controller.k_p, controller.k_d, np.inf
    for i in range(game.agents):
        weight = U[i] / root[i]
        u = sum(
            w**2 * np.array([-kp * m, -kd]) @ Q @ np.array([-kp * m, -kd])
            for w, m, Q in zip(weight, mu, inverse, strict=True)
        )
        z_dot = sum(w**2 * Q[1, 1] for w, Q in zip(weight, inverse, strict=True))
        for limit, linear, square in (
            (a_max, np.sqrt(u), z_dot / d),
            (r_max, np.sqrt(u) / d, z_dot / (2 * d * d)),
        ):
            s = 2 * limit / (linear + np.sqrt(linear**2 + 4 * square * limit))
            best = min(best, float(s) ** 2)
    return best * (1 - 1e-9)
