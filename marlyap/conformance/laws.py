"""Does a task keep the laws that training, evaluation and the certificates rely on?

`conformance` plays a few episodes with random actions, perturbs the states that occurred, and tests
every law of `LAWS` on them. PettingZoo's checks, by comparison, look at one step and accept NaN.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from marlyap.controllers import UniformlyRandom
from marlyap.errors import UserError, first_line, raised_at
from marlyap.games.game import AbstractGame, AbstractRegulation
from marlyap.simulation.rollout import rollout
from marlyap.types import Action, Key, Keys, State, Trajectory, by_agent


EPISODES, ROWS = 32, 64  # episodes played, and states examined in one call
ENDS = [0, ROWS - 1]
SOME = 16  # agents that are moved one by one, when there are more
NUDGES = (1e-3, 0.3)  # by which they are moved, in the units of their states
HALVINGS, LAST = 12, 3  # of the gap between two states, and those over which slopes are compared
STEEPER = 1.5  # a slope that still grows this much in the last halvings has no bound
LOOKAHEAD = 20  # steps that an early ending is held against: 1 / (1 - gamma) for gamma = 0.95

Faults = Iterator[str]  # one sentence each: the method, what is wrong, the remedy


class Finding(NamedTuple):
    """The result for one law."""

    law: str
    says: str
    faults: tuple[str, ...] | None  # None: it could not be tested
    figures: dict[str, float]
    waived: str = ""  # why the law is not asked of this game, which is then not said to keep it


class Waived(Exception):
    """A law is not asked of a game, for the reason given."""


def conformance(
    game: AbstractGame, seed: int = 0, laws: "Sequence[Callable[[Probe], Faults]] | None" = None
) -> list[Finding]:
    """Test a game against `laws` (default: all of `LAWS`), after `shapes`.

    Returns one finding for each law, `shapes` first. An exception that the task raises is a fault
    too; where shapes are wrong, no other law is tested.
    """
    laws = LAWS if laws is None else laws
    faults = tuple(_caught(lambda: shapes(game)))
    try:
        probe = None if faults else Probe(game, seed)
    except Exception as error:
        probe, faults = None, (_raised("task", error),)
    found = [Finding("shapes", _says(shapes), faults, {})]
    for law in laws:
        faults, figures, waived = None, {}, ""
        if probe:
            probe.figures = figures
            try:
                faults = tuple(_caught(lambda law=law: law(probe)))
            except Waived as why:
                faults, waived = (), str(why)
        found.append(Finding(law.__name__, _says(law), faults, figures, waived))
    return found


def _says(law: Callable) -> str:
    return (law.__doc__ or "").splitlines()[0].rstrip(".")


def _caught(law: Callable[[], Faults]) -> Faults:
    try:
        yield from law()
    except Waived:
        raise
    except Exception as error:
        yield _raised("task", error)


def _raised(method: str, error: Exception) -> str:
    if isinstance(error, UserError):
        return f"{method}: {error}"
    remedy = _remedy(error)
    place = f" at {place}" if (place := raised_at(error)) else ""
    return f"{method}: it raised {first_line(error)}{place}; {remedy}."


def _remedy(error: Exception) -> str:
    """What the mistake usually is behind an error of this kind."""
    said = str(error)
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return "use jnp (jax.numpy) instead of NumPy"
    if isinstance(error, (jax.errors.JAXTypeError, jax.errors.JAXIndexError)):
        return "use jnp.where, not if or float()"
    if isinstance(error, TypeError) and ("State.__init__()" in said or "'scenario'" in said):
        return "return State(x=..., scenario=..., t=jnp.asarray(0)), goals in the scenario"
    if isinstance(error, TypeError) and "argument" in said:
        return "keep the arguments of the base class"
    return "make it return for every state"


# --- What is examined -----------------------------------------------------------------------------


METHODS = {
    "obs": "observe",
    "unlinked": "observe",
    "fails": "failed",
    "next": "step",
}  # others: as their key


def see(game: AbstractGame, state: State, action: Action) -> dict[str, Any]:
    """Everything a game says of one state and action.

    `unlinked` is `observe` without links, `fails` whether the step ends in a failure.
    """
    after = game.step(state, action)
    return {
        "obs": game.observations(state),
        "unlinked": game.observe(state, jnp.zeros((game.agents, game.agents), bool)),
        "features": game.features(state),
        "errors": game.errors(state),
        "costs": game.costs(state, action),
        "cost": game.cost(state, action),
        "rewards": game.rewards(state, action),
        "distance": game.distance(state),
        "success": game.success(state),
        "violations": game.violations(state),
        "failed": game.failed(state),
        "hold": game.hold(state),
        "terminated": game.terminated(state),
        "linked": game.linked(state),
        "fails": game.failed(after),
        "next": after,
    }


@eqx.filter_jit
def _play(game: AbstractGame, keys: Keys) -> Trajectory:
    """Whole episodes under uniformly random actions."""

    def one(key: Key) -> Trajectory:
        k_start, k_act = jax.random.split(key)
        return rollout(game, UniformlyRandom(game), game.reset(k_start), k_act)

    return jax.vmap(one)(keys)


@eqx.filter_jit
def _rest(game: AbstractRegulation, states: State) -> State:
    return jax.vmap(game.at_target)(states)


class Probe:
    """What a game said: `states` and `actions` of ROWS moments, and `seen`, what it says of them.

    `played` are whole episodes, `starts` their first states. States are kept in NumPy, random keys
    in them as keys, so that they can be given to the game again.
    """

    def __init__(self, game: AbstractGame, seed: int = 0):
        self.game, self.traces, self.figures = game, 0, {}
        self.keys = jax.random.split(jax.random.key(seed), EPISODES)
        self.played = kept(_play(game, self.keys))
        ended = self.played.terminated | self.played.failed
        over = np.concatenate([np.zeros((EPISODES, 1), bool), ended], 1)
        self.running = ~over[:, :-1]  # the episodes that had not ended before a step
        episode, time = np.nonzero(self.running)
        pick = np.linspace(0, len(time) - 1, ROWS).astype(int)
        at = lambda leaf: leaf[episode[pick], time[pick]]
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
        return as_numpy(self._look(game or self.game, *arrays))

    def on_target(self, states: State | None = None) -> State:
        """The same episodes on the target set, of a game that has one."""
        assert isinstance(self.game, AbstractRegulation)
        arrays = jax.tree.map(jnp.asarray, states or self.states)
        return kept(_rest(self.game, arrays))

    def fresh(self) -> State:
        """The first start, uncompiled."""
        with jax.disable_jit():
            return as_numpy(self.game.reset(self.keys[0]))

    @cached_property
    def alone(self) -> list[dict[str, Any]]:
        """The first moment, the last and the first again, each by itself and uncompiled."""
        with jax.disable_jit():
            return [
                as_numpy(see(self.game, *rows((self.states, self.actions), r))) for r in ENDS + [0]
            ]

    @cached_property
    def together(self) -> dict[str, Any]:
        """The first moment and the last, vmapped and uncompiled."""
        with jax.disable_jit():
            look = jax.vmap(lambda s, a: see(self.game, s, a))
            return as_numpy(look(*rows((self.states, self.actions), ENDS)))


def is_key(leaf: Any) -> bool:
    """Whether it is an array of typed random keys, which NumPy cannot hold."""
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def kept(tree: Any) -> Any:
    """The same tree in NumPy, random keys left as they are."""
    return jax.tree.map(lambda leaf: leaf if is_key(leaf) else np.asarray(leaf), tree)


def as_numpy(tree: Any) -> Any:
    """The same tree in NumPy, random keys as their bits."""
    bits = lambda leaf: jax.random.key_data(leaf) if is_key(leaf) else leaf
    return jax.tree.map(lambda leaf: np.asarray(bits(leaf)), tree)


def nudged(
    game: AbstractGame,
    states: State,
    agent: Any,
    by: float,
    coordinate: Any = slice(None),
    what: str = "x",
) -> State:
    """`by` added to some numbers of one agent, the same or another one in every row.

    `what` is the part of the state whose numbers about agents change: x or scenario.
    """
    part = getattr(states, what)
    if not jax.tree.leaves(_numbers(part)):  # a scenario without a number
        return states
    values = np.array(jax.vmap(lambda tree: by_agent(tree, game.agents)[0])(_numbers(part)))
    values[np.arange(len(values)), agent, coordinate] += by
    put = lambda tree, row: by_agent(tree, game.agents)[1](row)
    new = eqx.combine(jax.vmap(put)(_numbers(part), jnp.asarray(values)), part)
    return eqx.tree_at(lambda s: getattr(s, what), states, kept(new), is_leaf=_is_none)


def _numbers(tree: Any) -> Any:
    """The floats of a tree as JAX arrays, and None for the rest."""
    return jax.tree.map(jnp.asarray, eqx.filter(tree, _is_float))


def _is_none(leaf: Any) -> bool:
    return leaf is None


def _is_float(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and not is_key(leaf) and jnp.issubdtype(leaf.dtype, jnp.inexact)


def flat(tree: Any) -> np.ndarray:
    """All numbers of each row of a batch, whole ones and keys too [row, number]."""
    leaves = [leaf.reshape(len(leaf), -1) for leaf in jax.tree.leaves(as_numpy(tree))]
    return np.concatenate(leaves, axis=1) if leaves else np.zeros((ROWS, 0))


def rows(batch: Any, which: int | list[int]) -> Any:
    """One row of a batch, or several in this order."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[np.asarray(which)]), batch)


