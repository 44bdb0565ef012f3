"""Does a task keep the laws that training, evaluation and the certificates rely on?

`conformance` plays a few episodes with random actions, disturbs what it saw, and holds every law of
`LAWS` against it: more than the checks of PettingZoo ask, which look at one step and accept NaN.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from marlyap.errors import first_line, raised_at
from marlyap.game import AbstractGame
from marlyap.lyapunov_function import at_target
from marlyap.rollout import rollout
from marlyap.types import Action, Key, Keys, State, Trajectory


EPISODES, ROWS = 8, 64  # played, and looked at in one call
ENDS = [0, ROWS - 1]
SOME = 16  # agents that are moved one by one, when there are more
NUDGES = (1e-3, 0.3)  # by which they are moved (m)
HALVINGS, STEEPER = 10, 8.0  # a slope that grows this much while a pair closes in is a jump

Faults = Iterator[str]  # one sentence each: the method, what is wrong, the mend


class Finding(NamedTuple):
    """What was found of one law."""

    law: str
    says: str
    faults: tuple[str, ...] | None  # None: it could not be looked at
    figures: dict[str, float]


def conformance(
    game: AbstractGame, seed: int = 0, laws: "Sequence[Callable[[Probe], Faults]] | None" = None
) -> list[Finding]:
    """One finding for each law (default: all). An exception that the task raises is a fault too."""
    laws = LAWS if laws is None else laws
    faults = tuple(_caught(lambda: shapes(game)))
    try:
        probe = None if faults else Probe(game, seed)
    except Exception as error:
        probe, faults = None, (_raised("task", error),)
    found = [Finding("shapes", _says(shapes), faults, {})]
    for law in laws:
        faults, figures = None, {}
        if probe:
            probe.figures = figures
            faults = tuple(_caught(lambda law=law: law(probe)))
        found.append(Finding(law.__name__, _says(law), faults, figures))
    return found


def _says(law: Callable) -> str:
    return (law.__doc__ or "").splitlines()[0].rstrip(".")


def _caught(law: Callable[[], Faults]) -> Faults:
    try:
        yield from law()
    except Exception as error:
        yield _raised("task", error)


def _raised(method: str, error: Exception) -> str:
    traced = isinstance(error, (jax.errors.JAXTypeError, jax.errors.JAXIndexError))
    mend = "use jnp.where, not if or float()" if traced else "let it return for every state"
    place = f" at {place}" if (place := raised_at(error)) else ""
    return f"{method}: it raised {first_line(error)}{place}; {mend}."


# --- What is looked at ---------------------------------------------------------------------------


METHODS = {"obs": "observe", "next": "step"}  # the others are called as their key


def see(game: AbstractGame, state: State, action: Action) -> dict[str, Any]:
    """Everything a game says of one state and action."""
    return {
        "obs": game.observations(state),
        "features": game.features(state),
        "errors": game.errors(state),
        "costs": game.costs(state, action),
        "cost": game.cost(state, action),
        "rewards": game.rewards(state, action),
        "distance": game.distance(state),
        "success": game.success(state),
        "violations": game.violations(state),
        "terminated": game.terminated(state),
        "linked": game.linked(state),
        "next": game.step(state, action),
    }


@eqx.filter_jit
def _play(game: AbstractGame, keys: Keys) -> Trajectory:
    """Whole episodes under uniformly random actions."""

    def one(key: Key) -> Trajectory:
        k_start, k_act = jax.random.split(key)
        size = (game.agents, game.dynamics.du)
        at_random = lambda _, key: jax.random.uniform(key, size, minval=-1.0)
        return rollout(game, at_random, game.reset(k_start), k_act)

    return jax.vmap(one)(keys)


@eqx.filter_jit
def _rest(game: AbstractGame, states: State) -> State:
    return jax.vmap(lambda s: at_target(game, s))(states)


class Probe:
    """What was seen of a game: `states` and `actions` of ROWS moments, and what it says of them."""

    def __init__(self, game: AbstractGame, seed: int = 0):
        self.game, self.traces, self.figures = game, 0, {}
        self.keys = jax.random.split(jax.random.key(seed), EPISODES)
        self.played = plain(_play(game, self.keys))
        running = ~np.concatenate([np.zeros((EPISODES, 1), bool), self.played.terminated], 1)
        episode, time = np.nonzero(running[:, :-1])
        pick = np.linspace(0, len(time) - 1, ROWS).astype(int)
        at = lambda leaf: np.asarray(leaf)[episode[pick], time[pick]]
        self.states = jax.tree.map(at, self.played.state)
        self.actions = at(self.played.action)
        self.starts = jax.tree.map(lambda leaf: leaf[:, 0], self.played.state)
        self._look = eqx.filter_jit(self._traced)
        self.seen = self.look(self.states, self.actions)

    def _traced(self, game: AbstractGame, states: State, actions: Array) -> dict[str, Any]:
        self.traces += 1
        return jax.vmap(lambda s, a: see(game, s, a))(states, actions)

    def look(self, states: State, actions: Any, game: AbstractGame | None = None) -> dict[str, Any]:
        """`see` for ROWS states: one compilation serves all laws, and its traces are counted."""
        arrays = jax.tree.map(jnp.asarray, (states, actions))
        return plain(self._look(game or self.game, *arrays))

    def target(self, states: State | None = None) -> State:
        """The same scenes with every agent at rest where it has to be."""
        arrays = jax.tree.map(jnp.asarray, states or self.states)
        return plain(_rest(self.game, arrays))

    def fresh(self) -> State:
        """The first start, uncompiled."""
        with jax.disable_jit():
            return plain(self.game.reset(self.keys[0]))

    @cached_property
    def alone(self) -> list[dict[str, Any]]:
        """The first moment, the last and the first again, each by itself and uncompiled."""
        with jax.disable_jit():
            return [
                plain(see(self.game, *rows((self.states, self.actions), r))) for r in ENDS + [0]
            ]

    @cached_property
    def together(self) -> dict[str, Any]:
        """The first moment and the last, vmapped and uncompiled."""
        with jax.disable_jit():
            look = jax.vmap(lambda s, a: see(self.game, s, a))
            return plain(look(*rows((self.states, self.actions), ENDS)))


def plain(tree: Any) -> Any:
    """The same tree in NumPy."""
    return jax.tree.map(np.asarray, tree)


def nudged(states: State, agent: Any, by: float, coordinate: Any = slice(None), what: str = "x"):
    """`by` added to some coordinates of one agent, the same or another one in every row."""
    value = np.array(getattr(states, what))
    value[np.arange(len(value)), agent, coordinate] += by
    return eqx.tree_at(lambda s: getattr(s, what), states, value)


def rows(batch: Any, which: int | list[int]) -> Any:
    """One row of a batch, or several in this order."""
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[which]), batch)


def influence(probe: Probe, row: int, by: float, what: str = "x") -> dict[int, Any]:
    """Whose observation changes when one agent is moved, from the state `row`.

    For every agent j that was moved without a change of links: for each agent i whether row i of
    the observations changed, to the last bit.
    """
    game, found = probe.game, {}
    base, actions = rows(probe.states, [row] * ROWS), rows(probe.actions, [row] * ROWS)
    before = probe.look(base, actions)
    moved = np.unique(np.linspace(0, game.agents - 1, min(game.agents, SOME)).astype(int))
    agents = np.resize(moved, ROWS)
    after = probe.look(nudged(base, agents, by, what=what), actions)
    for k, j in enumerate(moved):
        if np.array_equal(before["linked"][k], after["linked"][k]):
            found[int(j)] = np.any(before["obs"][k] != after["obs"][k], axis=1)
    return found


def different(a: dict[str, Any], b: dict[str, Any], exact: bool = False) -> list[str]:
    """The methods that say different things, in the order of `see`."""
    close = lambda x, y: np.allclose(x, y, 1e-4 * (not exact), 1e-5 * (not exact), equal_nan=True)
    leaves = lambda value: [np.asarray(leaf) for leaf in jax.tree.leaves(value)]
    same = lambda x, y: all(map(close, leaves(x), leaves(y)))
    return [METHODS.get(name, name) for name in a if not same(a[name], b[name])]


# --- The laws ------------------------------------------------------------------------------------


def shapes(game: AbstractGame) -> Faults:
    """Shapes and types are those of the game's spaces."""
    n, d = game.agents, game.dynamics
    try:
        state = eqx.filter_eval_shape(game.reset, jax.random.key(0))
    except Exception as error:
        yield _raised("reset", error)
        return
    if not isinstance(state, State):
        kind = type(state).__name__
        yield f"reset: it returns a {kind}; return State(x=..., goal=..., t=jnp.asarray(0))."
        return
    wrong = [
        *_unlike("reset: x", state.x, (n, d.dx), "floating"),
        *_unlike("reset: goal", state.goal, (n, 2), "floating"),
        *_unlike("reset: t", state.t, (), "integer"),
    ]
    yield from wrong
    if wrong:
        return
    action = jax.ShapeDtypeStruct((n, d.du), jnp.float32)
    links = jax.ShapeDtypeStruct((n, n), jnp.bool_)
    for name, arguments, shape, kind in (
        ("linked", (state,), (n, n), "bool"),
        ("observe", (state, links), (n, None), "floating"),
        ("errors", (state,), (n, None), "floating"),
        ("features", (state,), (n, None), "floating"),
        ("distance", (state,), (n,), "floating"),
        ("costs", (state, action), (n,), "floating"),
        ("cost", (state, action), (), "floating"),
        ("rewards", (state, action), (n,), "floating"),
        ("terminated", (state,), (), "bool"),
        ("success", (state,), (), "bool"),
        ("violations", (state,), (n,), "bool"),
    ):
        try:
            yield from _unlike(
                name, eqx.filter_eval_shape(getattr(game, name), *arguments), shape, kind
            )
        except Exception as error:
            yield _raised(name, error)
    try:
        after = eqx.filter_eval_shape(game.step, state, action)
    except Exception as error:
        yield _raised("step", error)
        return
    if jax.tree.structure(after) != jax.tree.structure(state):
        yield "step: it returns another kind of state than reset; keep the parts that reset gives."
        return
    paths = jax.tree_util.tree_leaves_with_path(state)
    for (path, old), new in zip(paths, jax.tree.leaves(after), strict=True):
        if (old.shape, old.dtype) != (new.shape, new.dtype):
            name = jax.tree_util.keystr(path).lstrip(".")
            yield f"step: {name} becomes {_text(new)} from {_text(old)}; keep shape and type."


