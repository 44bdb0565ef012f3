"""Frequency: machines of a transmission grid, coupled by its lines, return to the nominal one."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.games.sensing import beside, beside_entries
from marlyap.tasks.cartpoles import check_weights
from marlyap.tasks.networks import new_england
from marlyap.types import Entry, Scalar, State


STRONGEST = "0-7,0-8,0-9,1-9,2-9,5-9,5-6,3-5,3-4"  # the spanning tree of the largest K_ij
CORRECTIONS = 30  # of the angles at which the lines carry a load; each leaves less than half


class Disturbance(eqx.Module):
    """The scenario: this episode's change of load, and what its grid is like."""

    load: Float[Array, "agent"]  # what is drawn at each machine beyond the solved power flow (p.u.)
    share: Scalar  # of its largest, what each machine has to give for that
    rest: Float[Array, "agent"]  # the rotors' angles when all of them do (rad)
    inertia: Float[Array, "agent"]  # in multiples of the plant's
    damping: Float[Array, "agent"]  # in multiples of the plant's
    lines: Float[Array, "agent agent"]  # in multiples of the network's


class SwingEquations(AbstractPlant):
    """Ten machines, frequencies w counted from the nominal one:

        delta_i' = 2 pi w_i,
        M_i w_i' = P_i - load_i - D_i w_i - u_i - sum_j K_ij sin(delta_i - delta_j),

    delta in rad, w in Hz, powers in p.u. on 100 MVA, M = 2 H / 60. P is what makes the solved power
    flow an equilibrium. Machines, limits and damping: Cui, Jiang and Zhang, IEEE Trans. Power
    Systems 38(2), 2023, and their code; H of machine 3 as in Athay et al. Their explicit Euler is
    unstable at this operating point without control, so frequencies are stepped before angles.
    """

    limits: tuple[float, ...] = (1.0,)  # in multiples of `largest`
    integrator: Integrator = "euler"
    inertia: tuple[float, ...] = (
        42.0,
        30.3,
        35.8,
        28.6,
        26.0,
        34.8,
        26.4,
        24.3,
        34.5,
        500.0,
    )  # H, s
    damping: tuple[float, ...] = tuple(d / 3000 for d in (590, *7 * (865,), 911, 911))  # D, p.u./Hz
    largest: tuple[float, ...] = (0.19606592, 0.2190382, 0.22375287, 0.0975513, 0.29071101) + (
        0.22091283,
        0.38759459,
        0.56512538,
        0.24151538,
        0.29821917,
    )  # what each machine can take back or give, p.u.
    states: ClassVar[tuple[Entry, ...]] = (
        Entry("angle of the rotor", "rad"),
        Entry("frequency - nominal", "Hz"),
    )
    inputs: ClassVar[tuple[Entry, ...]] = (Entry("power taken back / the machine's largest"),)
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((1,), (0,))

    def __check_init__(self):
        for name, low in (("inertia", 0.0), ("damping", -1e6), ("largest", 0.0)):
            values = getattr(self, name)
            if len(values) != len(new_england().angle):
                raise UserError(f"{name}: give ten numbers, one for each machine, not {values}.")
            for value in values:
                check_range(name, value, low, 1e6, open=True)

    def field(self, x, u, scenario, time):
        net, angle, w = new_england(), x[:, 0], x[:, 1]
        feed = net.flow(jnp.asarray(net.angle, x.dtype), jnp.ones(()))
        power = feed - scenario.load - jnp.asarray(self.damping) * scenario.damping * w
        power = power - jnp.asarray(self.largest) * u[:, 0] - net.flow(angle, scenario.lines)
        M = 2 * jnp.asarray(self.inertia) / 60 * scenario.inertia
        return jnp.stack([2 * jnp.pi * w, power / M], axis=1)