def influence(
    probe: Probe, row: int, by: float, what: str = "x", view: str = "obs"
) -> dict[int, Any]:
    """Whose observation changes when one agent is moved, from the state `row`.

    For every agent j that was moved without a change of links: for each agent i whether row i of
    the observations changed, to the last bit. With `view` "unlinked", of those without links.
    """
    game, found = probe.game, {}
    base, actions = rows(probe.states, [row] * ROWS), rows(probe.actions, [row] * ROWS)
    before = probe.look(base, actions)
    moved = np.unique(np.linspace(0, game.agents - 1, min(game.agents, SOME)).astype(int))
    agents = np.resize(moved, ROWS)
    after = probe.look(nudged(game, base, agents, by, what=what), actions)
    for k, j in enumerate(moved):
        if np.array_equal(before["linked"][k], after["linked"][k]):
            found[int(j)] = np.any(before[view][k] != after[view][k], axis=1)
    return found


def different(a: dict[str, Any], b: dict[str, Any], exact: bool = False) -> list[str]:
    """The methods that say different things, in the order of `see`."""
    close = lambda x, y: np.allclose(x, y, 1e-4 * (not exact), 1e-5 * (not exact), equal_nan=True)
    leaves = lambda value: [np.asarray(leaf) for leaf in jax.tree.leaves(value)]
    same = lambda x, y: all(map(close, leaves(x), leaves(y)))
    names = [METHODS.get(name, name) for name in a if not same(a[name], b[name])]
    return list(dict.fromkeys(names))