def _unlike(name: str, found: Any, shape: tuple[int | None, ...], kind: str) -> Faults:
    wanted = f"{kind}[{', '.join('any' if s is None else str(s) for s in shape)}]"
    if not hasattr(found, "shape"):
        yield f"{name}: it is a {type(found).__name__}; return an array {wanted}."
        return
    fits = len(found.shape) == len(shape) and all(
        size >= 1 if want is None else size == want
        for size, want in zip(found.shape, shape, strict=True)
    )
    if not fits or jnp.issubdtype(found.dtype, jnp.bool_) != (kind == "bool"):
        yield f"{name}: it is {_text(found)}; return {wanted}."
    elif kind == "floating" and found.dtype != jnp.float32:
        yield f"{name}: it is {_text(found)}; return float32, the precision of all else."
    elif kind == "integer" and not jnp.issubdtype(found.dtype, jnp.integer):
        yield f"{name}: it is {_text(found)}; return {wanted}."


def _text(x: Any) -> str:
    return f"{np.dtype(x.dtype)}[{', '.join(map(str, x.shape))}]"


def finite(probe: Probe) -> Faults:
    """Every number is finite, in every state that was met."""
    for name, value in probe.seen.items():
        for leaf in jax.tree.leaves(value):
            bad = ~np.isfinite(leaf).reshape(ROWS, -1).all(axis=1)
            if bad.any():
                t = int(probe.states.t[np.argmax(bad)])
                yield (
                    f"{METHODS.get(name, name)}: a number is not finite in {bad.sum()} of {ROWS} "
                    f"states, first at step {t}; guard its divisions, roots and logarithms."
                )
                break


