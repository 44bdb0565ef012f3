"""C11: exponential stability of the game's own step on an ellipsoid, proved by intervals."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float, Int

from marlyap.certificates import intervals as I
from marlyap.certificates.certificate import AbstractCertificate, Evidence, Verdict
from marlyap.certificates.intervals import Interval, Unbounded
from marlyap.certificates.linearisation import as_double, coordinates, moving_target
from marlyap.certificates.loop import ClosedLoop
from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractRegulation
from marlyap.simulation.rollout import Controller
from marlyap.types import State


AT_REST = 1e-8  # in SI units: the target set may move by no more in a step
NEWTON = 8  # steps to the exact equilibrium
HALVINGS = 30  # of the interval in which the level is sought
SLACK = 1e-9  # relative, of a norm before it is confirmed in exact arithmetic
WIDER = 1 + 1e-12  # makes up for the rounding of a few operations and of one norm
FLAT = 1e-9  # a singular value below it is zero
ROOM = 4  # times as far as the starts may lie along a target set, the team may drift
LIFE = 10**6  # steps for which it is known how far the team drifts along a target set
CLOCK = 2.0**30  # steps after which nothing is said


class Region(NamedTuple):
    """What was proved at one target, of V(x) = |S (x - x*)| with S the first rows of W."""

    W: Float[np.ndarray, "n n"]
    across: int  # rows of S; the others run along the target set
    centre: Float[np.ndarray, "n"]  # x*
    level: float  # of V
    along: float  # how far from x* along the target set a start may lie
    rate: float  # V(f(x)) <= rate V(x) + rest
    rest: float
    radius: float  # spectral radius at x*
    reach: Float[np.ndarray, "n"]  # |x_i - x*_i| on the level, at most
    midpoint: Float[np.ndarray, "m m"]  # of S J R on the box
    norm: float  # of the midpoint, at most


class Ellipsoid(AbstractCertificate):
    """Exponential stability of the whole team near its target, with the region, by proof.

    C11. With x the states of all agents (and what floats the game's memory holds), f the closed
    loop of the game's own step, observation and controller, x* = f(x*), J = df/dx and V(x) =
    |S (x - x*)|:

        V(x) <= level  =>  x in a box X,                                                     (1)
        |S J R| <= rate < 1          for every matrix J that f can have as a derivative on X, (2)
        V(f(x)) <= rate V(x) + rest, by the mean value theorem,                               (3)
        no state of X has failed, and every state with V <= 2 rest / (1 - rate) is a success, (4)

    with R the inverse of S, and rest what |S (f(x*) - x*)| is known to within, about 1e-14. So the
    level is never left, and V falls by the factor `rate` in each step until the team has arrived.

    f and J are the game's own program, run in interval arithmetic with outward rounding
    (`intervals`); (2) bounds the interval matrix by the norm of its midpoint, whose square is
    confirmed to be positive definite below rate^2 in rational arithmetic, plus the Frobenius norm
    of its radius. S comes from the Lyapunov equation (J / r)' P (J / r) - P = -I at x*, P = S'S,
    with r between the spectral radius and 1; nothing depends on how it was found. The level is the
    largest that was found by halving. Saturation, friction and networks are allowed: where an
    input may saturate, its derivative ranges over both cases, which ends the region in time.

    It speaks of exact arithmetic, of a clock that has run on to the target, and of the scenarios of
    `scenes` episodes, each with its own x*. A program that decides by a comparison within the
    region, draws random numbers or loops until something happens is refused.
    """

    scenes: int = 4  # episodes at whose targets it is proved
    confidence: float = 1.0
    evidence: ClassVar[Evidence] = "proved"

    def __check_init__(self):
        check_range("scenes", self.scenes, 1, 1_000)

    def refuse(self, loop: ClosedLoop) -> None:
        with jax.enable_x64(True):
            speed = float(moving_target(as_double(loop.game), jax.random.key(0)))
            if speed > AT_REST:
                raise UserError(
                    "ellipsoid: the target set moves in time, and it speaks of rest at one point; "
                    "take a certificate that plays the game, such as reach-and-stay."
                )
            program = Program(as_double(loop.game), as_double(loop.controller), jax.random.key(0))
            try:
                found = frame(program)
            except Unbounded as why:
                found = str(why)
        if isinstance(found, str):
            raise UserError(f"ellipsoid: at the target, {found}.")

    def check(self, loop: ClosedLoop, seed: int) -> Verdict:
        self.refuse(loop)
        with jax.enable_x64(True):
            game, controller = as_double(loop.game), as_double(loop.controller)
            keys = jax.random.split(jax.random.key(seed), self.scenes)
            found = [proved(Program(game, controller, key)) for key in keys]
        why = next((x for x in found if isinstance(x, str)), None)
        regions = [x for x in found if isinstance(x, Region)]
        worst = max((r.rate for r in regions), default=None)
        said = claim(regions, self.scenes, loop.game.dt) if why is None else why
        return Verdict(
            name="ellipsoid",
            claim=said,
            evidence=self.evidence if why is None else "observed",
            holds=why is None,
            bound=worst if why is None else None,
            confidence=None,
            scope={
                "starts": "V <= level, at the targets of these episodes",
                "horizon_steps": None,
                "disturbance": "none",
                "arithmetic": "exact",
            },
            figures=figures(regions, self.scenes),
        )


def claim(regions: Sequence[Region], scenes: int, dt: float) -> str:
    """In words, for the slowest and the smallest of the regions."""
    rate = max(r.rate for r in regions)
    reach = min(float(np.max(r.reach)) for r in regions)
    rest = max(r.rest for r in regions)
    until = f" for {LIFE} steps" if any(r.along > 0 for r in regions) else ""
    return (
        f"at {scenes} targets, from every state in an ellipsoid that reaches {reach:.3g} along its "
        f"longest coordinate (SI units), every step of the game ({dt:g} s) brings V, a quadratic "
        f"norm, to at most {rate:.6f} V + {rest:.1g}{until}; so the team arrives, and nothing fails"
    )


def figures(regions: Sequence[Region], scenes: int) -> dict[str, Any]:
    """Of each target; the arrays S and x* of the first, so that V can be computed again."""
    first = regions[0] if regions else None
    return {
        "scenes": scenes,
        "rates": [r.rate for r in regions],
        "levels": [r.level for r in regions],
        "rests": [r.rest for r in regions],
        "spectral_radii": [r.radius for r in regions],
        "reach": [] if first is None else first.reach.tolist(),
        "S": [] if first is None else first.W[: first.across].tolist(),
        "centre": [] if first is None else first.centre.tolist(),
    }


class Program:
    """The closed loop at the target of one episode, as traced operations on the team's states.

    The clock is an argument: it may show any later time.
    """

    def __init__(self, game: AbstractRegulation, controller: Controller, key: Array):
        state = game.at_target(game.reset(key))
        if not all(jnp.issubdtype(x.dtype, jnp.inexact) for x in jax.tree.leaves(state.x)):
            raise UserError("ellipsoid: the plant's states must all be real numbers.")
        self.x, put = coordinates(state)

        def step(x: Float[Array, "n"], t: Int[Array, ""]) -> Float[Array, "n"]:
            s = eqx.tree_at(lambda s: s.t, put(x), t)
            return coordinates(game.step(s, controller(s, jax.random.key(0))))[0]

        def judged(x: Float[Array, "n"]) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
            after: State = put(x)
            return game.success(after), game.failed(after)

        self.step = I.traced(step, self.x, state.t)
        self.slope = I.derivative(self.step, self.x, state.t)
        others = lambda s: (s.scenario, eqx.filter(s.memory, eqx.is_inexact_array, inverse=True))
        whole = lambda s: [x for x in jax.tree.leaves(others(s)) if eqx.is_array(x)]

        def rest(x: Float[Array, "n"], t: Int[Array, ""]) -> list[Array]:
            s = eqx.tree_at(lambda s: s.t, put(x), t)
            return whole(game.step(s, controller(s, jax.random.key(0))))

        self.judged = I.traced(judged, self.x)
        self.others, self.rest = whole(state), I.traced(rest, self.x, state.t)
        self.t = Interval(np.asarray(float(state.t)), np.asarray(float(state.t) + CLOCK))

    def __call__(self, x: Interval) -> Interval:
        return I.enclosed(self.step, [x, self.t])[0]

    def slopes(self, x: Interval, ways: Float[np.ndarray, "n m"]) -> Interval:
        """The derivatives J of the step along these columns, for all J on the box.

        The step itself must make no choice there.
        """
        self(x)
        return I.enclosed(self.slope, [x, self.t, I.point(ways)], decided=False)[0]

    def jacobian(self, x: np.ndarray) -> Float[np.ndarray, "n n"]:
        """J at a point, rounded."""
        return I.middle(self.slopes(I.point(x), np.eye(len(x))))[0]

    def keeps(self, x: Interval) -> bool:
        """Whether the step leaves alone what is not among its coordinates."""
        after = I.enclosed(self.rest, [x, self.t])
        pairs = zip(map(I.point, self.others), after, strict=True)
        return all(np.array_equal(a.low, b.low) and np.array_equal(a.low, b.high) for a, b in pairs)

    def verdict(self, x: Interval) -> tuple[bool, bool]:
        """Whether all states of the box are successes, and whether none has failed."""
        success, failed = I.enclosed(self.judged, [x])
        return bool(success.low.all()), not failed.high.any()


class Frame(NamedTuple):
    """Coordinates y = W (x - x*): first those in which V is the norm, then those along the set."""

    W: Float[np.ndarray, "n n"]
    back: Float[np.ndarray, "n n"]  # close to the inverse of W
    loss: float  # |I - back W| in the maximum norm, at most
    across: int  # how many coordinates V has

    @classmethod
    def of(cls, W: np.ndarray, across: int) -> "Frame":
        back = np.linalg.inv(W)
        gap = I.sub(I.point(np.eye(len(W))), I.matmul(I.point(back), I.point(W)))
        loss = np.max(np.sum(I.absolute(gap).high, axis=1)) * WIDER
        return cls(W, back, float(loss), across)

    def reach(self, level: float, along: float) -> np.ndarray:
        """How far x - x* reaches along each coordinate where V <= level and |s| <= along.

        x = back y + (I - back W) x, so |x_i| <= |back_i| |y| + loss |x| in the maximum norm.
        """
        norms = lambda block: np.linalg.norm(block, axis=1)
        m = self.across
        rows = (norms(self.back[:, :m]) * level + norms(self.back[:, m:]) * along) * WIDER
        return rows + self.loss * np.max(rows) / (1 - self.loss) * WIDER

    def matrix(self, program: "Program", x: Interval) -> "Blocks":
        """W J back over the box x.

        W J x = W J back y + W J (I - back W) x, and |x| <= sqrt(n) |back| |y| / (1 - loss).
        """
        n, W = len(self.W), I.point(self.W)
        mid, rad = I.middle(I.matmul(W, program.slopes(x, self.back)))
        WJ = I.matmul(W, program.slopes(x, np.eye(n)))
        size = np.linalg.norm(I.absolute(WJ).high) * np.linalg.norm(self.back)
        return Blocks(mid, rad, float(size * self.loss * n / (1 - self.loss) * WIDER))


class Blocks(NamedTuple):
    """An interval matrix as midpoint and radius, and what norm the rest may have."""

    mid: Float[np.ndarray, "n n"]
    rad: Float[np.ndarray, "n n"]
    lost: float

    def size(self, rows: slice, columns: slice, about: np.ndarray | float = 0.0) -> float:
        """The norm of a block, less `about`, at most."""
        block = np.linalg.norm(self.mid[rows, columns] - about)
        return float((block + np.linalg.norm(self.rad[rows, columns]) + self.lost) * WIDER)


class Near(NamedTuple):
    """The loop at its equilibrium, and the coordinates in which it contracts."""

    frame: Frame
    centre: Float[np.ndarray, "n"]
    radius: float  # spectral radius, across the target set
    most: float  # the largest rate that is of use


def frame(program: Program) -> Near | str:
    """What the linear part suggests, or in words why it suggests nothing; nothing is proved yet."""
    centre = equilibrium(program)
    J = program.jacobian(centre)
    along = null_space(J - np.eye(len(J)))
    across = null_space(along.T) if along.size else np.eye(len(J))
    if not across.size:
        return "the closed loop leaves every state where it is"
    slow = across.T @ J @ across
    radius = float(np.max(np.abs(np.linalg.eigvals(slow)), initial=0.0))
    if not radius < 1 - 1e-9:
        return f"the closed loop has spectral radius {radius:.6f}, which shows no stability"
    # Rows that the loop leaves alone, so that what happens across does not pull along the set.
    still = null_space((J - np.eye(len(J))).T).T if along.size else along.T
    if len(still) != along.shape[1]:
        return "the closed loop drifts along the target set"
    if not program.verdict(I.point(centre))[0]:
        return "the equilibrium of the closed loop is no success of the game"
    between = max((1 + radius) / 2, 0.5)
    P = scipy.linalg.solve_discrete_lyapunov((slow / between).T, np.eye(len(slow)))
    S = np.linalg.cholesky((P + P.T) / 2).T
    W = np.vstack([S / np.linalg.norm(S, 2) @ across.T, still])
    return Near(Frame.of(W, len(slow)), centre, radius, (1 + between) / 2)


def proved(program: Program) -> Region | str:
    """The largest region, by halving on a scale of powers; or in words why there is none."""
    try:
        near = frame(program)
    except Unbounded as why:
        return f"no region was found: {why} at the target"
    if isinstance(near, str):
        return f"no region was found: {near}"
    low, high, best, why = -12.0, 6.0, None, "it contracts nowhere"
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        found = contracts(program, near, 10.0**middle)
        if isinstance(found, Region):
            low, best = middle, found
        else:
            high, why = middle, found
    if best is None:
        return f"no region was found: {why}"
    if not shorter(best.midpoint, best.norm):
        return "no region was found: its norm was not confirmed in exact arithmetic"
    return best


def null_space(M: np.ndarray) -> np.ndarray:
    """Orthonormal columns on which M is zero, but for rounding."""
    _, sizes, rows = np.linalg.svd(M)
    rank = int(np.sum(sizes > FLAT * max(1.0, sizes.max(initial=0.0))))
    return rows[rank:].T


def equilibrium(program: Program) -> np.ndarray:
    """A point that the loop leaves within rounding, by Newton's method from the target."""
    x = np.asarray(program.x, float)
    for _ in range(NEWTON):
        gap = I.middle(program(I.point(x)))[0] - x
        J = program.jacobian(x)
        x = x - np.linalg.lstsq(J - np.eye(len(x)), gap, rcond=FLAT)[0]
    return x


def contracts(program: Program, near: Near, level: float) -> Region | str:
    """The region of this level, if all lines of the certificate hold; else why not."""
    frame, centre, radius, most = near
    m, further = frame.across, frame.across < len(centre)
    start, along = (level, ROOM * level) if further else (0.0, 0.0)  # of |s|
    reach = frame.reach(level, along)
    around = lambda reach: I.outward(centre - reach, centre + reach)
    on, off = slice(m), slice(m, None)
    try:
        M = frame.matrix(program, around(reach))
        norm = float(np.linalg.norm(M.mid[on, on], 2) * (1 + SLACK))
        rate = float((norm + np.linalg.norm(M.rad[on, on]) + M.lost) * WIDER)
        if not rate <= most:
            return f"V does not fall there (factor {rate:.4f})"
        if not program.verdict(around(reach))[1]:
            return "a state there has failed, or may have"
        if not program.keeps(around(reach)):
            return "the step changes the scenario, or counts in its memory"
        still = I.sub(program(I.point(centre)), I.point(centre))
        moved = I.absolute(I.matmul(I.point(frame.W), _column(still))).high[:, 0]
        rest = float((np.linalg.norm(moved[on]) + M.size(on, off) * along * further) * WIDER)
        end = 2 * rest * WIDER / (1 - rate)
        if further:
            pull = M.size(off, on) * (level / (1 - rate) + LIFE * end)
            drift = pull + LIFE * float(np.linalg.norm(moved[off]))
            grow = np.exp(LIFE * M.size(off, off, np.eye(len(centre) - m)))
            if not (start + drift) * grow * WIDER <= along:
                return "the team may drift too far along the target set"
        if not (end <= level and program.verdict(around(frame.reach(end, along)))[0]):
            return "the equilibrium is no success of the game"
    except Unbounded as why:
        return str(why)
    return Region(
        frame.W, m, centre, level, start, float(rate), rest, radius, reach, M.mid[on, on], norm
    )


def _column(x: Interval) -> Interval:
    return Interval(x.low[:, None], x.high[:, None])


def shorter(M: np.ndarray, norm: float) -> bool:
    """Whether |M x| <= norm |x| for all x: norm^2 I - M'M is positive definite, in fractions."""
    rows = [[Fraction(float(v)) for v in row] for row in M]
    n, most = len(rows), Fraction(norm) ** 2
    A = [[sum((r[i] * r[j] for r in rows), Fraction()) for j in range(n)] for i in range(n)]
    A = [[(most if i == j else 0) - A[i][j] for j in range(n)] for i in range(n)]
    return positive_definite(A)


def positive_definite(A: list[list[Fraction]]) -> bool:
    """Of a symmetric matrix of fractions, by the signs of its pivots (no fractions are divided)."""
    scale = max(v.denominator for row in A for v in row)
    if any(scale % v.denominator for row in A for v in row):
        raise ValueError("the fractions must be those of float64")  # powers of two
    whole = [[int(v * scale) for v in row] for row in A]
    before = 1
    for k in range(len(whole)):  # Bareiss: every division is exact
        pivot = whole[k][k]
        if pivot <= 0:
            return False
        for i in range(k + 1, len(whole)):
            for j in range(k + 1, len(whole)):
                whole[i][j] = (whole[i][j] * pivot - whole[i][k] * whole[k][j]) // before
        before = pivot
    return True