# --- The laws ------------------------------------------------------------------------------------


def shapes(game: AbstractGame) -> Faults:
    """Fields have types, and arrays the shapes and types of the game's spaces."""
    n = game.agents
    yield from _untyped(type(game))
    yield from _untyped(game.plant.moves)
    try:
        state = eqx.filter_eval_shape(game.reset, jax.random.key(0))
    except Exception as error:
        yield _raised("reset", error)
        return
    if not isinstance(state, State):
        kind = "plain array" if hasattr(state, "dtype") else type(state).__name__
        yield f"reset: it returns a {kind}; return State(x=..., scenario=..., t=jnp.asarray(0))."
        return
    wrong = list(_caught(lambda: _wrong_state(game, state)))
    yield from wrong
    if wrong:
        return
    action = jax.ShapeDtypeStruct((n, game.du), jnp.float32)
    errors = None if isinstance(game, AbstractRegulation) else 0
    links = jax.ShapeDtypeStruct((n, n), jnp.bool_)
    for name, arguments, shape, kind in (
        ("linked", (state,), (n, n), "bool"),
        ("observe", (state, links), (n, None), "floating"),
        ("errors", (state,), (n, errors), "floating"),
        ("features", (state,), (n, None), "floating"),
        ("distance", (state,), (n,), "floating"),
        ("costs", (state, action), (n,), "floating"),
        ("cost", (state, action), (), "floating"),
        ("rewards", (state, action), (n,), "floating"),
        ("terminated", (state,), (), "bool"),
        ("failed", (state,), (), "bool"),
        ("hold", (state,), (n, game.du), "floating"),
        ("success", (state,), (), "bool"),
        ("violations", (state,), (n,), "bool"),
    ):
        try:
            yield from _unlike(
                name, eqx.filter_eval_shape(getattr(game, name), *arguments), shape, kind
            )
        except Exception as error:
            yield _raised(name, error)
    if fault := _field(game, state, action):
        yield fault
        return
    try:
        after = eqx.filter_eval_shape(game.step, state, action)
    except Exception as error:
        yield _raised("step", error)
        return
    if jax.tree.structure(after) != jax.tree.structure(state):
        yield "step: its state has other parts than that of reset; return the same parts."
        return
    paths = jax.tree_util.tree_leaves_with_path(state)
    for (path, old), new in zip(paths, jax.tree.leaves(after), strict=True):
        if (old.shape, old.dtype) != (new.shape, new.dtype):
            name = jax.tree_util.keystr(path).lstrip(".")
            yield f"step: {name} becomes {_text(new)} from {_text(old)}; keep shape and type."


