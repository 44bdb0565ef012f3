"""Interval arithmetic on the very program that a game's step compiles to.

`traced(f, x)` records f as a list of primitive operations (a jaxpr), and `enclosed` runs that list
on intervals. Every operation rounds outward in float64, so what comes out contains f(x) in exact
arithmetic for every x in the box. An operation that is not known here is refused by name.

A function that was given a derivative of its own (`jax.custom_jvp`, `stop_gradient`) is opened
up first: only the derivatives of the operations themselves are believed.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import Array, Float

from marlyap.errors import UserError


UNIT = 2.0**-53  # the largest relative error of one rounded operation in float64
ULPS = 4  # how far a library's sin, exp, tanh and so on may be off
MOST = 200  # rounds of a loop that are unrolled
CALLS = ("jit", "pjit", "closed_call", "core_call", "remat", "checkpoint", "custom_jvp_call")
CALLS += ("custom_vjp_call", "custom_vjp_call_jaxpr", "custom_vmap_call")


Numbers = Any  # an array of float64 or bool, or the one number that NumPy makes of it
NOTHING: Mapping[str, Callable[..., Any]] = {}


class Unbounded(Exception):
    """The box is too large: an operation leaves its domain, or a decision depends on the state."""


class Interval(NamedTuple):
    """All values between `low` and `high`; of truth values, what is surely and what may be true."""

    low: Numbers
    high: Numbers

    @property
    def exact(self) -> bool:
        return bool(np.array_equal(self.low, self.high))


class Traced(NamedTuple):
    """A function as its list of operations."""

    jaxpr: Any
    consts: Sequence[Any]


def traced(f: Callable[..., Any], *x: Any) -> Traced:
    """The operations of f at arguments like x, without the derivatives that f may claim.

    Raises UserError where f calls back into Python.
    """
    whole = jax.make_jaxpr(f)(*x)
    plain = jax.make_jaxpr(lambda *x: opened(whole.jaxpr, whole.consts, x))(*x)
    return Traced(plain.jaxpr, plain.consts)


@jax.custom_jvp
def _larger(x: Array, y: Array) -> Array:
    return jax.lax.max(x, y)


@_larger.defjvp
def _(at: Any, ways: Any) -> Any:
    (x, y), (dx, dy) = at, ways
    return jax.lax.max(x, y), jnp.where(x > y, dx, dy)


def _real(x: Array) -> Array:
    if jnp.iscomplexobj(x):
        raise UserError("ellipsoid: complex numbers in the closed loop are not covered.")
    return x


# What has a kink is differentiated by a choice between two smooth functions: JAX's own rules ask
# whether a result equals an argument, which intervals cannot tell.
KINKS: Mapping[str, Callable[..., Any]] = {
    "max": _larger,
    "min": lambda x, y: -_larger(-x, -y),
    "abs": lambda x: _larger(_real(x), -x),
    "clamp": lambda low, x, high: -_larger(-_larger(x, low), -high),
}


def derivative(f: Traced, x: Float[Array, "n"], *others: Any) -> Traced:
    """The operations of df/dx B, with B [n, m] a last argument, for a traced f of x and others.

    What cancels along a column of B is gone before any interval has been formed.
    """
    plain = lambda x, *others: opened(f.jaxpr, f.consts, (x, *others), KINKS)[0]

    def along(x: Array, *rest: Any) -> Array:
        *others, B = rest
        slope = lambda way: jax.jvp(lambda x: plain(x, *others), (x,), (way,))[1]
        return jax.vmap(slope, in_axes=1, out_axes=1)(B)

    whole = jax.make_jaxpr(along)(x, *others, jnp.eye(x.size))
    return Traced(whole.jaxpr, whole.consts)


def opened(
    jaxpr: Any,
    consts: Sequence[Any],
    args: Sequence[Any],
    instead: Mapping[str, Callable[..., Any]] = NOTHING,
) -> list[Any]:
    """Run the operations as they are, calls and functions with rules of their own unfolded.

    `instead` holds other functions for some of them, by name.
    """
    known: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    known |= dict(zip(jaxpr.invars, args, strict=True))
    read = lambda v: v.val if isinstance(v, core.Literal) else known[v]
    for eqn in _needed(jaxpr):
        given = [read(v) for v in eqn.invars]
        inner = _inner(eqn)
        if inner is not None:
            out = opened(*inner, given, instead)
        elif eqn.primitive.name == "stop_gradient":  # it says of a function that it does not change
            out = given
        elif eqn.primitive.name in instead:
            out = [instead[eqn.primitive.name](*given)]
        else:
            out = eqn.primitive.bind(*given, **eqn.params)
            out = out if eqn.primitive.multiple_results else [out]
        known |= dict(zip(eqn.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _inner(eqn: Any) -> tuple[Any, Sequence[Any]] | None:
    """The operations inside a call; None for an operation."""
    if eqn.primitive.name not in CALLS:
        return None
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call"):
        if key in eqn.params:
            found = eqn.params[key]
            return (found.jaxpr, found.consts) if hasattr(found, "consts") else (found, ())
    raise UserError(f"ellipsoid: the call '{eqn.primitive.name}' cannot be opened.")


def _needed(jaxpr: Any) -> list[Any]:
    """The operations on which the result depends, in order."""
    wanted = {v for v in jaxpr.outvars if not isinstance(v, core.Literal)}
    kept = []
    for eqn in reversed(jaxpr.eqns):
        if wanted & {*eqn.outvars}:
            kept.append(eqn)
            wanted |= {v for v in eqn.invars if not isinstance(v, core.Literal)}
    return kept[::-1]


def enclosed(f: Traced, args: Sequence[Interval], decided: bool = True) -> list[Interval]:
    """The values of f for all arguments in the intervals.

    With `decided` a choice (`where`, `sign`) must fall the same way for all of them. Without it
    both ways are joined, which is right for a derivative: a Lipschitz function changes by no more
    than its derivatives on either side of a kink allow.

    Raises Unbounded where the intervals are too wide, and UserError for an unknown operation.
    """
    known: dict[Any, Interval] = {}
    known |= dict(zip(f.jaxpr.constvars, map(point, f.consts), strict=True))
    known |= dict(zip(f.jaxpr.invars, args, strict=True))
    read = lambda v: point(v.val) if isinstance(v, core.Literal) else known[v]
    for eqn in _needed(f.jaxpr):
        given = [read(v) for v in eqn.invars]
        out = _run(eqn, given, decided)
        for x in out:
            if x.low.dtype != bool and (np.isnan(x.low) | np.isnan(x.high)).any():
                raise Unbounded(f"{eqn.primitive.name} has no bound")
        known |= dict(zip(eqn.outvars, out, strict=True))
    out = [read(v) for v in f.jaxpr.outvars]
    if not all(np.isfinite(x.low).all() and np.isfinite(x.high).all() for x in out):
        raise Unbounded("a result has no bound")
    return out


def point(value: Any) -> Interval:
    """One value. Of a random key only the fact that there is one is kept."""
    if jnp.issubdtype(jnp.result_type(value), jax.dtypes.prng_key):
        value = np.zeros(jnp.shape(value))
    array = np.asarray(value)
    array = array if array.dtype == bool else array.astype(np.float64)
    return Interval(array, array)


def outward(low: Numbers, high: Numbers, ulps: int = 1) -> Interval:
    """Wider by so many units in the last place at both ends."""
    for _ in range(ulps):
        low, high = np.nextafter(low, -np.inf), np.nextafter(high, np.inf)
    return Interval(low, high)


# --- arithmetic ----------------------------------------------------------------------------------


def add(x: Interval, y: Interval) -> Interval:
    return outward(x.low + y.low, x.high + y.high)


def neg(x: Interval) -> Interval:
    return Interval(-x.high, -x.low)


def sub(x: Interval, y: Interval) -> Interval:
    return add(x, neg(y))


def mul(x: Interval, y: Interval) -> Interval:
    ends = [x.low * y.low, x.low * y.high, x.high * y.low, x.high * y.high]
    return outward(np.minimum.reduce(ends), np.maximum.reduce(ends))


def div(x: Interval, y: Interval) -> Interval:
    """Of real numbers; whole ones are refused by `_whole`, since they would be cut."""
    if ((y.low <= 0) & (y.high >= 0)).any():
        raise Unbounded("a division by zero")
    ends = [x.low / y.low, x.low / y.high, x.high / y.low, x.high / y.high]
    return outward(np.minimum.reduce(ends), np.maximum.reduce(ends))


def power(x: Interval, n: int) -> Interval:
    """x^n for a whole n."""
    if n < 0:
        return div(point(np.ones(())), power(x, -n))
    low, high = x.low**n, x.high**n
    if n % 2 == 0:
        inside = (x.low <= 0) & (x.high >= 0)
        low, high = np.where(inside, 0.0, np.minimum(low, high)), np.maximum(low, high)
        wide = outward(low, high, n + 1)
        return Interval(np.maximum(wide.low, 0.0), wide.high)
    return outward(low, high, n + 1)


def rising(f: Callable[[Numbers], Numbers]) -> Callable[[Interval], Interval]:
    """A library function that never falls."""
    return lambda x: outward(f(x.low), f(x.high), ULPS)


def sqrt(x: Interval) -> Interval:
    if (x.low < 0).any():
        raise Unbounded("a square root of a negative number")
    root = rising(np.sqrt)(x)
    return Interval(np.maximum(root.low, 0.0), root.high)


def log(x: Interval) -> Interval:
    if (x.low <= 0).any():
        raise Unbounded("a logarithm of zero")
    return rising(np.log)(x)


def sin(x: Interval, peak: float = np.pi / 2) -> Interval:
    """Of a sine whose highest points lie at peak + 2 pi k."""
    wave = lambda a: np.cos(a - peak) if peak == 0 else np.sin(a)
    ends = outward(*_sorted(wave(x.low), wave(x.high)), ulps=ULPS)
    has = lambda p: p + 2 * np.pi * np.ceil((x.low - p) / (2 * np.pi) - 1e-9) <= x.high + 1e-8
    low = np.where(has(peak - np.pi), -1.0, np.maximum(ends.low, -1.0))
    return Interval(low, np.where(has(peak), 1.0, np.minimum(ends.high, 1.0)))


def cos(x: Interval) -> Interval:
    return sin(x, peak=0.0)


def _sorted(a: Numbers, b: Numbers) -> tuple[Numbers, Numbers]:
    return np.minimum(a, b), np.maximum(a, b)


def absolute(x: Interval) -> Interval:
    low, high = _sorted(np.abs(x.low), np.abs(x.high))
    return Interval(np.where((x.low <= 0) & (x.high >= 0), 0.0, low), high)


def logistic(x: Interval) -> Interval:
    one = point(np.ones(()))
    return div(one, add(one, rising(np.exp)(neg(x))))


def atan2(y: Interval, x: Interval) -> Interval:
    if (x.low <= 0).any():
        raise Unbounded("an angle beyond a quarter turn")
    return rising(np.arctan)(div(y, x))


def matmul(x: Interval, y: Interval) -> Interval:
    """x y for matrices, by midpoint and radius."""
    (a, da), (b, db) = middle(x), middle(y)
    size = np.abs(a) @ np.abs(b)
    rad = np.abs(a) @ db + da @ (np.abs(b) + db)
    rad = (rad + 4 * (a.shape[-1] + 2) * UNIT * (size + rad)) * (1 + 8 * UNIT)
    mid = a @ b
    return outward(mid - rad, mid + rad)


def middle(x: Interval) -> tuple[Numbers, Numbers]:
    """A point of the interval, and how far away the others are at most."""
    mid = x.low + (x.high - x.low) / 2
    rad = np.maximum(mid - x.low, x.high - mid)
    return mid, np.where(x.low == x.high, 0.0, np.nextafter(rad * (1 + 4 * UNIT), np.inf))


def summed(x: Interval, axes: tuple[int, ...]) -> Interval:
    """The sum along axes, wider by what the order of the additions may change."""
    count = int(np.prod([x.low.shape[a] for a in axes], dtype=int))
    size = np.sum(np.maximum(np.abs(x.low), np.abs(x.high)), axis=axes)
    lost = 2 * (count + 2) * UNIT * size
    wide = outward(np.sum(x.low, axis=axes) - lost, np.sum(x.high, axis=axes) + lost)
    positive = np.all(x.low >= 0, axis=axes)
    return Interval(np.where(positive, np.maximum(wide.low, 0.0), wide.low), wide.high)


# --- the operations of a jaxpr -------------------------------------------------------------------


def _run(eqn: Any, given: list[Interval], decided: bool) -> list[Interval]:
    name, params = eqn.primitive.name, eqn.params
    inner = _inner(eqn)
    if inner is not None:
        return enclosed(Traced(*inner), given, decided)
    if name == "scan":
        return _scan(params, given, decided)
    if len(eqn.invars) == 2 and eqn.invars[0] is eqn.invars[1] and name in ALIKE:
        return [_whole(eqn, ALIKE[name](given[0]))]
    if name in CHOICES:
        return [CHOICES[name](given, decided)]
    if name in ARITHMETIC:
        return [_whole(eqn, ARITHMETIC[name](*given))]
    if name in MOVES:
        low = MOVES[name]([x.low for x in given], params)
        high = MOVES[name]([x.high for x in given], params)
        several = eqn.primitive.multiple_results
        return (
            [Interval(*p) for p in zip(low, high, strict=True)]
            if several
            else [Interval(low, high)]
        )
    if name in SPECIAL:
        return [_whole(eqn, SPECIAL[name](given, params, eqn))]
    raise UserError(f"ellipsoid: the operation '{name}' of the closed loop is not covered.")


def _whole(eqn: Any, x: Interval) -> Interval:
    """Whole numbers are not rounded, and not divided."""
    if x.low.dtype != bool and not jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.inexact):
        if eqn.primitive.name == "div":
            raise UserError("ellipsoid: a division of whole numbers is not covered.")
        return Interval(np.round(x.low), np.round(x.high))
    return x


def _scan(params: Any, given: list[Interval], decided: bool) -> list[Interval]:
    """A loop of known length, one round after the other."""
    if params["length"] > MOST:
        raise UserError(f"ellipsoid: a loop of {params['length']} rounds is too long to follow.")
    body = Traced(params["jaxpr"].jaxpr, params["jaxpr"].consts)
    consts, carried = params["num_consts"], params["num_carry"]
    fixed, carry = given[:consts], given[consts : consts + carried]
    over, ys = given[consts + carried :], []
    rounds = range(params["length"])
    for k in reversed(rounds) if params["reverse"] else rounds:
        now = [Interval(x.low[k], x.high[k]) for x in over]
        out = enclosed(body, [*fixed, *carry, *now], decided)
        carry = out[:carried]
        ys.append(out[carried:])
    ys = ys[::-1] if params["reverse"] else ys
    stack = lambda xs: Interval(np.stack([x.low for x in xs]), np.stack([x.high for x in xs]))
    return [*carry, *map(stack, zip(*ys, strict=True))]


def _select(given: list[Interval], decided: bool) -> Interval:
    which, *cases = given
    if which.low.dtype == bool:
        which = Interval(which.low.astype(float), which.high.astype(float))
    if which.exact:
        pick = lambda of: np.choose(which.low.astype(int), [of(c) for c in cases])
        return Interval(pick(lambda c: c.low), pick(lambda c: c.high))
    if decided and not (which.exact or _alike(which, cases)):
        raise Unbounded("a choice that depends on the state")
    low = np.full(np.broadcast_shapes(which.low.shape, cases[0].low.shape), np.inf)
    high = -low
    for k, case in enumerate(cases):
        may = (which.low <= k) & (k <= which.high)
        low = np.where(may, np.minimum(low, case.low), low)
        high = np.where(may, np.maximum(high, case.high), high)
    return Interval(low, high)


def _alike(which: Interval, cases: list[Interval]) -> bool:
    """Whether nothing hangs on the choices that are open, since all cases are one value."""
    first, open_ = cases[0], which.low != which.high
    same = [(c.low == first.low) & (c.high == first.high) & (c.low == c.high) for c in cases]
    return bool(np.all(~open_ | np.logical_and.reduce(same)))


def _sign(given: list[Interval], decided: bool) -> Interval:
    low, high = np.sign(given[0].low), np.sign(given[0].high)
    if decided and not np.array_equal(low, high):
        raise Unbounded("a sign that depends on the state")
    return Interval(low, high)


def _steps(f: Callable[[Numbers], Numbers]) -> Callable[[list[Interval], bool], Interval]:
    """A function with jumps, such as rounding down."""

    def run(given: list[Interval], decided: bool) -> Interval:
        low, high = f(given[0].low), f(given[0].high)
        if not np.array_equal(low, high):
            raise Unbounded("a rounding that depends on the state")
        return Interval(low, high)

    return run


def _rem(given: list[Interval], decided: bool) -> Interval:
    x, y = given
    rounds = np.trunc(x.low / y.low)
    if not y.exact or not np.array_equal(rounds, np.trunc(x.high / y.low)):
        raise Unbounded("a remainder that jumps")
    return sub(x, mul(point(rounds), y))


def _compare(
    surely: Callable[[Interval, Interval], Numbers], may: Callable[[Interval, Interval], Any]
) -> Callable[[Interval, Interval], Interval]:
    return lambda x, y: Interval(np.asarray(surely(x, y)), np.asarray(may(x, y)))


def _equal(x: Interval, y: Interval) -> Interval:
    same = (x.low == x.high) & (y.low == y.high) & (x.low == y.low)
    return Interval(np.asarray(same), np.asarray((x.low <= y.high) & (y.low <= x.high)))


def _not(x: Interval) -> Interval:
    return Interval(~x.high, ~x.low)


def _clamp(low: Interval, x: Interval, high: Interval) -> Interval:
    return _both(np.minimum)(_both(np.maximum)(x, low), high)


def _both(f: Callable[[Numbers, Numbers], Numbers]) -> Callable[..., Interval]:
    return lambda x, y: Interval(f(x.low, y.low), f(x.high, y.high))


CHOICES: dict[str, Callable[[list[Interval], bool], Interval]] = {
    "select_n": _select, "sign": _sign, "floor": _steps(np.floor), "ceil": _steps(np.ceil),
    "round": _steps(np.round), "rem": _rem,
}  # fmt: skip

ARITHMETIC: dict[str, Callable[..., Interval]] = {
    "add": add, "add_any": add, "sub": sub, "mul": mul, "div": div, "neg": neg, "sqrt": sqrt,
    "sin": sin, "cos": cos, "exp": rising(np.exp), "log": log, "tanh": rising(np.tanh),
    "atan": rising(np.arctan), "log1p": rising(np.log1p), "expm1": rising(np.expm1),
    "abs": absolute, "logistic": logistic, "atan2": atan2, "square": lambda x: power(x, 2),
    "max": _both(np.maximum), "min": _both(np.minimum), "clamp": _clamp, "not": _not,
    "and": _both(np.logical_and), "or": _both(np.logical_or), "eq": _equal,
    "ne": lambda x, y: _not(_equal(x, y)), "copy": lambda x: x,
    "lt": _compare(lambda x, y: x.high < y.low, lambda x, y: x.low < y.high),
    "le": _compare(lambda x, y: x.high <= y.low, lambda x, y: x.low <= y.high),
    "gt": _compare(lambda x, y: x.low > y.high, lambda x, y: x.high > y.low),
    "ge": _compare(lambda x, y: x.low >= y.high, lambda x, y: x.high >= y.low),
    "rsqrt": lambda x: div(point(np.ones(())), sqrt(x)),
    "pow": lambda x, y: rising(np.exp)(mul(y, log(x))),
}  # fmt: skip


# Of a number and itself, of which intervals would forget that it is the same one.
ALIKE: dict[str, Callable[[Interval], Interval]] = {
    "mul": lambda x: power(x, 2),
    "sub": lambda x: point(np.zeros(x.low.shape)),
    "eq": lambda x: point(np.ones(x.low.shape, bool)),
    "ne": lambda x: point(np.zeros(x.low.shape, bool)),
}


def _broadcast(x: Numbers, p: Any) -> Numbers:
    place = [1] * len(p["shape"])
    for size, dim in zip(x.shape, p["broadcast_dimensions"], strict=True):
        place[dim] = size
    return np.broadcast_to(x.reshape(place), p["shape"])


def _slice(x: Numbers, p: Any) -> Numbers:
    strides = p["strides"] or [1] * x.ndim
    ends = zip(p["start_indices"], p["limit_indices"], strides, strict=True)
    return x[tuple(slice(*e) for e in ends)]


def _split(x: Numbers, p: Any) -> list[Numbers]:
    return np.split(x, np.cumsum(p["sizes"])[:-1], axis=p["axis"])


# Moves of numbers, the same at both ends.
MOVES: dict[str, Callable[[list[Numbers], Any], Any]] = {
    "reshape": lambda x, p: x[0].reshape(p["new_sizes"]),
    "broadcast_in_dim": lambda x, p: _broadcast(x[0], p),
    "slice": lambda x, p: _slice(x[0], p),
    "squeeze": lambda x, p: np.squeeze(x[0], tuple(p["dimensions"])),
    "expand_dims": lambda x, p: np.expand_dims(x[0], tuple(p["dimensions"])),
    "transpose": lambda x, p: np.transpose(x[0], p["permutation"]),
    "rev": lambda x, p: np.flip(x[0], p["dimensions"]),
    "concatenate": lambda x, p: np.concatenate(x, axis=p["dimension"]),
    "stack": lambda x, p: np.stack(x, axis=p.get("axis", 0)),
    "split": lambda x, p: _split(x[0], p),
    "reduce_max": lambda x, p: np.max(x[0], axis=tuple(p["axes"])),
    "reduce_min": lambda x, p: np.min(x[0], axis=tuple(p["axes"])),
    "reduce_and": lambda x, p: np.all(x[0], axis=tuple(p["axes"])),
    "reduce_or": lambda x, p: np.any(x[0], axis=tuple(p["axes"])),
}


def _gather(given: list[Interval], p: Any, eqn: Any) -> Interval:
    """Numbers picked by indices that are known."""
    return _by_index(eqn, given, lambda x: x)


def _scatter_add(given: list[Interval], p: Any, eqn: Any) -> Interval:
    """Numbers added to those at known places, in whatever order."""
    rounded = _by_index(eqn, given, lambda x: x)
    largest = lambda x: np.maximum(np.abs(x.low), np.abs(x.high))
    sizes = [Interval(largest(x), largest(x)) if k != 1 else x for k, x in enumerate(given)]
    lost = 2 * (given[2].low.size + 2) * UNIT * _by_index(eqn, sizes, lambda x: x).high
    return outward(rounded.low - lost, rounded.high + lost)


def _by_index(eqn: Any, given: list[Interval], of: Callable[[Any], Any]) -> Interval:
    if not given[1].exact:
        raise Unbounded("an index that depends on the state")
    index = jnp.asarray(given[1].low.astype(np.int64), eqn.invars[1].aval.dtype)

    def run(ends: list[Numbers]) -> Numbers:
        args = [index if k == 1 else jnp.asarray(end) for k, end in enumerate(ends)]
        return np.asarray(eqn.primitive.bind(*args, **eqn.params))

    return Interval(run([x.low for x in given]), run([x.high for x in given]))


def _dot(given: list[Interval], p: Any, eqn: Any) -> Interval:
    """dot_general, as one product of matrices for each place of the batch."""
    (inner, batch), names = p["dimension_numbers"], iter(range(100))
    x_names, y_names = ([-1] * g.low.ndim for g in given)
    for a, b in [*zip(*batch, strict=True), *zip(*inner, strict=True)]:
        x_names[a] = y_names[b] = next(names)
    free = lambda own: [n if n >= 0 else next(names) for n in own]
    x_names, y_names = free(x_names), free(y_names)
    kept = [x_names[a] for a in batch[0]]
    summed_over = {x_names[a] for a in inner[0]}
    out = kept + [n for n in x_names if n not in summed_over and n not in kept]
    out += [n for n in y_names if n not in summed_over and n not in kept]
    product = lambda a, b: np.einsum(a, x_names, b, y_names, out)
    (a, da), (b, db) = map(middle, given)
    terms = int(np.prod([given[0].low.shape[k] for k in inner[0]], dtype=int))
    size, rad = product(np.abs(a), np.abs(b)), product(np.abs(a), db)
    rad = rad + product(da, np.abs(b) + db)
    rad = (rad + 4 * (terms + 2) * UNIT * (size + rad)) * (1 + 8 * UNIT)
    mid = product(a, b)
    return outward(mid - rad, mid + rad)


def _convert(given: list[Interval], p: Any, eqn: Any) -> Interval:
    """Another type: reals stay what they are; a truth value becomes 0 or 1."""
    x, new = given[0], p["new_dtype"]
    if jnp.issubdtype(new, jnp.bool_):
        return x if x.low.dtype == bool else _not(_equal(x, point(np.zeros(()))))
    if x.low.dtype == bool or jnp.issubdtype(new, jnp.inexact):
        return Interval(x.low.astype(float), x.high.astype(float))
    whole = jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.integer)
    if not whole and not x.exact:
        raise Unbounded("a whole number made of the state")
    return Interval(np.trunc(x.low), np.trunc(x.high))


def _iota(given: list[Interval], p: Any, eqn: Any) -> Interval:
    shape = [1] * len(p["shape"])
    shape[p["dimension"]] = p["shape"][p["dimension"]]
    return point(np.broadcast_to(np.arange(max(shape)).reshape(shape), p["shape"]))


SPECIAL: dict[str, Callable[[list[Interval], Any, Any], Interval]] = {
    "gather": _gather, "scatter": _gather, "scatter-add": _scatter_add, "dot_general": _dot,
    "convert_element_type": _convert, "iota": _iota,
    "integer_pow": lambda given, p, eqn: power(given[0], p["y"]),
    "reduce_sum": lambda given, p, eqn: summed(given[0], tuple(int(a) for a in p["axes"])),
    "is_finite": lambda given, p, eqn: point(np.ones(given[0].low.shape, bool)),
}  # fmt: skip
