"""The same game, disturbed: what a controller meets that it was not made for."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from marlyap import graph as graphs
from marlyap.errors import UserError
from marlyap.games.dynamics import AbstractDynamics
from marlyap.games.game import AbstractGame, AbstractRegulation
from marlyap.games.physics import AbstractPlant
from marlyap.games.wrapper import AbstractWrapper
from marlyap.seeds import branch
from marlyap.types import Action, State


class Perturbed(AbstractWrapper):
    """Another game with stronger or weaker inputs, noise, delays, lost messages, agents or edges.

    A controller made for `inner` drives it unchanged. Every method of `inner` is asked, with the
    state as `inner` knows it, so that whatever a task replaces is what is perturbed; perturbations
    may be nested. Agents that are gone are seen by nobody and judged by nobody.

    What is drawn at random (noise, lost messages) follows from a seed that `reset` leaves in the
    state's memory, beside the actions under way and the memory of `inner`.

    Raises UserError for values out of range, and for `gone` where `inner` has a judgement of its
    own about the whole team, which cannot leave an agent out.
    """

    inner: AbstractRegulation
    gain: float | Array = 1.0  # the inputs have this many times their nominal effect
    noise: float | Array = 0.0  # standard deviation of what is added to each action in [-1, 1]
    delay: int = 0  # steps until an action has its effect; until then there is none
    drop: float | Array = 0.0  # probability that in a step an agent does not see a neighbour
    gone: tuple[int, ...] = ()  # agents that are missing
    cut: tuple[tuple[int, int], ...] = ()  # edges that are missing
    spread: float | Array = 1.0  # starts lie this many times as far out
    push: float | Array = 0.0  # every so often all rates of an agent jump by + or - this (SI)
    jump: float | Array = 0.0  # every so often the target moves anywhere in [-jump, jump]^2 (m)
    every: int = 40  # steps from one push or jump to the next
    silent: float = 0.0  # probability that in an episode a follower stops and falls silent
    late: float = 0.0  # s up to which, drawn anew each episode, inputs act late; less than dt
    measured: float = 0.0  # standard deviation of what is measured of the states, in their units

    def __check_init__(self):
        if not 0 < self.gain < 100 or not 0 < self.spread < 100:
            raise UserError("perturbation: gain and spread must lie between 0 and 100.")
        if not 0 <= self.noise < 100 or not 0 <= self.drop <= 1 or not 0 <= self.delay <= 1000:
            raise UserError("perturbation: noise, delay and drop must not be negative, drop <= 1.")
        if not 0 <= self.push < 1e6 or not 0 <= self.jump < 1e6 or self.every < 1:
            raise UserError(
                "perturbation: push and jump must lie between 0 and 1e6, every be at least 1."
            )
        self._robots()
        missing = {*self.gone, *(i for edge in self.cut for i in edge)}
        if not missing <= set(range(self.inner.agents)):
            raise UserError(f"perturbation: {sorted(missing)} names an agent that is not there.")
        if self.gone and self.inner.plant.coupled:
            raise UserError(
                f"perturbation: an agent of {type(self.inner).__name__} cannot be taken away, "
                "since its plant couples the agents; leave out gone."
            )
        own = judges_as_a_team(self.inner)
        if self.gone and own:
            raise UserError(
                f"perturbation: an agent of {own[0]} cannot be taken away, since it replaces "
                f"`{own[1]}`, which judges the whole team; leave out gone."
            )

    def _robots(self) -> None:
        """Raise UserError unless the last three fields are in range and about robots."""
        if not 0 <= self.silent <= 1 or not 0 <= self.late < self.inner.dt or self.measured < 0:
            raise UserError(
                "perturbation: silent must lie between 0 and 1, late between 0 and dt, and "
                "measured must not be negative."
            )
        plain = type(self.inner).step is AbstractGame.step and self.inner.sight() is not None
        if (self.silent or self.late or self.measured) and not plain:
            raise UserError(
                f"perturbation: {type(self.inner).__name__} is no game of robots in the plane with "
                "the step of all games; leave out silent, late and measured."
            )
        if self.silent and self.inner.leads.all():
            raise UserError("perturbation: nobody but leaders is there; leave out silent.")

    # What the game inside says.
    agents = property(lambda self: self.inner.agents)  # pyright: ignore[reportAssignmentType]
    graph = property(lambda self: self.inner.graph)  # pyright: ignore[reportAssignmentType]
    dt = property(lambda self: self.inner.dt)  # pyright: ignore[reportAssignmentType]
    horizon = property(lambda self: self.inner.horizon)  # pyright: ignore[reportAssignmentType]

    @property
    def driven(self) -> AbstractGame:
        """The game inside, with inputs as strong as they are here."""
        return self.inner.strengthened(self.gain) if _on(self.gain - 1) else self.inner

    @property
    def plant(self) -> AbstractPlant:
        return self.driven.plant

    @property
    def dynamics(self) -> AbstractDynamics:
        """Of a planar game."""
        return self.driven.dynamics  # pyright: ignore

    @property
    def present(self) -> Bool[np.ndarray, "agent"]:
        return ~np.isin(np.arange(self.agents), self.gone)

    @property
    def adjacency(self) -> Bool[np.ndarray, "agent agent"]:
        """The edges that are left."""
        linked = self.inner.adjacency & self.present[:, None] & self.present[None, :]
        for a, b in self.cut:
            linked[a, b] = linked[b, a] = False
        return linked

    def reset(self, key):
        start = self.inner.reset(key)
        if _on(self.spread - 1):
            start = self.inner.farther(start, self.spread)
        seed = branch(key, "perturb")
        for _ in range(depth(self.inner)):  # nested perturbations draw other numbers
            seed = jax.random.fold_in(seed, 3)
        idle = self.driven.hold(start)
        queue = jnp.broadcast_to(idle, (self.delay, *idle.shape))
        memory = {"seed": jax.random.key_data(seed), "queue": queue, "inner": start.memory}
        memory |= {"last": idle} if self.late else {}
        return State(x=start.x, scenario=start.scenario, t=start.t, memory=memory)

    def linked(self, state):
        linked = self.inner.linked(self.inside(state)) & jnp.asarray(self.adjacency)
        if not _on(self.drop):
            return linked
        key = jax.random.fold_in(self._key(state, 1), state.t)
        return linked & ~jax.random.bernoulli(key, self.drop, linked.shape)

    def underway(self, state):
        return jnp.concatenate([super().underway(state), state.memory["queue"]])

    def observe(self, state, links):
        inside = self.inside(state)
        if self.measured:
            key = jax.random.fold_in(self._key(state, 4), state.t)
            x = inside.x + self.measured * jax.random.normal(key, inside.x.shape)
            inside = eqx.tree_at(lambda s: s.x, inside, x)
        return self.inner.observe(inside, links)

    def step(self, state, action):
        queue = jnp.concatenate([state.memory["queue"], action[None]])
        now, key = queue[0], jax.random.fold_in(self._key(state, 2), state.t)
        if _on(self.noise):
            now = now + self.noise * jax.random.normal(key, now.shape)
        before = self._struck(state)
        late = lambda: self._acting_late(state, before, now)
        after = late() if self.late else self.driven.step(before, now)
        memory = state.memory | {"queue": queue[1:], "inner": after.memory}
        memory |= {"last": now} if self.late else {}
        x = self._stopped(state, before.x, after.x) if self.silent else after.x
        return State(x=x, scenario=after.scenario, t=after.t, memory=memory)

    def _acting_late(self, state: State, before: State, action: Action) -> State:
        """The step from `before` in which the last action still acts at first."""
        plant = self.plant
        late = jax.random.uniform(self._key(state, 5), (), maxval=self.late)
        time, x = before.t * self.dt, before.x
        for asked, seconds in ((state.memory["last"], late), (action, self.dt - late)):
            x = plant.step(x, plant.inputs_of(asked), before.scenario, time, seconds)
        return State(x=x, scenario=before.scenario, t=before.t + 1, memory=before.memory)

    def _stopped(self, state: State, before: Array, after: Array) -> Array:
        """Whoever is silent stands where it was: what its neighbours take it for."""
        angle = before[:, 2] if "psi" in self.dynamics.names else jnp.zeros(self.agents)
        still = jax.vmap(self.dynamics.rest)(self.inner.positions(self.inside(state)), angle)
        return jnp.where(self.silenced(state)[:, None], still, after)

    def silenced(self, state: State) -> Bool[Array, "agent"]:
        """Who has stopped and fallen silent by now: at most one follower, from some step on."""
        k_whether, k_who, k_when = jax.random.split(self._key(state, 3), 3)
        followers = jnp.asarray(np.flatnonzero(~self.inner.leads))
        who = jax.random.choice(k_who, followers)
        when = jax.random.randint(k_when, (), 0, self.horizon)
        gone = jax.random.bernoulli(k_whether, self.silent) & (state.t >= when)
        return gone & (jnp.arange(self.agents) == who)

    def _struck(self, state: State) -> State:
        """The state inside, pushed or with another target where the time for it has come."""
        inside, due = self.inside(state), (state.t > 0) & (state.t % self.every == 0)
        for size, purpose in ((self.push, 6), (self.jump, 7)):
            if _on(size):
                strike = self.inner.pushed if purpose == 6 else self.inner.retargeted
                key = jax.random.fold_in(self._key(state, purpose), state.t)
                struck = strike(inside, size, key)
                inside = jax.tree.map(lambda a, b: jax.lax.select(due, a, b), struck, inside)
        return inside

    def outside(self, inside, state):
        memory = state.memory | {"inner": inside.memory}
        return State(x=inside.x, scenario=inside.scenario, t=inside.t, memory=memory)

    def hold(self, state):
        return self.driven.hold(self.inside(state))

    def distance(self, state):
        return self._judged(state, self.inner.distance(self.inside(state)))

    def costs(self, state, action):
        return self._judged(state, self.inner.costs(self.inside(state), action))

    def rewards(self, state, action):
        return self._judged(state, self.inner.rewards(self.inside(state), action))

    def errors(self, state):
        errors = self.inner.errors(self.inside(state))
        return jax.vmap(lambda e: self._judged(state, e), 1, 1)(errors)

    def success(self, state):
        some = self.gone or self.silent
        return AbstractGame.success(self, state) if some else super().success(state)

    def violations(self, state):
        # Nobody collides with an agent that is gone.
        there = self.inner.violations(self.inner.aside(self.inside(state), ~self.present))
        return there & jnp.asarray(self.present)

    def _judged(self, state: State, values: Float[Array, "agent"]) -> Float[Array, "agent"]:
        """The values of those who are there and can act, 0 of the others."""
        there = jnp.asarray(self.present)
        there = there & ~self.silenced(state) if self.silent else there
        return jnp.where(there, values, 0.0)

    def _key(self, state: State, purpose: int) -> Array:
        return jax.random.fold_in(jax.random.wrap_key_data(state.memory["seed"]), purpose)


def depth(game: AbstractGame) -> int:
    """How many perturbations lie one inside the other."""
    return 1 + depth(game.inner) if isinstance(game, Perturbed) else 0


def judges_as_a_team(game: AbstractGame) -> tuple[str, str] | None:
    """The task and its own method that judges all agents together, if it replaces one."""
    if isinstance(game, Perturbed):
        return judges_as_a_team(game.inner)
    for name in ("success", "terminated", "failed"):
        if getattr(type(game), name) is not getattr(AbstractGame, name):
            return type(game).__name__, name
    return None


def traced(game: Perturbed) -> Perturbed:
    """The same with its numbers as arrays, so that jit compiles once for all of their values."""
    # A game whose agents cannot be pushed must not be asked to: off stays off.
    struck = tuple(name for name in ("push", "jump") if _on(getattr(game, name)))
    names = ("gain", "noise", "drop", "spread", *struck)
    numbers = lambda g: tuple(getattr(g, name) for name in names)
    return eqx.tree_at(numbers, game, tuple(jnp.asarray(float(x)) for x in numbers(game)))


def nominal_limits(game: AbstractGame) -> AbstractGame:
    """The same, perturbed in all but the strength of its inputs: what a controller is told."""
    if not isinstance(game, AbstractWrapper):
        return game
    game = eqx.tree_at(lambda g: g.inner, game, nominal_limits(game.inner))
    if not isinstance(game, Perturbed):
        return game
    return eqx.tree_at(lambda g: g.gain, game, jnp.asarray(1.0))


def _on(x: float | Array) -> bool:
    return not isinstance(x, (int, float)) or x != 0


def edge_to_cut(game: AbstractGame) -> tuple[int, int] | None:
    """The last edge without which the graph is still connected; else the last edge, if any."""
    linked = game.adjacency
    edges = [(int(a), int(b)) for a, b in np.argwhere(np.triu(linked))]
    for a, b in reversed(edges):
        without = linked.copy()
        without[a, b] = without[b, a] = False
        if (graphs.hops(without, (0,)) >= 0).all():
            return a, b
    return edges[-1] if edges else None


def follower_to_lose(game: AbstractGame) -> int | None:
    """The last agent that is no leader, if any."""
    others = np.flatnonzero(~game.leads)
    return int(others[-1]) if len(others) else None