def _field(game: AbstractGame, state: State, action: Any) -> str | None:
    """A fault where the plant's rates have another shape than its states."""
    inputs = eqx.filter_eval_shape(game.plant.inputs_of, action)
    time = jax.ShapeDtypeStruct((), jnp.float32)
    try:
        rates = eqx.filter_eval_shape(game.plant.field, state.x, inputs, state.scenario, time)
    except Exception as error:
        return _raised("field", error)
    old, new = (jax.tree.map(lambda leaf: leaf.shape, tree) for tree in (state.x, rates))
    if old != new:
        return f"field: it returns {_all(rates)}; return the shape of x, {_all(state.x)}."
    return None


def _all(tree: Any) -> str:
    return ", ".join(map(_text, jax.tree.leaves(tree)))


def _wrong_state(game: AbstractGame, state: State) -> Faults:
    """Parts of a start that have another shape or type than the game says."""
    wanted = {}

    def arrays(state: State) -> dict[str, Any]:
        parts = game.state_shapes(state)
        wanted.update({name: shape for name, (_, shape) in parts.items()})
        return {name: array for name, (array, _) in parts.items()}

    shapes = eqx.filter_eval_shape(arrays, state)
    for name, found in shapes.items():
        yield from _unlike(
            f"reset: {name}", found, wanted[name], "integer" if name == "t" else "floating"
        )
    for path, leaf in jax.tree_util.tree_leaves_with_path((state.x, state.scenario)):
        if jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.dtype != jnp.float32:
            name = jax.tree_util.keystr(path)
            yield f"reset: {name} is {_text(leaf)}; return float32, the precision of all else."


def _untyped(thing: type) -> Faults:
    """Values in the body of a user's class that are no fields, for want of an annotation."""
    notes = lambda cls: vars(cls).get("__annotations__", {})
    classes = thing.__mro__
    shared = {k for c in classes for k, kind in notes(c).items() if "ClassVar" in str(kind)}
    for cls in classes:
        if cls.__module__.startswith("marlyap."):
            continue
        for name, value in vars(cls).items():
            method = callable(value) or hasattr(value, "__get__")
            if name.startswith("_") or method or name in shared or name in notes(cls):
                continue
            text = repr(value) if len(repr(value)) <= 40 else "..."
            kind = type(value).__name__
            if isinstance(value, tuple):
                kind = f"tuple[{type(value[0]).__name__ if value else 'int'}, ...]"
            yield (
                f"fields: {name} = {text} needs a type, as in {name}: {kind} = {text}; without one "
                "it is not a field of the task."
            )


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
    return f"{x.dtype}[{', '.join(map(str, x.shape))}]"


def finite(probe: Probe) -> Faults:
    """Every number is finite in every state that occurred."""
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
    """The same key gives the same episode, bit for bit."""
    again = as_numpy(_play(probe.game, probe.keys))
    pairs = zip(jax.tree.leaves(as_numpy(probe.played)), jax.tree.leaves(again), strict=True)
    if not all(np.array_equal(a, b, equal_nan=True) for a, b in pairs):
        yield "step: the same key gave two different episodes; draw everything from the key."
    if different({"reset": probe.fresh()}, {"reset": probe.fresh()}, exact=True):
        yield "reset: the same key gave two different starts; draw everything from the key."
    for name in different(probe.alone[0], probe.alone[-1], exact=True):
        yield f"{name}: two calls with one state differ; take random keys from the state."