def deterministic(probe: Probe) -> Faults:
    """The same key gives the same episode, to its last step and bit."""
    again = plain(_play(probe.game, probe.keys))
    pairs = zip(jax.tree.leaves(probe.played), jax.tree.leaves(again), strict=True)
    if not all(np.array_equal(a, b, equal_nan=True) for a, b in pairs):
        yield "step: the same key gave two different episodes; take all chance from the key."
    if different({"reset": probe.fresh()}, {"reset": probe.fresh()}, exact=True):
        yield "reset: the same key gave two different starts; take all chance from the key."
    for name in different(probe.alone[0], probe.alone[-1], exact=True):
        yield f"{name}: it said two things of one state; use no chance but the key of reset."


def compiled(probe: Probe) -> Faults:
    """Compiled, it says what it says line by line."""
    fast, slow = probe.seen, probe.together
    for name in different(jax.tree.map(lambda leaf: leaf[[0, -1]], fast), slow):
        yield f"{name}: compiled and uncompiled it differs; do not ask what is being traced."


def batched(probe: Probe) -> Faults:
    """Many at once, it says what it says one by one."""
    loop = jax.tree.map(lambda *leaves: np.stack(leaves), *probe.alone[:2])
    for name in different(loop, probe.together):
        yield f"{name}: under jax.vmap it differs; write it for one state, without own rules."


