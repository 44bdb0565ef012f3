"""DC microgrid: converters on a ring feed constant-power loads, which make it unstable."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.games.sensing import beside, beside_entries
from marlyap.tasks.cartpoles import check_weights
from marlyap.types import Entry, Scalar, State


class Loads(eqx.Module):
    """The scenario: this episode's loads, lines and capacitors."""

    power: Float[Array, "agent"]  # what each load draws at the start (W)
    change: Float[Array, "agent"]  # by how much it changes (W)
    changes: Scalar  # when (s)
    line: Float[Array, "agent"]  # of the line from i to i + 1, in multiples of the plant's
    capacitance: Float[Array, "agent"]  # in multiples of the plant's

    def at(self, time: Scalar) -> Float[Array, "agent"]:
        """What each load draws at this time (W)."""
        return self.power + jnp.where(time >= self.changes, self.change, 0.0)


class ConverterRing(AbstractPlant):
    """Buck converters, averaged over their switching, on a ring of resistive lines.

        C V_i' = I_i - P_i / V_i - sum_j (V_i - V_j) / r_ij,      L I_i' = u_i - V_i - R I_i.

    Below `low` a load is a resistor, so that its current V P / low^2 stays bounded. The converter
    with its filter, and lines as resistances: Tucci, Riverso, Vasquez, Guerrero and
    Ferrari-Trecate, IEEE Trans. Control Systems Technology 24(4), 2016. A load of constant power is
    a negative resistance, and destabilises the bus where P > V^2 R C / L: Kwasinski and Onwuchekwa,
    IEEE Trans. Power Electronics 26(3), 2011.
    """

    limits: tuple[float, ...] = (20.0,)  # largest u - offset (V)
    integrator: Integrator = "rk4"
    offset: float = 48 + 0.2 * 1000 / 48  # u at action 0: what keeps 48 V under a load of 1 kW (V)
    resistance: float = 0.2  # R, of a filter (ohm)
    inductance: float = 1.8e-3  # L, of a filter (H)
    capacitance: float = 2.2e-3  # C, of a bus (F)
    line: float = 0.5  # r, of a line between neighbours (ohm)
    low: float = 24.0  # below this voltage a load is a resistor (V)
    states: ClassVar[tuple[Entry, ...]] = (
        Entry("bus voltage", "V"),
        Entry("converter current", "A"),
    )
    inputs: ClassVar[tuple[Entry, ...]] = (Entry("converter voltage - offset", "V"),)
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1),)

    def __check_init__(self):
        check_range("offset", self.offset, -1e6, 1e6)
        check_range("resistance", self.resistance, 0, 1e6)
        for name in ("inductance", "capacitance", "line", "low"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)

    def field(self, x, u, scenario, time):
        V, current = x[:, 0], x[:, 1]
        onwards = (V - jnp.roll(V, -1)) / (self.line * scenario.line)  # from i to i + 1
        C = self.capacitance * scenario.capacitance
        rise = current - self.drawn(V, scenario.at(time)) - onwards + jnp.roll(onwards, 1)
        grow = self.offset + u[:, 0] - V - self.resistance * current
        return jnp.stack([rise / C, grow / self.inductance], axis=1)

    def drawn(self, V: Float[Array, "agent"], power: Float[Array, "agent"]) -> Array:
        """The current that a load of this power draws at the voltage V (A)."""
        return jnp.where(V >= self.low, power / jnp.maximum(V, self.low), power * V / self.low**2)


