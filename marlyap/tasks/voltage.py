"""Voltage: inverters on a distribution feeder keep voltages in a band by reactive power."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.tasks.networks import STARTS, feeder
from marlyap.types import Entry, Scalar, State


ITERATIONS = 60  # of the power flow; 25 are too few for the shorter feeder
CLOSE = 1e-5  # two iterates of a voltage are equal (p.u.)
NO_LESS = 0.05  # a voltage, in a denominator (p.u.)
CORRECTIONS = 15  # of the reactive power at which every voltage is nominal


class Injections(eqx.Module):
    """The scenario: what this episode's loads and panels feed into the buses."""

    P: Float[Array, "bus"]  # (MW)
    Q: Float[Array, "bus"]  # (MVar)
    change: Scalar  # by which share all of it grows
    changes: Scalar  # when (s)
    lines: Scalar  # impedances, in multiples of the feeder's


class PowerFlow(AbstractPlant):
    """Reactive power q that inverters feed in, and voltages v as the power flow has them:

        q+ = q - u,   v+ = |V(q+)|,   V = 1 + Z conj(S / V),

    with steps of 1 s, S the power into each bus (p.u.), 1 p.u. at the substation, lines balanced.
    The last equation is iterated from V = 1; where that does not converge the voltage has
    collapsed, and v is 0.
    """

    limits: tuple[float, ...] = (0.3,)  # largest change of q in a step (MVar)
    integrator: Integrator = "euler"
    buses: str = "13"  # 13 or 33: the feeder, by its number of buses
    inverters: tuple[int, ...] = (2, 7, 9)  # at which buses, 0 being the substation
    states: ClassVar[tuple[Entry, ...]] = (
        Entry("reactive power fed in", "MVar"),
        Entry("voltage", "p.u."),
    )
    inputs: ClassVar[tuple[Entry, ...]] = (Entry("reactive power taken back", "MVar"),)
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1),)

    def __check_init__(self):
        if self.buses not in STARTS:
            raise UserError(f"buses: there is no feeder with {self.buses}; take 13 or 33.")
        if not all(0 < bus < int(self.buses) for bus in self.inverters):
            raise UserError(
                f"inverters: {self.inverters} must be buses from 1 to {int(self.buses) - 1}."
            )

    def field(self, x, u, scenario, time):
        q = x[:, 0] - u[:, 0]
        return jnp.stack([q, self.voltages(q, scenario, time)], axis=1) - x

    def voltages(
        self, q: Float[Array, "agent"], scenario: Injections, time: Scalar
    ) -> Float[Array, "agent"]:
        """v at the inverters (p.u.); 0 where there is no power flow."""
        grid, at = feeder(self.buses), self.at
        grown = 1 + jnp.where(time >= scenario.changes, scenario.change, 0.0)
        S = jax.lax.complex(grown * scenario.P, (grown * scenario.Q).at[at].add(q)) / grid.base
        Z = jnp.asarray(grid.Z, S.dtype) * scenario.lines

        def iterate(_, pair):
            V = jnp.where(jnp.abs(pair[0]) > NO_LESS, pair[0], NO_LESS)
            return 1 + Z @ jnp.conj(S / V), pair[0]

        V, before = jax.lax.fori_loop(0, ITERATIONS, iterate, (jnp.ones_like(S), jnp.ones_like(S)))
        settled = jnp.max(jnp.abs(V - before)) < CLOSE
        return jnp.where(settled, jnp.abs(V[at]), 0.0)

    @property
    def at(self) -> Int[np.ndarray, "agent"]:
        """The inverters' places among the buses below the substation."""
        return np.array(self.inverters) - 1

    @property
    def sensitivity(self) -> Float[np.ndarray, "agent agent"]:
        """X = dv/dq of the feeder without load (p.u./MVar)."""
        grid = feeder(self.buses)
        return np.imag(grid.Z)[np.ix_(self.at, self.at)] / grid.base