def traced_once(probe: Probe) -> Faults:
    """An equal task, built anew, is not compiled again."""
    game = probe.game
    try:
        twin = dataclasses.replace(game, dynamics=dataclasses.replace(game.dynamics))
    except Exception as error:
        yield f"fields: they do not make it anew ({error}); let them be what its constructor takes."
        return
    before = probe.traces
    probe.look(probe.states, -probe.actions, game=twin)
    if probe.traces > before:
        yield "fields: an equal task is compiled again; keep functions and objects out of them."


def resets(probe: Probe) -> Faults:
    """Episodes start at step 0, differ, and owe nothing to those before."""
    x = np.concatenate([probe.starts.x, probe.starts.goal], axis=2).reshape(EPISODES, -1)
    if len(np.unique(x, axis=0)) < EPISODES:
        yield "reset: different keys gave the same start; draw it from the key."
    if np.any(probe.starts.t):
        yield f"reset: an episode starts at t = {int(probe.starts.t.max())}; let t be 0."
    before = probe.fresh()
    with jax.disable_jit():
        probe.game.step(*rows((probe.states, probe.actions), 0))
    if different({"reset": before}, {"reset": probe.fresh()}, exact=True):
        yield "reset: it depends on steps taken before; keep no state outside State."


def clock(probe: Probe) -> Faults:
    """A step counts one and leaves the goal where it is."""
    if np.any(probe.seen["next"].t != probe.states.t + 1):
        yield "step: t does not grow by 1; return t=state.t + 1."
    if not np.array_equal(probe.seen["next"].goal, probe.states.goal):
        yield "step: the goal moves within an episode; return goal=state.goal."