def compiled(probe: Probe) -> Faults:
    """jit agrees with eager execution."""
    fast, slow = probe.seen, probe.together
    for name in different(jax.tree.map(lambda leaf: leaf[[0, -1]], fast), slow):
        yield f"{name}: under jit it differs; make it independent of tracing."


def batched(probe: Probe) -> Faults:
    """vmap agrees with a loop."""
    loop = jax.tree.map(lambda *leaves: np.stack(leaves), *probe.alone[:2])
    for name in different(loop, probe.together):
        yield f"{name}: under vmap it differs; write it for one state, without batching rules."


def traced_once(probe: Probe) -> Faults:
    """An equal task, built anew, reuses the compiled code."""
    game = probe.game
    try:
        twin = _anew(game)
    except Exception as error:
        yield f"fields: the constructor does not take them ({error}); leave __init__ to the fields."
        return
    before = probe.traces
    probe.look(probe.states, -probe.actions, game=twin)
    if probe.traces > before:
        yield "fields: an equal task is compiled again; use numbers, text, tuples, modules."


def _anew(module: Any) -> Any:
    """An equal module, built from its fields, those that are modules too."""
    fields = {f.name: getattr(module, f.name) for f in dataclasses.fields(module) if f.init}
    modules = {k: _anew(v) for k, v in fields.items() if isinstance(v, eqx.Module)}
    return dataclasses.replace(module, **modules)


def resets(probe: Probe) -> Faults:
    """Episodes start at step 0, differ, and do not depend on earlier ones."""
    if len(np.unique(flat((probe.starts.x, probe.starts.scenario)), axis=0)) < EPISODES:
        yield "reset: different keys gave the same start; draw it from the key."
    if np.any(probe.starts.t):
        yield f"reset: an episode starts at t = {int(probe.starts.t.max())}; start at 0."
    before = probe.fresh()
    with jax.disable_jit():
        probe.game.step(*rows((probe.states, probe.actions), 0))
    if different({"reset": before}, {"reset": probe.fresh()}, exact=True):
        yield "reset: it depends on steps taken before; keep no state outside State."


def clock(probe: Probe) -> Faults:
    """A step adds 1 to t and leaves the scenario as it is."""
    if np.any(probe.seen["next"].t != probe.states.t + 1):
        yield "step: t does not grow by 1; return t=state.t + 1."
    if not np.array_equal(flat(probe.seen["next"].scenario), flat(probe.states.scenario)):
        yield (
            "step: the scenario changes within an episode; return scenario=state.scenario, let a "
            "reference follow from it and t, and put what else changes into x or memory."
        )


def local(probe: Probe) -> Faults:
    """Row i of the observations depends on agent i and its neighbours only."""
    leads, everyone, told = probe.game.leads, np.arange(probe.game.agents), set()
    for row in ENDS:
        linked = probe.seen["linked"][row]
        for by in NUDGES:
            for j, changed in influence(probe, row, by).items():
                if np.any(changed & ~linked[:, j] & (everyone != j)):
                    told.add(f"agent {j}, which is not its neighbour")
            for j, changed in influence(probe, row, by, what="scenario").items():
                near = linked[:, j] | (everyone == j)
                if np.any(changed & ~(near & leads[j])):
                    told.add(f"the goal (scenario) of agent {j}, which it must not know")
    for what in sorted(told)[:1]:
        yield f"observe: a row changes with {what}; use local_view, slots and leads."


def links(probe: Probe) -> Faults:
    """observe takes neighbours from its argument links."""
    everyone = np.arange(probe.game.agents)
    for by in NUDGES:
        for what in ("x", "scenario"):
            found = influence(probe, ENDS[0], by, what=what, view="unlinked").items()
            for j, changed in found:
                if np.any(changed & (everyone != j)):
                    yield (
                        f"observe: without links a row still changes with agent {j}; take "
                        "neighbours from the argument links, not from self.linked."
                    )
                    return


def bounded_inputs(probe: Probe) -> Faults:
    """Actions are clipped to [-1, 1]."""
    far = 4.0 * probe.actions
    wide, held = (probe.look(probe.states, a)["next"] for a in (far, np.clip(far, -1.0, 1.0)))
    if different({"step": wide}, {"step": held}):
        yield "step: an action of 4 does more than one of 1; clip actions to [-1, 1]."


