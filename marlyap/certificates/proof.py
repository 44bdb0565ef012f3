"""C8: a proof for one leader in its reduced coordinates, by bounds on boxes that are split."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from marlyap import store
from marlyap.certificate import AbstractCertificate, Evidence, Verdict
from marlyap.certificates import bounds as B
from marlyap.certificates.bounds import Affine
from marlyap.dynamics import DoubleIntegrator, Unicycle
from marlyap.errors import UserError
from marlyap.identity import policy_hash
from marlyap.lyapunov_function import Norm, Quadratic


Progress = Callable[[float, int], None]  # share of the volume that is settled, boxes left


class Proof(AbstractCertificate):
    """C8. One agent that knows its goal, x = (e_lon, e_lat, v, w), one step f of dt under mu:

        f(x) lies in the box           for all x in the box |x_i| <= half_i with V(x) <= c,
        V(f(x)) - V(x) <= -eta         for all x in the box with rho <= V(x) <= c,
        V(f(x)) <= inner               for all x in the box with V(x) <= rho,

    with rho <= inner <= c. Then from every x in the box with V(x) <= c the inner set {V <= rho} is
    reached within (c - rho) / eta steps, and {V <= inner} is never left again. It is a statement
    about exact arithmetic; an eta well above 1e-5 leaves room for the controller's float32.

    Boxes are settled by affine bounds or split; the rounding of the bounds themselves is counted.
    The answer is proved, refuted with a state, or undecided with the volume that is left.
    """

    c: float
    rho: float
    inner: float
    half: tuple[float, ...]  # the box is |x_i| <= half_i
    eta: float = 1e-4
    most: int = 2_000_000  # boxes to look at before giving up
    batch: int = 4096
    resume: str | None = None  # a directory that keeps what is left to do
    on_progress: Progress | None = None
    confidence: float = 1.0
    evidence: ClassVar[Evidence] = "proved"

    def check(self, game, controller, V, seed):
        loop, V_of = Loop(game, controller), lyapunov(V)
        todo, looked, settled = self.begin(controller, V)
        found, total = None, float(np.prod(2 * np.array(self.half)))
        while len(todo) and looked < self.most and found is None:
            now, todo = todo[-self.batch :], todo[: -self.batch]
            keep, found = self.settle(now, loop, V_of)
            looked += len(now)
            settled += float(np.prod(2 * now[~keep, 1], axis=1).sum())
            todo = np.concatenate([todo, halves(now[keep], np.array(self.half))])
            self.progress(settled / total, todo, looked, settled, controller, V)
        left = 1.0 - settled / total if len(todo) else 0.0
        answer = "refuted" if found else "undecided" if len(todo) else "proved"
        return self.verdict(game, answer, found, looked, left, len(todo))

    def settle(
        self, now: np.ndarray, loop: "Loop", V_of: Callable[[Affine], Affine]
    ) -> tuple[np.ndarray, dict[str, Any] | None]:
        """Which boxes [k, 2, 4] (centre, radius) stay open; and a state that refutes, if any."""
        V, after, change, moved = self.look(B.box(now[:, 0], now[:, 1]), loop, V_of)
        falls = (change.high[:, 0] <= -self.eta) | (V.high[:, 0] < self.rho)
        stays = (after.high[:, 0] <= self.inner) | (V.low[:, 0] > self.rho)
        half = np.array(self.half)
        inside = ((moved.high <= half) & (moved.low >= -half)).all(axis=1)
        keep = ~((V.low[:, 0] > self.c) | (falls & stays & inside))
        point = B.box(now[keep, 0], np.zeros_like(now[keep, 1]))
        V, after, change, moved = self.look(point, loop, V_of)
        rises = (V.low > self.rho) & (V.high < self.c) & (change.low > -self.eta)
        spills = (V.high < self.rho) & (after.low > self.inner)
        leaves = ((moved.low > half) | (moved.high < -half)).any(axis=1) & (V.high[:, 0] < self.c)
        bad = rises[:, 0] | spills[:, 0] | leaves
        if not bad.any():
            return keep, None
        i = int(np.argmax(bad))
        worst = {"x": now[keep, 0][i].tolist(), "V": float(V.b[i, 0])}
        return keep, worst | {"V_next": float(after.b[i, 0]), "next": moved.b[i].tolist()}

    def look(self, x: Affine, loop: "Loop", V_of: Callable[[Affine], Affine]) -> tuple[Affine, ...]:
        """V(x), V(f(x)), their difference, and f(x)."""
        moved = loop(x)
        V, after = V_of(x), V_of(moved)
        return V, after, B.add(after, V, -1.0), moved

    def begin(self, controller: Any, V: Any) -> tuple[np.ndarray, int, float]:
        """The whole box, or what an earlier run left of it."""
        half = np.array(self.half)
        if len(half) != 4 or not 0 < self.rho <= self.inner <= self.c or not (half > 0).all():
            raise UserError("proof: four half widths and 0 < rho <= inner <= c are needed.")
        start = np.stack([np.zeros_like(half), half])[None]
        if self.resume is None or not Path(self.resume).exists():
            return start, 0, 0.0
        arrays, meta = store.read(Path(self.resume), "proof")
        if meta["task"] != self.task(controller, V):
            raise UserError(f"proof: {self.resume} belongs to another proof; choose another place.")
        return arrays["todo"], meta["looked"], meta["settled"]

    def progress(self, share, todo, looked, settled, controller, V) -> None:
        if self.on_progress is not None:
            self.on_progress(share, len(todo))
        if self.resume is not None:
            meta = {"task": self.task(controller, V), "looked": looked, "settled": settled}
            store.write(Path(self.resume), "proof", {"todo": todo}, meta, replace=True)

    def task(self, controller: Any, V: Any) -> str:
        return f"{policy_hash(controller)} {policy_hash(V)} {self.c} {self.rho} {self.inner} " + (
            f"{self.half} {self.eta}"
        )

    def verdict(self, game, answer, found, looked, left, boxes) -> Verdict:
        claim = (
            f"{answer}: in one step of {game.dt:g} s V falls by at least {self.eta:g} from every "
            f"state with {self.rho:g} <= V <= {self.c:g}, and {{V <= {self.inner:g}}} is not left "
            f"from {{V <= {self.rho:g}}}"
        )
        return Verdict(
            name="proof",
            claim=claim,
            evidence=self.evidence if answer != "undecided" else "observed",
            holds=answer == "proved",
            bound=self.eta,
            confidence=None,
            scope={"starts": f"V <= {self.c:g} within |x| <= {self.half}", "horizon_steps": None}
            | {"disturbance": "none", "time": f"steps of {game.dt:g} s", "arithmetic": "exact"},
            worst=found,
            figures={"answer": answer, "boxes": looked, "left": boxes, "volume_left": left}
            | {"c": self.c, "rho": self.rho, "inner": self.inner, "half": list(self.half)},
        )


class Loop:
    """f(x) = one step under the controller, for boxes of reduced states."""

    def __init__(self, game: Any, controller: Any):
        model = game.dynamics
        known = isinstance(model, (Unicycle, DoubleIntegrator)) and model.integrator == "euler"
        pi = getattr(getattr(controller, "policy", None), "pi", None)
        if game.agents != 1 or not known or pi is None:
            raise UserError(
                "proof: only a trained policy of one agent, unicycle or double integrator with "
                "Euler steps, can be proved; set agents=1."
            )
        self.dt, self.scale = game.dt, game.radius
        self.limits, self.turns = model.limits, isinstance(model, Unicycle)
        self.layers = weights(pi.net, None if pi.shared else 0)

    def __call__(self, x: Affine) -> Affine:
        e, rates = x.pick([0, 1]), x.pick([2, 3])
        action = self.policy(e, rates)
        rates = B.add(rates, B.linear(self.dt * np.diag(self.limits), action))
        if not self.turns:
            return B.join(B.add(e, B.linear(self.dt * np.eye(2), rates), -1.0), rates)
        turn = B.linear(np.array([[0.0, self.dt]]), rates)
        cos, sin = B.sine(turn, np.pi / 2), B.sine(turn)
        lon, lat, ahead = e.pick([0]), e.pick([1]), B.linear(np.array([[self.dt, 0.0]]), rates)
        new_lon = B.add(B.add(B.product(cos, lon), B.product(sin, lat)), ahead, -1.0)
        new_lat = B.add(B.product(cos, lat), B.product(sin, lon), -1.0)
        return B.join(new_lon, new_lat, rates)

    def policy(self, e: Affine, rates: Affine) -> Affine:
        length = B.norm(B.join(e, B.constant(1e-6, e)))
        inverse = B.reciprocal(B.add(length, B.constant(self.scale, e)))
        near = B.join(B.product(e.pick([0]), inverse), B.product(e.pick([1]), inverse))
        out = forward(self.layers, B.join(rates, B.constant(1.0, e), e, near))
        return B.tanh(out.pick([0, 1]))


def lyapunov(V: Any) -> Callable[[Affine], Affine]:
    """V over boxes of reduced states, which are `game.errors` of one agent."""
    if isinstance(V, Quadratic):
        P = np.asarray(V.P, float)
        return lambda x: B.quadratic((P + P.T) / 2, x)
    if not isinstance(V, Norm):
        raise UserError(f"proof: V must be Norm or Quadratic, not {type(V).__name__}.")
    layers, slope = weights(V.net.net, None), float(V.net.slope)
    zero = np.zeros((1, layers[0][0].shape[1]))
    at_zero = forward(layers, B.box(zero, zero))

    def value(x: Affine) -> Affine:
        y = forward(layers, x)
        b, e = y.b - at_zero.b, y.e + at_zero.e + B.ROUND * np.abs(at_zero.b)
        return B.add(B.norm(Affine(y.A, b, e)), B.linear(slope * np.eye(1), B.norm(x)))

    return value


def forward(layers: list[tuple[np.ndarray, np.ndarray]], x: Affine) -> Affine:
    for W, b in layers[:-1]:
        x = B.relu(B.linear(W, x, b))
    return B.linear(layers[-1][0], x, layers[-1][1])


def weights(net: Any, agent: int | None) -> list[tuple[np.ndarray, np.ndarray]]:
    """The layers in float64; those of one agent where they are stacked."""
    if any(layer.norm is not None for layer in net.layers):
        raise UserError("proof: networks with LayerNorm are not covered; train V without it.")
    of = lambda a: np.asarray(a if agent is None else a[agent], float)
    return [(of(layer.weight), of(layer.bias)) for layer in net.layers]


def halves(boxes: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Each box in two, across its relatively widest side, overlapping by a rounding."""
    k, axis = np.arange(len(boxes)), np.argmax(boxes[:, 1] / half, axis=1)
    left, right = boxes.copy(), boxes.copy()
    quarter = boxes[k, 1, axis] / 2
    left[k, 0, axis] -= quarter
    right[k, 0, axis] += quarter
    for part in (left, right):
        part[k, 1, axis] = quarter * (1 + 1e-12)
    return np.concatenate([left, right])