class Voltage(AbstractRegulation):
    """Each inverter sees its own voltage and reactive power, and all bring theirs into the band.

    Distributed voltage control as posed by Feng et al., 2023. The target is a set: errors are zero
    anywhere in the band, so that no linearisation at one point says much. The cost of an agent is
    (distance from the band / 0.05)^2 + 0.01 a^2. The team fails when a voltage leaves
    [`fall`, `rise`]. Success asks for the last change of q to be small, too: a team that jumps to
    and fro across the band has not settled.
    """

    agents: int = 3  # N: the inverters
    graph: str = "complete"  # nothing is heard; the feeder couples all
    plant: PowerFlow = PowerFlow()  # pyright: ignore
    low: float = 0.95  # of the band (p.u.)
    high: float = 1.05  # of the band (p.u.)
    near: float = 1e-5  # a voltage this close to the band is in it (p.u.)
    settled: float = 0.1  # share of the largest change of q below which a team has settled
    fall: float = 0.75  # below it the team has failed (p.u.)
    rise: float = 1.25  # above it the team has failed (p.u.)
    weight: float = 400.0  # of the squared error in the cost
    effort: float = 0.01  # weight of the squared action in the cost
    load_step: float = 0.0  # all injections grow, at a random time, by up to this share
    line_spread: float = 0.0  # impedances are drawn anew in an episode, up to this share off
    dt: float = 1.0  # s
    horizon: int = 30  # steps in an episode

    def __check_init__(self):
        if self.agents != len(self.plant.inverters):
            raise UserError(
                f"agents: {self.agents} needs as many plant.inverters, not {self.plant.inverters}."
            )
        if not 0 < self.fall < self.low < 1 < self.high < self.rise < 10:
            raise UserError("low: fall < low < 1 < high < rise must hold.")
        for name in ("near", "settled"):
            check_range(name, getattr(self, name), 0, 1, open=True)
        for name in ("weight", "effort"):
            check_range(name, getattr(self, name), 0, 1e6)
        for name in ("load_step", "line_spread"):
            check_range(name, getattr(self, name), 0, 0.99)

    @property
    def kinds(self):
        return np.arange(self.agents)

    @property
    def tolerances(self):
        return (Tolerance("distance of the voltage from its band", "p.u.", self.near),)

    def reset(self, key):
        k_power, k_change, k_time, k_lines = jax.random.split(key, 4)
        off = lambda key: jax.random.uniform(key, (), minval=-1.0)
        P, Q = STARTS[self.plant.buses](feeder(self.plant.buses), self.plant.at, k_power)
        power = Injections(
            P=P,
            Q=Q,
            change=self.load_step * off(k_change),
            changes=jax.random.uniform(k_time, ()) * self.horizon * self.dt,
            lines=1 + self.line_spread * off(k_lines),
        )
        none = jnp.zeros(self.agents)
        start = State(x=jnp.zeros((self.agents, 2)), scenario=power, t=jnp.asarray(0), memory=none)
        return self.feeding(start, none)

    def feeding(self, state: State, q: Float[Array, "agent"]) -> State:
        """The same episode with these reactive powers (MVar), and the voltages that follow."""
        v = self.plant.voltages(q, state.scenario, state.t * self.dt)
        return eqx.tree_at(lambda s: s.x, state, jnp.stack([q, v], axis=1))

    def step(self, state, action):
        """Remembers the last change of q (MVar), by which a team has settled or not."""
        after = super().step(state, action)
        u = self.plant.inputs_of(action)[:, 0]
        return State(x=after.x, scenario=after.scenario, t=after.t, memory=u)

    def observe(self, state, links):
        q, v = state.x.T
        return jnp.stack([q, (v - 1) / 0.05], axis=1)

    def observation_entries(self):
        return (self.plant.states[0], Entry("(voltage - 1 p.u.) / 0.05 p.u."))

    def errors(self, state):
        v = state.x[:, 1:]
        return jnp.maximum(v - self.high, 0) - jnp.maximum(self.low - v, 0)

    def distance(self, state):
        off = jnp.abs(self.errors(state)[:, 0]) / self.near
        return jnp.maximum(off, jnp.abs(state.memory) / (self.settled * self.plant.limits[0]))

    def features(self, state):
        """The errors, magnified too, and what each inverter knows."""
        errors, links = self.errors(state), jnp.asarray(self.adjacency)
        magnified = errors / (jnp.abs(errors) + 0.01)
        return jnp.concatenate([errors, magnified, self.observe(state, links)], axis=1)

    def costs(self, state, action):
        effort = jnp.sum(jnp.clip(action, -1.0, 1.0) ** 2, axis=1)
        return self.weight * self.errors(state)[:, 0] ** 2 + self.effort * effort

    def failed(self, state):
        v = state.x[:, 1]
        return ~jnp.all((v >= self.fall) & (v <= self.rise))

    @property
    def edge_cost(self):
        return self.effort * self.settled**2

    @property
    def failure_cost(self):
        return 100.0

    def at_target(self, state):
        """At rest with every voltage nominal, in the middle of the band."""
        back = jnp.asarray(np.linalg.inv(self.plant.sensitivity), state.x.dtype)
        flow = lambda q: self.plant.voltages(q, state.scenario, state.t * self.dt)
        closer = lambda _, q: q + back @ (1 - flow(q))
        q = jax.lax.fori_loop(0, CORRECTIONS, closer, jnp.zeros_like(state.x[:, 0]))
        there = self.feeding(state, q)
        return eqx.tree_at(lambda s: s.memory, there, jnp.zeros_like(state.memory))

    def farther(self, state, factor):
        q = self.at_target(state).x[:, 0]
        return self.feeding(state, q + factor * (state.x[:, 0] - q))

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.agents, 2))}