class Frequency(AbstractRegulation):
    """Machines bring the frequency back to nominal; each measures its own.

    Hardly damped without control; with a negative damping, as by fast exciters, unstable. The cost
    of an agent is (w / 0.1)^2 + 0.1 (theta / 0.1)^2 + 0.01 (a - hold)^2, theta its angle from where
    it rests, less the mean of that over machines. The team fails when two rotors are more than half
    a turn apart, or a frequency is `most` off. Success looks at frequencies alone.

    A step of load comes at the start, at one machine. The frequency can return only if all of it is
    replaced; the target is that every machine gives the same share of its largest.
    """

    agents: int = 10  # N; the network has ten machines
    graph: str = STRONGEST  # whose frequency is heard, if `hears`
    plant: SwingEquations = SwingEquations()  # pyright: ignore
    hears: bool = False  # whether neighbours' frequencies are observed
    near: float = 0.02  # a frequency this close to nominal has arrived (Hz)
    most: float = 3.0  # a frequency farther off has failed (Hz)
    weights: tuple[float, ...] = (10.0, 100.0)  # of the squared errors in the cost
    effort: float = 0.01  # weight of (action - hold)^2 in the cost
    start_angle: float = 0.1  # starts are uniform up to this far from the solved power flow (rad)
    start_frequency: float = 0.2  # and from nominal (Hz)
    load_step: float = 0.0  # largest change of load, at one machine (p.u.)
    inertia_spread: float = 0.0  # drawn anew in an episode for each machine, up to this share off
    damping_spread: float = 0.0  # likewise
    line_spread: float = 0.0  # likewise for each line
    dt: float = 0.01  # s
    horizon: int = 400  # steps in an episode

    def __check_init__(self):
        if self.agents != len(new_england().angle):
            raise UserError(
                f"agents: {self.agents} are not the network's machines; leave it at 10."
            )
        for name in ("near", "most"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("effort", "start_angle", "start_frequency"):
            check_range(name, getattr(self, name), 0, 1e6)
        for name in ("inertia_spread", "damping_spread", "line_spread"):
            check_range(name, getattr(self, name), 0, 0.5)
        check_range("load_step", self.load_step, 0, sum(self.plant.largest))
        check_weights(self.weights, 2)

    @property
    def kinds(self):
        return np.arange(self.agents)

    @property
    def tolerances(self):
        return (
            Tolerance("angle of the rotor from its rest, less the mean", "rad"),
            Tolerance("frequency - nominal", "Hz", self.near),
        )

    def reset(self, key):
        k_x, k_load, k_grid = jax.random.split(key, 3)
        n, near = self.agents, lambda key, shape: jax.random.uniform(key, shape, minval=-1.0)
        k_where, k_size = jax.random.split(k_load)
        at = jax.nn.one_hot(jax.random.randint(k_where, (), 0, n), n)
        machines, lines = near(k_grid, (2, n)), near(jax.random.fold_in(k_grid, 1), (n, n))
        grid = Disturbance(
            load=self.load_step * near(k_size, ()) * at,
            share=jnp.zeros(()),
            rest=jnp.asarray(new_england().angle, jnp.float32),
            inertia=1 + self.inertia_spread * machines[0],
            damping=1 + self.damping_spread * machines[1],
            lines=1 + self.line_spread * (lines + lines.T) / 2,
        )
        if self.load_step or self.line_spread:
            grid = self.at_rest(grid)
        off = jnp.array([[self.start_angle, self.start_frequency]]) * near(k_x, (n, 2))
        x = off.at[:, 0].add(jnp.asarray(new_england().angle, jnp.float32))
        return State(x=x, scenario=grid, t=jnp.asarray(0))

    def at_rest(self, grid: Disturbance) -> Disturbance:
        """With the share of every machine, and the angles at which the lines then carry it."""
        net, largest = new_england(), jnp.asarray(self.plant.largest)
        total = jnp.sum(grid.load)
        feed = net.flow(jnp.asarray(net.angle, total.dtype), jnp.ones(()))
        feed = feed - grid.load + largest * total / jnp.sum(largest)
        back = jnp.asarray(np.linalg.pinv(net.stiffness), total.dtype)
        ahead = lambda _, angle: angle + back @ (feed - net.flow(angle, grid.lines))
        rest = jax.lax.fori_loop(0, CORRECTIONS, ahead, grid.rest)
        return eqx.tree_at(lambda g: (g.share, g.rest), grid, (total / jnp.sum(largest), rest))

    def observe(self, state, links):
        """Its own frequency and, if asked, how its neighbours' differ: over the strongest lines."""
        w = state.x[:, 1]
        if not self.hears:
            return w[:, None]
        gap = (w[None, :] - w[:, None])[..., None]
        return beside(w[:, None], gap, jnp.asarray(self.slots), links)

    def observation_entries(self):
        own, seen = self.plant.states[1:], (Entry("frequency of {j} - own", "Hz"),)
        return beside_entries(own, seen, self.slots.shape[1] if self.hears else 0)

    def errors(self, state):
        off = state.x[:, 0] - state.scenario.rest
        return jnp.stack([off - jnp.mean(off), state.x[:, 1]], axis=1)

    def hold(self, state):
        return jnp.broadcast_to(-state.scenario.share, (self.agents, 1)) / self.plant.limits[0]

    def costs(self, state, action):
        effort = jnp.sum((jnp.clip(action, -1.0, 1.0) - self.hold(state)) ** 2, axis=1)
        return self.errors(state) ** 2 @ jnp.asarray(self.weights) + self.effort * effort

    def failed(self, state):
        angle, w = state.x.T
        return ~((jnp.ptp(angle) <= jnp.pi) & jnp.all(jnp.abs(w) <= self.most))

    @property
    def edge_cost(self):
        return self.weights[1] * self.near**2

    @property
    def failure_cost(self):
        return 100.0

    def at_target(self, state):
        x = jnp.stack([state.scenario.rest, jnp.zeros(self.agents)], axis=1)
        return eqx.tree_at(lambda s: s.x, state, x)

    def signals(self, state):
        angle, w = self.errors(state).T
        return {"frequency - nominal (Hz)": w, "angle from rest (rad)": angle}

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.agents, 2))}