def local(probe: Probe) -> Faults:
    """Row i of the observations comes from agent i and its neighbours alone."""
    leads, everyone, told = probe.game.leads, np.arange(probe.game.agents), set()
    for row in ENDS:
        linked = probe.seen["linked"][row]
        for by in NUDGES:
            for j, changed in influence(probe, row, by).items():
                if np.any(changed & ~linked[:, j] & (everyone != j)):
                    told.add(f"agent {j}, which is not its neighbour")
            for j, changed in influence(probe, row, by, what="goal").items():
                near = linked[:, j] | (everyone == j)
                if np.any(changed & ~(near & leads[j])):
                    told.add(f"the goal of agent {j}, which is not theirs to see")
    for what in sorted(told)[:1]:
        yield f"observe: a row changes with {what}; use local_view, slots and leads."


def bounded_inputs(probe: Probe) -> Faults:
    """Actions beyond [-1, 1] do what those at its ends do."""
    far = 4.0 * probe.actions
    wide, held = (probe.look(probe.states, a)["next"] for a in (far, np.clip(far, -1.0, 1.0)))
    if different({"step": wide}, {"step": held}):
        yield "step: an action of 4 does more than one of 1; clip actions to [-1, 1]."


def target(probe: Probe) -> Faults:
    """The target set is where the errors are zero, a success, and left by no agent at rest."""
    there = probe.target()
    out = probe.look(there, 0 * probe.actions)
    small = 1e-5 * (1 + np.abs(probe.states.x).max())
    if not np.all(out["success"]):
        yield "success: it is false with every agent on its goal; let it hold there."
    if np.all(probe.seen["success"]):
        yield "success: it holds in every state that was met; ask for all agents near their goals."
    if np.abs(out["errors"]).max() > small:
        yield "errors: they are not 0 with every agent at rest on its goal; measure from the goal."
    moved = np.abs(out["next"].x - there.x).max()
    if moved > small:
        yield f"step: without an action agents at rest move by {moved:.2g}; let them stay."
    agents = np.resize(np.arange(probe.game.agents), ROWS)
    for coordinate in (0, 1):
        off = nudged(there, agents, 1e-2, coordinate)
        seen = probe.look(off, 0 * probe.actions)
        away = np.abs(seen["distance"] - out["distance"])[np.arange(ROWS), agents] > 1e-3
        if np.any(away & ~np.any(np.abs(seen["errors"]) > small, axis=(1, 2))):
            yield "errors: they are 0 beside the goal too; let them be 0 on the target set alone."
            break


def costs(probe: Probe) -> Faults:
    """Costs are at least 0, 0 on the target set, and the team's is their mean (Assumption 1)."""
    cost = probe.seen["costs"]
    there = probe.look(probe.target(), 0 * probe.actions)["costs"]
    probe.figures |= {"largest": float(cost.max()), "on target": float(np.abs(there).max())}
    if cost.min() < 0 or there.min() < 0:
        yield f"costs: one is {min(cost.min(), there.min()):.3g}; let none be negative."
    if np.abs(there).max() > 1e-5 * max(1.0, float(np.median(cost))):
        yield f"costs: they are {np.abs(there).max():.3g} on the target set; let them be 0 there."
    if not np.any(cost):
        yield "costs: they are 0 wherever the agents went; let them grow with the distance."
    if not np.allclose(probe.seen["cost"], cost.mean(axis=1), 1e-4, 1e-5):
        yield "cost: it is not the mean of costs; replace costs, and leave cost as it is."


def rewards(probe: Probe) -> Faults:
    """The reward says what the cost says: it falls where the cost rises."""
    reward, cost = (probe.seen[k].mean(axis=1).astype(float) for k in ("rewards", "costs"))
    if np.ptp(reward) == 0:
        yield "rewards: they are the same in every state that was met; let them fall with the cost."
        return
    together = float(np.corrcoef(reward, cost)[0, 1]) if np.ptp(cost) else 0.0
    probe.figures["correlation"] = together
    if together > 0.5:
        yield "rewards: they rise with the cost; return its negative."


def smooth_cost(probe: Probe) -> Faults:
    """The cost is Lipschitz in states and actions (Assumption 1)."""
    first, last = _steepest(probe, lambda out: out["cost"][:, None])
    probe.figures["slope"] = last
    if not last <= STEEPER * max(first, 1e-3):
        yield (
            f"costs: between ever closer states the slope grows from {first:.2g} to {last:.2g}, as "
            "at a jump or a root; make them Lipschitz (Assumption 1)."
        )