def target(probe: Probe) -> Faults:
    """On the target set errors are zero and success holds; the holding action keeps it."""
    if not isinstance(probe.game, AbstractRegulation):
        return
    there = probe.on_target()
    out = probe.look(there, probe.look(there, 0 * probe.actions)["hold"])
    small = 1e-5 * (1 + np.abs(flat(_numbers(probe.states.x))).max())
    if not np.all(out["success"]):
        yield "success: it is false with every agent on its goal; return true there."
    if np.all(probe.seen["success"]):
        yield "success: it holds in every state that occurred; ask for all agents near their goals."
    if np.abs(out["errors"]).max() > small:
        yield "errors: they are not 0 with every agent at rest on its goal; measure from the goal."
    after = kept(jax.tree.map(jnp.asarray, out["next"]))
    moved = np.abs(probe.look(after, 0 * probe.actions)["errors"]).max()
    if moved > 10 * small:
        yield (
            f"step: from the target set, under the holding action, the errors become {moved:.2g} "
            "in a step; make agents at rest stay, or return in `hold` the action that keeps them."
        )
    agents = np.resize(np.arange(probe.game.agents), ROWS)
    edge = probe.game.edge
    for coordinate in range(_width(probe)):
        for by in (1e-2, 10.0):
            off = nudged(probe.game, there, agents, by, coordinate)
            seen = probe.look(off, 0 * probe.actions)
            away = np.abs(seen["distance"] - out["distance"])[np.arange(ROWS), agents] > 1e-2 * edge
            if np.any(away & ~np.any(np.abs(seen["errors"]) > small, axis=(1, 2))):
                yield "errors: they are 0 beside the goal too; make them 0 on the target set only."
                return


def _width(probe: Probe) -> int:
    """How many numbers of an agent are in x."""
    rows = by_agent(jax.tree.map(lambda x: x[0], _numbers(probe.states.x)), probe.game.agents)[0]
    return rows.shape[1]


def features(probe: Probe) -> Faults:
    """Features begin with the errors, agent by agent."""
    if not isinstance(probe.game, AbstractRegulation):
        return
    there = probe.look(probe.on_target(), 0 * probe.actions)
    for out in (probe.seen, there):
        errors, seen = out["errors"], out["features"]
        begin = seen[:, :, : errors.shape[2]]
        size = 1e-5 * (1 + np.abs(errors).max())
        if begin.shape != errors.shape or not np.allclose(begin, errors, 1e-4, size):
            yield (
                "features: they do not begin with the errors; return jnp.concatenate([self.errors("
                "state), ...], axis=1), since V is zero where the first features are."
            )
            return


def costs(probe: Probe) -> Faults:
    """Costs are at least 0, 0 on the target set, and the team's is their mean (Assumption 1)."""
    cost, there = probe.seen["costs"], np.zeros(1)
    if isinstance(probe.game, AbstractRegulation):
        goal = probe.on_target()
        there = probe.look(goal, probe.look(goal, 0 * probe.actions)["hold"])["costs"]
    probe.figures |= {"largest": float(cost.max()), "on target": float(np.abs(there).max())}
    if cost.min() < 0 or there.min() < 0:
        yield f"costs: one is {min(cost.min(), there.min()):.3g}; make every cost >= 0."
    if np.abs(there).max() > 1e-5 * max(1.0, float(np.median(cost))):
        yield f"costs: they are {np.abs(there).max():.3g} on the target set; make them 0 there."
    if not np.any(cost):
        yield "costs: they are 0 in every state that occurred; make them grow with the distance."
    if not np.allclose(probe.seen["cost"], cost.mean(axis=1), 1e-4, 1e-5):
        yield "cost: it is not the mean of costs; override costs, not cost."


def rewards(probe: Probe) -> Faults:
    """Rewards fall where costs rise."""
    reward, cost = (probe.seen[k].mean(axis=1).astype(float) for k in ("rewards", "costs"))
    if np.ptp(reward) == 0:
        yield "rewards: they are the same in all states that occurred; make them fall with costs."
        return
    together = float(np.corrcoef(reward, cost)[0, 1]) if np.ptp(cost) else 0.0
    probe.figures["correlation"] = together
    if together > 0.5:
        yield "rewards: they rise with the cost; return its negative."


