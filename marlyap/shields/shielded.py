"""A game behind a credit shield: whatever the policy, the team comes to rest.

    symbol    here        meaning
    q         q           the reference of an agent: its goal, or where its parent will stop
    S         credit      what the agent may still do worse than its base law
    J, c      Plan        the base law's plan from a state, and the cost of a step
    A         J - c - J'  by how much an action is better than the base law's
    delta     others      what others did to the plan: J at the state reached - J at the one planned

Every step, agent i: an action is applied if the plan from the state x' that it leads to arrives,
and S + A >= 0 or the window is open; then S <- clip(S + A, 0, sigma J'). Else kappa is applied.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from marlyap import graph as graphs
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame, AbstractRegulation, regulated
from marlyap.games.wrapper import AbstractWrapper, plain_game
from marlyap.shields.plan import Plan, Worth, foreseen, laws, worths
from marlyap.shields.shield import Shield, planar
from marlyap.types import Action, State


ROUNDING = 1e-5  # of a cost in float32 (m)
STILL = 1e-6  # a reference that moves less in a step does not move (m)
Each = Float[Array, "agent"]


class Decision(NamedTuple):
    """What the shield makes of one step, for every agent."""

    action: Action  # that is applied
    admitted: Bool[Array, "agent"]  # whether it is the policy's
    outside: Bool[Array, "agent"]  # of the terminal set: only there a policy has a say
    q: Float[Array, "agent 2"]
    credit: Each  # after the step
    cost: Each  # c, of this step
    before: Worth  # the plan from the state
    planned: Each  # J at the state that the action leads to


class Shielded(AbstractWrapper):
    """`inner` behind a shield, which is part of the game, so that any policy runs behind it.

    The observations are those of `inner`. An action is a proposal, or a residual on the base law's
    action. The parent of an agent is fixed by the graph: its neighbour with the fewest hops to a
    leader. While the parent is not heard, its last reference holds. Inputs that are under way are
    known to their agent, which plans from the state that they lead to.

    What disturbs a plant belongs inside: Shielded(Perturbed(game), shield).

    Raises UserError for a game whose agents have no base law, or whose graph changes.
    """

    inner: AbstractRegulation
    shield: Shield

    def __init__(self, inner: AbstractRegulation, shield: Shield = Shield()):  # noqa: B008
        self.inner, self.shield = inner, shield

    # What the game inside says.
    agents = property(lambda self: self.inner.agents)  # pyright: ignore[reportAssignmentType]
    graph = property(lambda self: self.inner.graph)  # pyright: ignore[reportAssignmentType]
    dt = property(lambda self: self.inner.dt)  # pyright: ignore[reportAssignmentType]
    horizon = property(lambda self: self.inner.horizon)  # pyright: ignore[reportAssignmentType]

    def __check_init__(self):
        if graphs.disk_radius(self.inner.graph) is not None:
            raise UserError("shield: it needs a tree of parents that stays; a disk changes.")
        game = planar(plain_game(self.inner))
        self.shield.plan(game)
        if not self.inner.leads.all():  # raises where followers cannot tell their places
            _ = game.displacements

    @property
    def nominal(self):
        raise UserError(
            "shield: robots would act without it, for a bundle holds the policy alone; export a "
            "run that was trained without a shield."
        )

    @property
    def plan(self) -> Plan:
        return self.shield.plan(plain_game(self.inner))

    @property
    def hops(self) -> Int[np.ndarray, "agent"]:
        """From each agent to its nearest leader, -1 where there is no path."""
        return graphs.hops(self.inner.adjacency, self.inner.informed)

    @property
    def parents(self) -> Int[np.ndarray, "agent"]:
        """The parent of each agent; -1 for a leader, and where no path leads to one."""
        hops = np.where(self.hops < 0, self.agents, self.hops)
        seen = np.where(self.inner.adjacency, hops[None], self.agents)
        parent = np.where(seen.min(axis=1) < self.agents, seen.argmin(axis=1), -1)
        return np.where(self.leads, -1, parent)

    def beneath(self, change):
        return Shielded(regulated(self.inner.beneath(change)), self.shield)

    def strengthened(self, gain):
        return Shielded(regulated(self.inner.strengthened(gain)), self.shield)

    def reset(self, key):
        return self.begun(self.inner.reset(key))

    def begun(self, inside: State) -> State:
        """The state of an episode that begins here: full credit, nothing paid yet."""
        plan, zero = self.plan, jnp.zeros(self.agents)
        q = self.references(inside, jax.vmap(lambda x: plan.drive.stop(plan.game, x))(inside.x))
        J = worths(plan, self._foreseen(inside), q).cost if self.shield.on else zero
        memory = {"inner": inside.memory, "q": q, "credit": self.shield.sigma * J, "planned": J}
        memory |= {"first": J, "paid": zero, "others": zero, "admitted": zero, "asked": zero}
        memory |= {"late": zero}
        return State(x=inside.x, scenario=inside.scenario, t=inside.t, memory=memory)

    def outside(self, inside, state):
        """Begun anew: a state that was moved has another plan."""
        return self.begun(inside)

    def references(self, inside: State, held: Float[Array, "agent 2"]) -> Float[Array, "agent 2"]:
        """q of every agent: its goal, where its parent will stop, or the one `held` so far."""
        plan, parent, i = self.plan, self.parents, np.arange(self.agents)
        heard = jnp.asarray(parent >= 0) & self.inner.linked(inside)[i, parent]
        q = held
        if (parent >= 0).any():
            places = jnp.asarray(planar(plain_game(self.inner)).displacements, held.dtype)
            ends = jax.vmap(lambda x: plan.drive.stop(plan.game, x))(inside.x)
            q = jnp.where(heard[:, None], ends[parent] + places - places[parent], held)
        goals = planar(plain_game(self.inner)).goals(inside)
        return jnp.where(jnp.asarray(self.leads)[:, None], goals, q)

    def _foreseen(self, inside: State) -> Float[Array, "agent dx"]:
        return foreseen(self.plan, inside.x, self.inner.underway(inside))

    def decide(self, state: State, action: Action) -> Decision:
        """What is applied of the policy's `action`, and the accounts after it."""
        plan, inside, held = self.plan, self.inside(state), state.memory["q"]
        x, q = self._foreseen(inside), self.references(inside, held)
        base = laws(plan, x, q)
        asked = jnp.clip(action, -1.0, 1.0)
        if self.shield.action == "residual":
            asked = jnp.clip(base + self.shield.reach * asked, -1.0, 1.0)
        if not self.shield.on:
            yes, none = jnp.ones(self.agents, bool), jnp.zeros(self.agents)
            return Decision(asked, yes, yes, q, none, none, Worth(none, yes), none)
        after = jax.vmap(plan.after)
        found = worths(plan, jnp.concatenate([x, after(x, asked)]), jnp.concatenate([q, q]))
        now, then = (jax.tree.map(lambda y, k=k: y.reshape(2, -1)[k], found) for k in range(2))
        c, outside = jax.vmap(plan.cost)(x, q), ~jax.vmap(plan.arrived)(x, q)
        balance = state.memory["credit"] + now.cost - c - then.cost
        moved = jnp.sum((q - held) ** 2, axis=1) > STILL**2
        window = self.shield.window_of(int(self.hops.max()))
        free = moved & ~jnp.asarray(self.leads) & (then.steps <= window)
        fits = lambda worth: worth.steps <= plan.steps
        admitted = outside & fits(then) & ((balance >= -ROUNDING) | free)
        credit = jnp.clip(balance, 0.0, self.shield.sigma * then.cost)
        return Decision(
            action=jnp.where(admitted[:, None], asked, base),
            admitted=admitted,
            outside=outside,
            q=q,
            credit=jnp.where(admitted, credit, state.memory["credit"]),
            cost=c,
            before=now,
            # By Lemma 1; a plan that does not arrive has no such sum, and is left out of delta.
            planned=jnp.where(admitted, then.cost, jnp.where(fits(now), now.cost - c, jnp.nan)),
        )

    def step(self, state, action):
        d, m = self.decide(state, action), state.memory
        after = self.inner.step(self.inside(state), d.action)
        arrives = d.before.steps <= self.shield.steps
        delta = jnp.nan_to_num(jnp.where(arrives, d.before.cost - m["planned"], 0.0))
        counted = {"admitted": d.admitted, "asked": d.outside, "late": ~arrives}
        memory = {k: m[k] + v for k, v in counted.items()} | {"first": m["first"]}
        memory |= {"paid": m["paid"] + d.cost, "others": m["others"] + delta}
        memory |= {"q": d.q, "credit": d.credit, "planned": d.planned, "inner": after.memory}
        return State(x=after.x, scenario=after.scenario, t=after.t, memory=memory)

    def costs(self, state, action):
        return self.inner.costs(self.inside(state), self.decide(state, action).action)

    def rewards(self, state, action):
        return self.inner.rewards(self.inside(state), self.decide(state, action).action)

    def hold(self, state):
        if self.shield.action == "residual":
            return jnp.zeros((self.agents, self.du))
        return self.inner.hold(self.inside(state))


def behind(game: Any, shield: Shield | None) -> Any:
    """The game behind this shield; as it is where there is none.

    Raises UserError for a game whose agents have no base law, such as one outside JAX.
    """
    if shield is None:
        return game
    if not isinstance(game, AbstractGame):
        raise UserError("shield: no base law is known outside JAX; leave --shield out.")
    shield.plan(plain_game(game))
    return Shielded(regulated(game), shield)


def split(game: Any) -> tuple[Any, Shield | None]:
    """The game before its shield, and the shield if it has one."""
    return (game.inner, game.shield) if isinstance(game, Shielded) else (game, None)