class Microgrid(AbstractRegulation):
    """Converters on a ring keep every bus at 48 V, whatever the loads of the episode draw.

    Unstable without control above 563 W a load: at 1 kW by 43/s, 0.4 % a step. The action that
    keeps the target set depends on the load, which each agent measures. The cost of an agent is
    ((V - 48) / 4)^2 + 0.1 ((I - P / 48) / 5)^2 + 0.01 (a - hold)^2. The team fails when a voltage
    leaves [`low`, `high`].
    """

    agents: int = 6  # N
    graph: str = "ring"  # who sees whom; the lines form a ring whatever it is
    plant: ConverterRing = ConverterRing()  # pyright: ignore
    reference: float = 48.0  # of every bus (V)
    near: float = 0.48  # a bus within this of the reference has arrived (V)
    low: float = 24.0  # below it the team has failed (V)
    high: float = 72.0  # above it the team has failed (V)
    weights: tuple[float, ...] = (1 / 4**2, 0.1 / 5**2)  # of the squared errors in the cost
    effort: float = 0.01  # weight of (action - hold)^2 in the cost
    power: float = 1000.0  # of a load, on average (W)
    power_spread: float = 0.3  # loads are drawn anew in an episode, up to this share off
    start_voltage: float = 4.0  # starts are uniform up to this far from the reference (V)
    start_current: float = 5.0  # and from what the load draws there (A)
    load_step: float = 0.0  # largest change of each load, at a random time of an episode (W)
    line_spread: float = 0.0  # lines are drawn anew in an episode, up to this share off
    capacitance_spread: float = 0.0  # capacitors are drawn anew, up to this share off
    dt: float = 1e-4  # s
    horizon: int = 300  # steps in an episode

    def __check_init__(self):
        for name in ("reference", "near", "high", "power"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("low", "effort", "start_voltage", "start_current", "load_step"):
            check_range(name, getattr(self, name), 0, 1e6)
        for name in ("power_spread", "line_spread", "capacitance_spread"):
            check_range(name, getattr(self, name), 0, 0.99)
        if not self.low < self.reference < self.high:
            raise UserError(f"reference: {self.reference} V must lie between low and high.")
        if self.load_step > self.power * (1 - self.power_spread):
            raise UserError("load_step: a load could become negative; take a smaller change.")
        check_weights(self.weights, 2)

    @property
    def tolerances(self):
        return (
            Tolerance("bus voltage - reference", "V", self.near),
            Tolerance("converter current - current of the load at the reference", "A"),
        )

    def loads(self, state: State) -> Float[Array, "agent"]:
        """What each load draws now (W)."""
        return state.scenario.at(state.t * self.dt)

    def reset(self, key):
        k_power, k_x, k_change, k_time, k_grid = jax.random.split(key, 5)
        n, near = self.agents, lambda key, shape: jax.random.uniform(key, shape, minval=-1.0)
        line, capacitance = near(k_grid, (2, n))
        loads = Loads(
            power=self.power * (1 + self.power_spread * near(k_power, (n,))),
            change=self.load_step * near(k_change, (n,)),
            changes=jax.random.uniform(k_time, ()) * self.horizon * self.dt,
            line=1 + self.line_spread * line,
            capacitance=1 + self.capacitance_spread * capacitance,
        )
        start = State(x=jnp.zeros((n, 2)), scenario=loads, t=jnp.asarray(0))
        off = jnp.array([self.start_voltage, self.start_current])[None] * near(k_x, (n, 2))
        return eqx.tree_at(lambda s: s.x, start, self.at_target(start).x + off)

    def observe(self, state, links):
        """Its own voltage, current and load, and how far each neighbour's voltage is from its own.

        The load is measured at the own bus. Currents and powers are told as what they differ by.
        """
        V, power = state.x[:, 0], self.loads(state)
        drawn = self.plant.drawn(V, power)
        own = [
            V - self.reference,
            state.x[:, 1] - drawn,
            drawn - self.power / self.reference,
            power / self.power - 1,
        ]
        gap = (V[None, :] - V[:, None])[..., None]
        return beside(jnp.stack(own, axis=1), gap, jnp.asarray(self.slots), links)

    def observation_entries(self):
        own = (
            Entry("bus voltage - reference", "V"),
            Entry("converter current - current of the load", "A"),
            Entry(f"current of the load - {self.power / self.reference:.4g} A", "A"),
            Entry(f"power of the load / {self.power:g} W - 1"),
        )
        seen = (Entry("bus voltage of {j} - own", "V"),)
        return beside_entries(own, seen, self.slots.shape[1])

    def errors(self, state):
        return state.x - self.at_target(state).x

    def features(self, state):
        """The errors, magnified near zero too, and the load, on which the motion depends."""
        load = self.loads(state)[:, None] / self.power - 1
        return jnp.concatenate([super().features(state), load], axis=1)

    def hold(self, state):
        """What keeps every bus at the reference under the loads of now."""
        u = self.reference + self.plant.resistance * self.loads(state) / self.reference
        return ((u - self.plant.offset) / self.plant.limits[0])[:, None]

    def costs(self, state, action):
        effort = jnp.sum((jnp.clip(action, -1.0, 1.0) - self.hold(state)) ** 2, axis=1)
        return self.errors(state) ** 2 @ jnp.asarray(self.weights) + self.effort * effort

    def failed(self, state):
        V = state.x[:, 0]
        return ~jnp.all((V >= self.low) & (V <= self.high))

    @property
    def edge_cost(self):
        return self.weights[0] * self.near**2

    @property
    def failure_cost(self):
        return 25.0

    def at_target(self, state):
        current = self.loads(state) / self.reference
        x = jnp.stack([jnp.full_like(current, self.reference), current], axis=1)
        return eqx.tree_at(lambda s: s.x, state, x)

    def signals(self, state):
        return {
            "bus voltage (V)": state.x[:, 0],
            "converter current (A)": state.x[:, 1],
            "power of the load (W)": self.loads(state),
        }

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.agents, 2))}