def smooth_step(probe: Probe) -> Faults:
    """The dynamics are Lipschitz in states and actions (Assumption 2)."""
    first, last = _steepest(probe, lambda out: out["next"].x.reshape(ROWS, -1))
    probe.figures["slope"] = last
    if not last <= STEEPER * max(first, 1e-3):
        yield (
            f"step: between ever closer states the slope grows from {first:.2g} to {last:.2g}, as "
            "at a jump; make it Lipschitz (Assumption 2) and leave angles unwrapped."
        )


def _steepest(probe: Probe, f: Callable[[dict[str, Any]], Any]) -> tuple[float, float]:
    """The largest slope of f between far pairs, and after closing in on the steeper half of each.

    A half is at least as steep as the whole, so that the second is the larger; of a Lipschitz
    function both are at most its constant, and at a jump each halving doubles the slope. Half of
    the pairs are states of different episodes, the others end on the target set.
    """
    scene = lambda x: eqx.tree_at(lambda s: s.x, probe.states, x)
    half = np.arange(ROWS) < ROWS // 2
    pick = lambda a, b: np.where(half[:, None, None], a, b)
    low = (probe.states.x, probe.actions)
    other = np.roll(np.arange(ROWS), ROWS // 2 - 1)
    high = (
        pick(probe.states.x[other], probe.target().x),
        pick(probe.actions[other], 0 * probe.actions),
    )
    value = lambda end: f(probe.look(scene(end[0]), end[1])).astype(float)
    size = lambda a: np.sqrt(np.sum(np.square(a.reshape(ROWS, -1).astype(float)), axis=1))
    apart = lambda a, b: np.hypot(size(a[0] - b[0]), size(a[1] - b[1]))
    f_low, f_high, slopes = value(low), value(high), []
    for _ in range(HALVINGS + 1):
        gap = apart(low, high)
        slope = np.where(gap > 1e-6, size(f_high - f_low) / np.maximum(gap, 1e-6), 0.0)
        slopes.append(float(slope.max()))
        middle = tuple((a + b) / 2 for a, b in zip(low, high, strict=True))
        f_middle = value(middle)
        left = size(f_middle - f_low) > size(f_high - f_middle)
        keep = lambda a, b, left=left: np.where(left.reshape(-1, *[1] * (a.ndim - 1)), a, b)
        low = tuple(keep(a, m) for a, m in zip(low, middle, strict=True))
        high = tuple(keep(m, b) for m, b in zip(middle, high, strict=True))
        f_low, f_high = keep(f_low, f_middle), keep(f_middle, f_high)
    return slopes[0], slopes[-1]


def time_limit(probe: Probe) -> Faults:
    """The time limit only truncates: it ends no game, and the world goes on after it."""
    if np.all(probe.played.terminated[:, 0]):
        yield "terminated: every game is over after one step; let it be true where the game ends."
    late = eqx.tree_at(lambda s: s.t, probe.states, probe.states.t + probe.game.horizon)
    out = probe.look(late, probe.actions)
    if not np.array_equal(out["terminated"], probe.seen["terminated"]):
        yield (
            "terminated: it is true because the time is over; leave time out of it, for horizon "
            "truncates by itself."
        )
    moves = lambda after, before: np.any(after.x != before.x, axis=(1, 2))
    if np.any(moves(probe.seen["next"], probe.states) & ~moves(out["next"], late)):
        yield "step: nothing moves after the horizon; let the world go on."


LAWS: tuple[Callable[[Probe], Faults], ...] = (
    finite,
    deterministic,
    compiled,
    batched,
    traced_once,
    resets,
    clock,
    local,
    bounded_inputs,
    target,
    costs,
    rewards,
    smooth_cost,
    smooth_step,
    time_limit,
)