def violations(probe: Probe) -> Faults:
    """No agent breaks the rules in every state."""
    broken = probe.seen["violations"]
    probe.figures["share of states"] = float(broken.any(axis=1).mean())
    for i in np.flatnonzero(broken.all(axis=0))[:1]:
        yield (
            f"violations: agent {i} breaks a rule in every state that occurred; return true only "
            "where a rule is broken."
        )


def smooth_cost(probe: Probe) -> Faults:
    """Costs are Lipschitz in states and actions (Assumption 1)."""
    if not probe.game.smooth:
        raise Waived("the game says that its costs jump (`smooth`)")
    before, last = _steepest(probe, lambda out: out["cost"][:, None])
    probe.figures["slope"] = last
    if not last <= STEEPER * max(before, 1e-3):
        yield (
            f"costs: between ever closer states the slope grows from {before:.2g} to {last:.2g}, "
            "as at a jump or a root; make them Lipschitz (Assumption 1)."
        )


def smooth_step(probe: Probe) -> Faults:
    """The dynamics are Lipschitz in states and actions (Assumption 2)."""
    before, last = _steepest(probe, lambda out: flat(_numbers(out["next"].x)))
    probe.figures["slope"] = last
    if not last <= STEEPER * max(before, 1e-3):
        yield (
            f"step: between ever closer states the slope grows from {before:.2g} to {last:.2g}, as "
            "at a jump; make it Lipschitz (Assumption 2) and leave angles unwrapped."
        )


