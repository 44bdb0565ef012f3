"""C8: a proof for one leader in its reduced coordinates, by bounds on boxes that are split."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import jax
import numpy as np
from rich.console import Console
from rich.progress import Progress

from marlyap.certificates import bounds as B, model
from marlyap.certificates.bounds import Affine
from marlyap.certificates.certificate import AbstractCertificate, Evidence, Verdict
from marlyap.certificates.loop import ClosedLoop
from marlyap.certificates.lyapunov import Approach, Norm, Quadratic
from marlyap.errors import UserError
from marlyap.games.dynamics import DoubleIntegrator, Unicycle
from marlyap.nets.nets import Actors, Greedy
from marlyap.simulation.rollout import Decentralised
from marlyap.storage import store
from marlyap.storage.hashing import policy_hash
from marlyap.types import State


SAVE_EVERY = 10.0  # seconds


class Proof(AbstractCertificate):
    """C8. One agent that knows its goal, x = (e_lon, e_lat, v, w), one step f of dt under mu:

        f(x) lies in the box                for all x in the box |x_i| <= half_i with V(x) <= c,
        V(f(x)) <= (1 - decay) V(x) - eta   for all x in the box with rho <= V(x) <= c,
        V(f(x)) <= inner                    for all x in the box with V(x) <= rho,

    with rho <= inner <= c. Then from every x in the box with V(x) <= c the inner set {V <= rho} is
    reached within (c - rho) / (eta + decay rho) steps, or log(c / rho) / -log(1 - decay) if that is
    fewer, and {V <= inner} is never left again. It is a statement about exact arithmetic; an eta
    well above 1e-5 leaves room for the controller's float32.

    Boxes are settled by affine bounds or split; the rounding of the bounds themselves is counted.
    The answer is proved, refuted with a state, or undecided with the volume that is left.
    """

    c: float
    rho: float
    inner: float
    half: tuple[float, ...]  # the box is |x_i| <= half_i
    eta: float = 1e-4
    decay: float = 0.0  # per step
    most: int = 20_000_000  # boxes to look at before giving up
    batch: int = 1024
    resume: str | None = None  # a directory that keeps what is left to do
    show: bool = False  # a progress bar
    confidence: float = 1.0
    evidence: ClassVar[Evidence] = "proved"
    asks_V: ClassVar[bool] = True

    def refuse(self, loop):
        half = np.array(self.half)
        if len(half) != 4 or not 0 < self.rho <= self.inner <= self.c or not (half > 0).all():
            raise UserError("proof: four half widths and 0 < rho <= inner <= c are needed.")
        if not (self.eta >= 0 and 0 <= self.decay < 1 and self.eta + self.decay > 0):
            raise UserError("proof: V must fall; take eta >= 0 and decay in [0, 1), not both 0.")
        boxes = Loop(loop)
        lyapunov(loop.V, loop.game.edge)
        heading = [np.pi] if boxes.turns else []
        states = model.drawn(loop.game, np.array([0.0, 0.0, *heading, *half[2:]]), self.goals())
        answer = lambda states: boxes(reduced(loop.game, states)).b[:, None]
        errors = lambda game, state: game.errors(state)
        model.require_step("proof", loop, states, answer, errors)

    def goals(self) -> np.ndarray:
        """Goals [sample, 1, 2] of one agent at the origin, as far as the box reaches (m)."""
        shape = (model.SAMPLES, 1, 2)
        return np.random.default_rng(1).uniform(-1, 1, shape) * np.array(self.half[:2])

    def check(self, loop, seed):
        self.refuse(loop)
        game, controller, V = loop.game, loop.controller, loop.V
        boxes, V_of = Loop(loop), lyapunov(V, game.edge)
        self.require_content(V_of)
        todo, looked, settled = self.begin(controller, V)
        found, total = None, float(np.prod(2 * np.array(self.half)))
        saved = time.monotonic()
        with Progress(console=Console(stderr=True), disable=not self.show) as bar:
            task = bar.add_task("proof", total=1.0)
            while len(todo) and looked < self.most and found is None:
                now, todo = todo[-self.batch :], todo[: -self.batch]
                keep, level, found = self.settle(now, boxes, V_of)
                looked += len(now)
                settled += float(np.prod(2 * now[~keep, 1], axis=1).sum())
                wide = extents(V, np.clip(level, self.rho, self.c), np.array(self.half))
                todo = np.concatenate([todo, halves(now[keep], wide)])
                bar.update(task, completed=settled / total, description=f"{len(todo)} boxes left")
                if time.monotonic() - saved > SAVE_EVERY:
                    self.keep(todo, looked, settled, controller, V)
                    saved = time.monotonic()
        self.keep(todo, looked, settled, controller, V)
        left = 1.0 - settled / total if len(todo) else 0.0
        answer = "refuted" if found else "undecided" if len(todo) else "proved"
        return self.verdict(game, V, answer, found, looked, left, len(todo))

    def require_content(self, V_of: Callable[[Affine], Affine]) -> None:
        """Raise UserError unless the box holds states with rho <= V <= c."""
        way = np.random.default_rng(0).uniform(-1, 1, (200, 1, 4)) * np.array(self.half)
        x = (way * np.linspace(0, 1, 50)[None, :, None]).reshape(-1, 4)
        V = V_of(B.box(x, np.zeros_like(x)))
        if not ((V.low >= self.rho) & (V.high <= self.c)).any():
            raise UserError(
                f"half: no state of the box with {self.rho:g} <= V <= {self.c:g} was found: "
                "nothing to prove; take a larger box, or other levels."
            )

    def settle(
        self, now: np.ndarray, loop: "Loop", V_of: Callable[[Affine], Affine]
    ) -> tuple[np.ndarray, np.ndarray, dict[str, Any] | None]:
        """Which boxes [k, 2, 4] (centre, radius) stay open, V there, and a state that refutes."""
        near = np.flatnonzero(V_of(B.box(now[:, 0], now[:, 1])).low[:, 0] <= self.c)
        some = now[near]
        V, after, change, moved = self.look(B.box(some[:, 0], some[:, 1]), loop, V_of)
        falls = (change.high[:, 0] <= -self.eta) | (V.high[:, 0] < self.rho)
        stays = (after.high[:, 0] <= self.inner) | (V.low[:, 0] > self.rho)
        half = np.array(self.half)
        inside = ((moved.high <= half) & (moved.low >= -half)).all(axis=1)
        keep = np.zeros(len(now), bool)
        keep[near] = open_ = ~(falls & stays & inside)
        # At the centre each quantity is b, give or take e: look closer where that may refute.
        most = lambda y: (y.b + y.e)[:, 0]
        suspect = (most(change) > -self.eta) | (most(after) > self.inner) | ~inside
        level, suspect = V.b[open_, 0], some[open_ & suspect]
        point = B.box(suspect[:, 0], np.zeros_like(suspect[:, 1]))
        V, after, change, moved = self.look(point, loop, V_of)
        rises = (V.low > self.rho) & (V.high < self.c) & (change.low > -self.eta)
        spills = (V.high < self.rho) & (after.low > self.inner)
        leaves = ((moved.low > half) | (moved.high < -half)).any(axis=1) & (V.high[:, 0] < self.c)
        bad = rises[:, 0] | spills[:, 0] | leaves
        if not bad.any():
            return keep, level, None
        i = int(np.argmax(bad))
        worst = {"x": suspect[i, 0].tolist(), "V": float(V.b[i, 0])}
        return keep, level, worst | {"V_next": float(after.b[i, 0]), "next": moved.b[i].tolist()}

    def look(self, x: Affine, loop: "Loop", V_of: Callable[[Affine], Affine]) -> tuple[Affine, ...]:
        """V(x), V(f(x)), V(f(x)) - (1 - decay) V(x), and f(x)."""
        moved = loop(x)
        V, after = V_of(x), V_of(moved)
        return V, after, B.add(after, B.linear((1 - self.decay) * np.eye(1), V), -1.0), moved

    def begin(self, controller: Any, V: Any) -> tuple[np.ndarray, int, float]:
        """The whole box, or what an earlier run left of it."""
        half = np.array(self.half)
        start = np.stack([np.zeros_like(half), half])[None]
        if self.resume is None or not Path(self.resume).exists():
            return start, 0, 0.0
        arrays, meta = store.read(Path(self.resume), "proof")
        if meta["task"] != self.task(controller, V):
            raise UserError(f"proof: {self.resume} belongs to another proof; choose another place.")
        return arrays["todo"], meta["looked"], meta["settled"]

    def keep(self, todo, looked, settled, controller, V) -> None:
        """Store what is left to do, where asked."""
        if self.resume is not None:
            meta = {"task": self.task(controller, V), "looked": looked, "settled": settled}
            store.write(Path(self.resume), "proof", {"todo": todo}, meta, replace=True)

    def task(self, controller: Any, V: Any) -> str:
        return f"{policy_hash(controller)} {policy_hash(V)} {self.c} {self.rho} {self.inner} " + (
            f"{self.half} {self.eta} {self.decay}"
        )

    @property
    def steps(self) -> int:
        """In how many steps the inner set is reached from V = c at the latest."""
        slow = (self.c - self.rho) / (self.eta + self.decay * self.rho)
        fast = np.log(self.c / self.rho) / -np.log1p(-self.decay) if self.decay > 0 else np.inf
        return int(np.ceil(min(slow, fast)))

    def verdict(self, game, V, answer, found, looked, left, boxes) -> Verdict:
        claim = (
            f"{answer}: in one step of {game.dt:g} s V, {V.meaning}, falls by {100 * self.decay:g} "
            f"% and {self.eta:g} from every state with {self.rho:g} <= V <= {self.c:g} within |x| "
            f"<= {self.half}, so that {{V <= {self.rho:g}}} is entered within {self.steps} steps; "
            f"and {{V <= {self.inner:g}}} is not left from there"
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
            | {"c": self.c, "rho": self.rho, "inner": self.inner, "half": list(self.half)}
            | {"decay": self.decay, "steps": self.steps, "seconds": self.steps * game.dt},
        )


class Loop:
    """f(x) = one step under the controller, for boxes of reduced states."""

    def __init__(self, loop: ClosedLoop):
        game = loop.game
        controller: Any = loop.controller
        policy: Any = controller.policy if type(controller) is Decentralised else None
        pi = policy.pi if type(policy) is Greedy else None
        if game.agents != 1 or type(pi) is not Actors:
            raise UserError(
                "proof: only a trained policy of one agent, unicycle or double integrator with "
                "Euler steps, can be proved; set agents=1."
            )
        game = model.require_model("proof", loop, (Unicycle, DoubleIntegrator))
        self.dt, self.scale = game.dt, game.edge
        self.limits, self.turns = game.dynamics.limits, type(game.dynamics) is Unicycle
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
        seen = B.join(rates, B.constant(1.0, e), e, magnified(e, self.scale))
        return B.tanh(forward(self.layers, seen).pick([0, 1]))


def reduced(game: Any, states: State) -> Affine:
    """The reduced coordinates of states [sample] as boxes without extent, in float64."""
    x = np.asarray(jax.vmap(game.errors)(states), float)[:, 0]
    return B.box(x, np.zeros_like(x))


def magnified(e: Affine, scale: float) -> Affine:
    """e / (|e| + scale), as `sensing.near`."""
    inverse = B.reciprocal(B.add(B.norm(B.join(e, B.constant(1e-6, e))), B.constant(scale, e)))
    return B.join(B.product(e.pick([0]), inverse), B.product(e.pick([1]), inverse))


def lyapunov(V: Any, radius: float) -> Callable[[Affine], Affine]:
    """V over boxes of reduced states, which are `game.errors` of one agent."""
    if isinstance(V, Approach):
        return lambda x: approach(V, radius, x)
    if isinstance(V, Quadratic):
        P = np.asarray(V.P, float)
        return lambda x: B.quadratic((P + P.T) / 2, x)
    if not isinstance(V, Norm):
        raise UserError(f"proof: V must be Approach, Norm or Quadratic, not {type(V).__name__}.")
    layers, slope = weights(V.net.net, None), float(V.net.slope)
    zero = np.zeros((1, layers[0][0].shape[1]))
    at_zero = forward(layers, B.box(zero, zero))

    def value(x: Affine) -> Affine:
        y = forward(layers, x)
        b, e = y.b - at_zero.b, y.e + at_zero.e + B.ROUND * np.abs(at_zero.b)
        return B.add(B.norm(Affine(y.A, b, e)), B.linear(slope * np.eye(1), B.norm(x)))

    return value


def approach(V: Approach, radius: float, x: Affine) -> Affine:
    m, g_v, g_w, eps = (float(a) for a in (V.m, V.g_v, V.g_w, V.eps))
    e, near = x.pick([0, 1]), magnified(x.pick([0, 1]), radius)
    desired = B.join(
        B.linear(np.array([[float(V.k), 0.0, float(V.k_near), 0.0]]), B.join(e, near)),
        B.linear(np.array([[0.0, float(V.k_turn)]]), near),
    )
    gap = B.linear(np.diag([g_v, g_w]), B.add(x.pick([2, 3]), desired, -1.0))
    slack = B.norm(B.join(gap, B.constant(eps, x)))
    ahead = B.linear(np.array([[1 + m, -m]]), B.join(B.norm(e), x.pick([0])), -eps)
    return B.add(ahead, slack)


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


def extents(V: Any, level: np.ndarray, half: np.ndarray) -> np.ndarray:
    """About how far {V <= level} reaches along each coordinate [k, 4]: boxes are cut in that shape.

    For a norm-like V that is another shape at every level, since eps does not shrink with it.
    """
    if not isinstance(V, Approach):
        return np.broadcast_to(half, (len(level), 4))
    gap = np.sqrt(level * (level + 2 * float(V.eps)))
    near = level / (1 + float(V.m))
    wide = np.stack([near, near, gap / float(V.g_v), gap / float(V.g_w)], axis=1)
    return np.minimum(wide, half)


def halves(boxes: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Each box in two, across its widest side relative to `wide`, overlapping by some roundings."""
    k, axis = np.arange(len(boxes)), np.argmax(boxes[:, 1] / wide, axis=1)
    left, right = boxes.copy(), boxes.copy()
    quarter = boxes[k, 1, axis] / 2
    left[k, 0, axis] -= quarter
    right[k, 0, axis] += quarter
    for part in (left, right):
        # By more than the rounding of the centre, however far out it lies.
        part[k, 1, axis] = quarter * (1 + 1e-12) + 1e-15 * np.abs(boxes[k, 0, axis])
    return np.concatenate([left, right])
