"""What a linearisation at the target can show, and for unicycles cannot."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from marlyap.certificates.certificate import AbstractCertificate, Evidence, Verdict
from marlyap.certificates.jacobian import jacobian
from marlyap.errors import UserError
from marlyap.games.game import AbstractRegulation
from marlyap.simulation.rollout import Controller
from marlyap.types import State


AT_REST = 1e-8  # in SI units and of an action in [-1, 1]: what float64 calls zero here
EXACT = 1e-10  # a singular value below it is 0
CLEAR = 1e-6  # and one above it is not; between the two nothing is said
EPS = 1e-14  # relative: what rounding in float64 may change
SMOOTH = 1e-3  # relative gap between a derivative and a difference quotient
TIMES = (1, 2, 3, 7, 20, 41, 81, 100, 1_000, 10_000)  # steps later, when nothing may have changed


def claim(radius: float, margin: float, scenes: int) -> str:
    """In words, of the spectral radius at so many targets; it may not exceed 1 - margin."""
    stable = f"at most 1 - {margin:g}, so that rest on the goal is exponentially stable nearby"
    return (
        f"the closed loop of the game's own step, linearised at {scenes} targets, has spectral "
        f"radius {radius:.6f}, "
        + (stable if radius <= 1 - margin else f"more than 1 - {margin:g}: no stability is shown")
    )


def claim_not(count: int, decay: float) -> str:
    """In words, of so many uncontrollable eigenvalues that the errors see."""
    return (
        f"NO: the linearised step at the goal has {count} uncontrollable eigenvalue(s) of size 1 "
        "or more that the errors see (for a unicycle, sideways), so that no Lipschitz state "
        f"feedback that rests there makes the errors decay by more than {decay:g} of themselves a "
        "step; certify a ball, or a point ahead of the agents"
    )


class Linearisation(AbstractCertificate):
    """Local exponential stability at rest on the goal.

    By the game's own step f and errors e:

        x* = f(x*, u*),  mu(x*) = u*,  e(x*) = 0,  rho(df(x, mu(x))/dx) <= 1 - margin  at x*,

    with u* the holding action (`game.hold`) and x the states of all agents (and what floats the
    game's memory holds), in float64, at the targets of several episodes. The derivative is compared
    with difference quotients to both sides: where they disagree nothing is said. The
    margin is wider than the error of the eigenvalues: a chain of m equal ones is known to
    1e-16^(1/m) only, 6e-4 for m = 5. Evidence: observed.

    With A = df/dx and B = df/du of the whole team at (x*, u*) the answer is no, whatever the
    controller, where the errors see an eigenvalue that no feedback moves:

        w A = lambda w,  w B = 0,  |lambda| >= 1,  w in the row space of de/dx

    (Popov, Belevitch and Hautus). Along a target set that is a manifold, as in consensus, the
    errors see nothing, and an eigenvalue 1 is harmless. For a unicycle at rest w is sideways: no
    Lipschitz feedback that rests on the goal makes it exponentially stable. Evidence: proved where
    every number is clearly 0 or clearly not, else observed.
    """

    scenes: int = 8  # episodes whose targets are examined
    margin: float = 1e-3  # of the spectral radius, below 1
    decay: float = 1e-9  # |lambda| >= 1 - decay counts as 1
    confidence: float = 1.0
    evidence: ClassVar[Evidence] = "proved"

    def refuse(self, loop):
        with jax.enable_x64(True):
            speed = float(moving_target(as_double(loop.game), jax.random.key(0)))
        if speed > AT_REST:
            raise UserError(
                "linearisation: the target set moves in time, and it speaks of rest at one point; "
                "take a certificate that plays the game, such as reach-and-stay."
            )

    def check(self, loop, seed):
        self.refuse(loop)
        with jax.enable_x64(True):
            looks = look(as_double(loop.game), as_double(loop.controller), self, seed)
        fault = next((x["fault"] for x in looks if x["fault"]), None)
        radius = max((x["radius"] for x in looks), default=np.inf)
        negatives = [x["free"] for x in looks]
        count = min(len(free.seen) for free in negatives)
        clear = all(free.clear for free in negatives)
        figures = {
            "controllability_rank": min(free.rank for free in negatives),
            "dimension": looks[0]["dimension"],
            "uncontrollable_eigenvalues": negatives[0].seen,
            "gap_clear": clear,
            "spectral_radius": radius if np.isfinite(radius) else None,
            "margin": self.margin,
            "action_at_goal": max(x["action"] for x in looks),
            "step_from_goal": max(x["moved"] for x in looks),
            "scenes": self.scenes,
        }
        plant = next((x["plant_fault"] for x in looks if x["plant_fault"]), None)
        no = count > 0 and plant is None
        holds, evidence = False, "observed"
        if no:
            said, evidence = claim_not(count, self.decay), self.evidence if clear else "observed"
        elif why := plant or fault:
            said = why
        else:
            said, holds = claim(radius, self.margin, self.scenes), radius <= 1 - self.margin
        return Verdict(
            name="linearisation",
            claim=said,
            evidence=evidence,
            holds=bool(holds),
            bound=None if no or plant or fault else radius,
            confidence=None,
            scope={"starts": "a neighbourhood of the goal", "horizon_steps": None}
            | {"disturbance": "none", "arithmetic": "float64"},
            figures=figures,
        )


class Free(eqx.Module):
    """What no feedback moves: |lambda| of those that the errors see, and how sure that is."""

    seen: list[float]
    rank: int  # of [B, AB, A^2 B, ...]
    clear: bool  # no number lies between 0 and not 0


def as_double(tree: Any) -> Any:
    """The same with every float array in float64."""
    double = lambda x: jnp.asarray(x, jnp.float64) if eqx.is_inexact_array(x) else x
    return jax.tree.map(double, tree)


def look(
    game: AbstractRegulation, controller: Controller, asked: Linearisation, seed: int
) -> list[dict[str, Any]]:
    """Derivatives, equilibrium and faults at the targets of some episodes, in float64."""
    found = []
    examine = eqx.filter_jit(_examine)
    for key in jax.random.split(jax.random.key(seed), asked.scenes):
        A, B, E, J, gaps = (np.asarray(x, float) for x in examine(game, controller, key))
        action, moved, drift, errors, clock, plant_clock, other, rough, kinked = gaps
        free = uncontrollable(A, B, E, asked.decay)
        finite = bool(np.isfinite(J).all())
        radius = float(np.max(np.abs(np.linalg.eigvals(J)))) if finite else np.inf
        plant_fault = _first(
            (
                (not errors <= AT_REST, f"the errors do not vanish on the target: {errors:.3g}"),
                (not drift <= AT_REST, f"the goal is no equilibrium: under the holding action the "
                 f"agents move by {drift:.3g} in a step"),
                (not plant_clock <= 0, "the game's step depends on the time, which is not covered"),
                (not other <= 0, "the game changes its scenario or counts in its memory, which is "
                 "not covered"),
                (not kinked <= SMOOTH, "the game's step has no derivative at the goal"),
            )
        )  # fmt: skip
        fault = _first(
            (
                (not max(action, moved) <= AT_REST, "the goal is no equilibrium: on it the "
                 f"controller is {action:.3g} off the holding action and the agents move by "
                 f"{moved:.3g} in a step"),
                (not clock <= 0, "the controller's action depends on the time or on chance, which "
                 "is not covered"),
                (not finite or not rough <= SMOOTH, "the closed loop has no derivative at the "
                 "goal"),
            )
        )  # fmt: skip
        found.append(
            {"free": free, "radius": radius, "fault": fault, "plant_fault": plant_fault}
            | {"dimension": len(A), "action": float(action), "moved": float(moved)}
        )
    return found


@eqx.filter_jit
def moving_target(game: AbstractRegulation, key: Array) -> Array:
    """How far the target set moves, by the largest change of an error or a state; 0 if it rests.

    It moves where a state of it has errors at a later time, or where the holding action takes the
    team elsewhere while the errors stay zero.
    """
    state = game.at_target(game.reset(key))
    errors = lambda s: game.errors(s).ravel()
    held = game.step(state, game.hold(state))
    gone = jnp.max(jnp.abs(coordinates(held)[0] - coordinates(state)[0]))
    follows = jnp.max(jnp.abs(errors(held))) <= AT_REST
    return jnp.maximum(_later(state, errors), jnp.where(follows, gone, 0.0))


def _first(faults: Any) -> str | None:
    return next((said for wrong, said in faults if wrong), None)


def _examine(game: AbstractRegulation, controller: Controller, key: Array) -> tuple[Array, ...]:
    """A, B, de/dx, the closed loop's Jacobian and nine numbers that should be zero."""
    start = game.reset(key)
    state, act = game.at_target(start), lambda s: controller(s, jax.random.key(0))
    x, put = coordinates(state)
    hold = game.hold(state)
    after = lambda s, a: coordinates(game.step(s, a))[0]
    plant = lambda x: after(put(x), hold)
    loop = lambda x: after(put(x), act(put(x)))
    errors = lambda x: game.errors(put(x)).ravel()
    A, E, J = jacobian(plant, x), jacobian(errors, x), jacobian(loop, x)
    B = jacobian(lambda a: after(state, a.reshape(hold.shape)), hold.ravel())
    step = game.step(state, hold)
    fixed = lambda s: eqx.tree_at(lambda s: (s.x, s.t), s, (state.x, state.t))
    largest = lambda *arrays: jnp.max(jnp.stack([jnp.max(jnp.abs(a), initial=0.0) for a in arrays]))
    gaps = (
        largest(act(state) - hold),
        largest(loop(x) - x),
        largest(plant(x) - x),
        largest(errors(x)),
        jnp.maximum(*(_later(s, act) for s in (state, start))),
        jnp.maximum(*(_later(s, lambda s: after(s, 0.3 + hold)) for s in (state, start))),
        _others(fixed(step), fixed(state)),
        _kink(loop, x, J),
        _kink(plant, x, A),
    )
    return A, B, E, J, jnp.stack([jnp.asarray(g, jnp.float64) for g in gaps])


def coordinates(state: State) -> tuple[Float[Array, "n"], Callable[[Float[Array, "n"]], State]]:
    """The states of all agents and the floats in the memory as one vector, and the way back."""
    moving = state.x, eqx.filter(state.memory, eqx.is_inexact_array)
    flat, back = ravel_pytree(moving)
    rest = eqx.filter(state.memory, eqx.is_inexact_array, inverse=True)

    def put(flat: Float[Array, "n"]) -> State:
        x, memory = back(flat)
        return State(x, state.scenario, state.t, eqx.combine(memory, rest))

    return flat, put


def _later(state: State, of: Callable[[State], Array]) -> Array:
    """By how much `of` changes with the clock."""
    at = lambda dt: of(eqx.tree_at(lambda s: s.t, state, state.t + dt.astype(state.t.dtype)))
    values = jax.vmap(at)(jnp.asarray((0, *TIMES)))
    gap = jnp.max(jnp.abs(values[1:] - values[:1]))
    return jnp.where(gap <= EPS * jnp.max(jnp.abs(values)), 0.0, gap)  # lanes may round differently


def _others(a: State, b: State) -> Array:
    """How many numbers of the scenario, and whole numbers of the memory, differ."""
    raw = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    counts = lambda s: eqx.filter(s.memory, eqx.is_inexact_array, inverse=True)
    whole = lambda s: jax.tree.leaves((s.scenario, counts(s)))
    pairs = zip(map(raw, whole(a)), map(raw, whole(b)), strict=True)
    return sum((jnp.sum(x != y) for x, y in pairs), start=jnp.asarray(0))


def _kink(f: Callable[[Array], Array], x: Array, J: Array, h: float = 1e-7) -> Array:
    """The largest gap between J and difference quotients to both sides, relative to max(1, |J|)."""
    ways = jax.random.normal(jax.random.key(1), (8, x.size), x.dtype)
    ways = jnp.concatenate([jnp.eye(x.size, dtype=x.dtype), ways])
    here = f(x)
    gap = lambda way, h: jnp.max(jnp.abs((f(x + h * way) - here) / h - J @ way))
    both = jax.vmap(lambda way: jnp.maximum(gap(way, h), gap(way, -h)))
    return jnp.max(both(ways)) / jnp.maximum(1.0, jnp.max(jnp.abs(J)))


def uncontrollable(A: np.ndarray, B: np.ndarray, E: np.ndarray, decay: float) -> Free:
    """Eigenvalues on or outside the unit circle that no feedback moves and that E sees.

    The part that no input reaches is split off by orthogonal steps: its eigenvalues are exact where
    those of A, in a chain, are not. Each is then held to the PBH test with a gap.
    """
    n = len(A)
    if not all(np.isfinite(M).all() for M in (A, B, E)):
        return Free([], 0, False)
    Q, clear = _orthonormal(B)
    while 0 < Q.shape[1] < n:
        wider, fine = _orthonormal(np.hstack([Q, A @ Q]))
        clear &= fine
        if wider.shape[1] == Q.shape[1]:
            break
        Q = wider
    rank, seen = Q.shape[1], []
    if rank == n:
        return Free([], n, clear)
    rest = np.linalg.svd(Q.T, full_matrices=True)[2][rank:].T if rank else np.eye(n)
    rows, fine = _orthonormal(E.T)
    clear &= fine
    values = np.linalg.eigvals(rest.T @ A @ rest)
    for value in _distinct(values[np.abs(values) >= 1 - decay]):
        pencil = np.hstack([A - value * np.eye(n), B])
        U, sizes, _ = np.linalg.svd(pencil)
        zero = sizes < EXACT
        clear &= bool(np.all(zero | (sizes > CLEAR)))
        if not zero.any():
            continue
        left = U[:, zero].conj()  # its columns are w, with w' (A - lambda) = 0 and w' B = 0
        cosines = np.linalg.svd(rows.T @ left, compute_uv=False)
        inside = cosines > 1 - EXACT
        clear &= bool(np.all(inside | (cosines < 1 - CLEAR)))
        seen += [float(abs(value))] * int(inside.sum())
    return Free(seen, rank, clear)


def _distinct(values: np.ndarray) -> list[complex]:
    """One of those that agree to CLEAR: their mean, since errors of equal ones cancel in it."""
    left, found = list(values), []
    while left:
        near = [v for v in left if abs(v - left[0]) <= CLEAR]
        left = [v for v in left if abs(v - left[0]) > CLEAR]
        found.append(complex(np.mean(near)))
    return found


def _orthonormal(M: np.ndarray) -> tuple[np.ndarray, bool]:
    """A basis of the columns' span, and whether its dimension is clear."""
    scale = np.linalg.norm(M, axis=0)
    scaled = M[:, scale > EXACT] / scale[scale > EXACT]
    if scaled.shape[1] == 0:
        return np.zeros((len(M), 0)), True
    U, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    return U[:, sizes > EXACT], bool(np.all((sizes > CLEAR) | (sizes < EXACT)))