def _steepest(probe: Probe, f: Callable[[dict[str, Any]], Any]) -> tuple[float, float]:
    """The largest slope of f between two states: LAST halvings of their gap ago, and at the end.

    Of each pair the line between is cut into four, and the steepest quarter with half a quarter on
    both sides is cut again, so slopes do not fall. Those of a Lipschitz function, however steep,
    level off at its constant: a penalty such as 10 max(0, 0.25 - gap) at 10. A jump doubles the
    slope in every halving, a square root multiplies it by sqrt 2, even a cusp: the margins keep it
    in sight. Half of the pairs are states of different episodes, the others end on the target set.
    """
    half, each = np.arange(ROWS) < ROWS // 2, np.arange(ROWS)
    other = np.roll(each, ROWS // 2 - 1)
    near = (flat(_numbers(probe.states.x)), probe.actions)
    far = (near[0][other], near[1][other])
    if isinstance(probe.game, AbstractRegulation):
        goal = probe.on_target()
        hold = probe.look(goal, 0 * probe.actions)["hold"]
        far = (
            np.where(half[:, None], far[0], flat(_numbers(goal.x))),
            np.where(half[:, None, None], far[1], hold),
        )
    back = _unflat(probe.states)
    size = lambda a: np.sqrt(np.sum(np.square(a.reshape(ROWS, -1).astype(float)), axis=1))

    def at(share: Any) -> tuple[Any, Any, Any, Any]:
        """State, action, f and failure at this share of the way from the near ends to the far."""
        weigh = lambda a: share.reshape(-1, *[1] * (a.ndim - 1)).astype(float)
        x, action = (
            (a + weigh(a) * (b - a)).astype(a.dtype) for a, b in zip(near, far, strict=True)
        )
        out = probe.look(back(x), action)
        return x, action, f(out).astype(float), out["failed"] | out["fails"]

    begin, quarter, slopes = np.zeros(ROWS), 0.25, []
    for _ in range(HALVINGS + 1):
        points = [at(begin + k * quarter) for k in range(5)]
        rises = []
        for (x, a, y, lost), (x_next, a_next, y_next, lost_next) in itertools.pairwise(points):
            gap = np.hypot(size(x_next - x), size(a_next - a))
            counts = (gap > 1e-6) & ~lost & ~lost_next
            rises.append(np.where(counts, size(y_next - y) / np.maximum(gap, 1e-6), 0.0))
        slopes.append(float(np.max(rises)))
        steepest = begin + np.argmax(rises, axis=0) * quarter
        begin = np.clip(steepest - quarter / 2, 0.0, 1 - 2 * quarter)
        quarter /= 2
    return slopes[-1 - LAST], slopes[-1]


def _unflat(states: State) -> Callable[[np.ndarray], State]:
    """The states with other floats in x, given flat [row, number]."""
    numbers = _numbers(states.x)
    leaves, structure = jax.tree.flatten(numbers)
    ends = np.cumsum([leaf[0].size for leaf in leaves])[:-1]

    def back(x: np.ndarray) -> State:
        parts = np.split(x, ends, axis=1)
        new = [p.reshape(leaf.shape) for p, leaf in zip(parts, leaves, strict=True)]
        x = eqx.combine(jax.tree.unflatten(structure, new), states.x)
        return eqx.tree_at(lambda s: s.x, states, x)

    return back


def time_limit(probe: Probe) -> Faults:
    """The time limit truncates; it neither terminates nor stops the dynamics."""
    if np.all(probe.played.terminated[:, 0]):
        yield "terminated: every episode ends after one step; return true only where the game ends."
    late = eqx.tree_at(lambda s: s.t, probe.states, probe.states.t + probe.game.horizon)
    out = probe.look(late, probe.actions)
    if not np.array_equal(out["terminated"], probe.seen["terminated"]):
        yield (
            "terminated: it depends on the time limit; leave time out of it, since the horizon "
            "truncates by itself."
        )
    moves = lambda after, before: np.any(flat(after.x) != flat(before.x), axis=1)
    if np.any(moves(probe.seen["next"], probe.states) & ~moves(out["next"], late)):
        yield "step: nothing moves after the horizon; keep the dynamics independent of time."


def termination(probe: Probe) -> Faults:
    """An episode that ends without success does not spare the team its remaining costs."""
    played, last = probe.played, probe.running & probe.played.terminated
    episode, time = np.nonzero(last)
    after = jax.tree.map(lambda leaf: leaf[episode, time + 1], played.state)
    if len(episode):
        which = np.resize(np.arange(len(episode)), ROWS).tolist()
        seen = probe.look(rows(after, which), probe.actions)
        failed = ~seen["success"][: len(episode)] & (time + 1 < probe.game.horizon)
        episode, time = episode[failed], time[failed]
    probe.figures["ended without success"] = float(len(episode))
    if not len(episode):
        return
    reward = played.reward.mean(axis=2)
    others = probe.running & ~last
    usual = float(reward[others if others.any() else last].mean())
    left = np.minimum(probe.game.horizon - 1 - time, LOOKAHEAD)
    ending, going_on = reward[episode, time].mean(), usual * (1 + left.mean())
    probe.figures |= {"reward at the end": float(ending), "reward of going on": float(going_on)}
    # Half of it is charge enough: a learnt policy has smaller costs ahead than random actions.
    if going_on < 0 and ending > going_on / 2:
        yield (
            f"terminated: an episode that ends without success at step {time.min() + 1} stops its "
            "costs, so that ending early pays; count such states in `violations`, or charge the "
            "remaining costs at once in `rewards`."
        )


def failure(probe: Probe) -> Faults:
    """A failure costs more than the steps before it, so that failing never pays.

    The last LOOKAHEAD steps together: on the way to a failure, and back from where it threatens, a
    cost may for an instant be larger than that of a failure, which lasts.
    """
    played, game = probe.played, probe.game
    episode, time = np.nonzero(probe.running & played.failed)
    probe.figures["failed episodes"] = float(len(episode))
    if len(episode):
        cost = played.cost.mean(axis=2)
        ways = zip(episode, time, strict=True)
        before = max(float(cost[e, max(0, t - LOOKAHEAD + 1) : t + 1].mean()) for e, t in ways)
        probe.figures |= {"cost before": before, "failure cost": float(game.failure_cost)}
        if not game.failure_cost >= before:
            yield (
                f"failure_cost: it is {game.failure_cost:g}, and the steps before a failure cost "
                f"{before:.3g}, so that failing pays; make it the larger of the two."
            )


def channels(probe: Probe) -> Faults:
    """The named channels of an observation, where a task tells them, add up to its size."""
    told, there = probe.game.channels(), probe.seen["obs"].shape[-1]
    size = sum(channel.size for channel in told)
    if told and size != there:
        yield (
            f"observation_entries: they name {size} numbers, and an observation has {there}; name "
            "each of them, in their order."
        )


LAWS: tuple[Callable[[Probe], Faults], ...] = (
    finite,
    deterministic,
    compiled,
    batched,
    traced_once,
    resets,
    clock,
    local,
    links,
    bounded_inputs,
    target,
    features,
    costs,
    rewards,
    violations,
    smooth_cost,
    smooth_step,
    time_limit,
    termination,
    failure,
    channels,
)
