"""Alignment: a flock that sees only those nearby comes to one velocity."""

from functools import lru_cache
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.games.sensing import beside_entries, length
from marlyap.tasks.flock import SEEN, PointMasses, around, flying, pushed
from marlyap.threefry import uniform
from marlyap.types import Entry, State


BANK = 10_000  # agents in all the starts that are kept
PAIRS, TRIES = 400_000, 2_000  # of agents in the starts that are drawn at once, and how often


class Push(eqx.Module):
    """The scenario: what moves the agents beside themselves."""

    push: Float[Array, "agent 2"]  # a steady acceleration of each (m/s^2)


class HeldPointMasses(AbstractPlant):
    """q' = p, p' = u + push: each agent by itself, exact for inputs that are held in a step."""

    limits: tuple[float, ...] = (10.0, 10.0)  # largest ax and ay (m/s^2)
    integrator: Integrator = "rk4"
    states: ClassVar[tuple[Entry, ...]] = PointMasses.states
    inputs: ClassVar[tuple[Entry, ...]] = PointMasses.inputs
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = PointMasses.blocks
    coupled: ClassVar[bool] = False

    def field(self, x, u, scenario, time):
        return pushed(x, u + scenario.push)


class GnnFlock(AbstractRegulation):
    """Agents that see those within 0.9 m come to one velocity; no leader, and no place.

    Tolstaya, Gama, Paulos, Pappas, Kumar and Ribeiro, Conf. Robot Learning, 2019, with 20 agents of
    their 100. The cost of an agent is |v - mean v|^2, so that the team's is the variance, as
    published. Starts are theirs: r^2 uniform up to sqrt(N) about the centre, drawn again until
    everybody has two neighbours and nobody is closer than 0.1 m. They are drawn once, into a bank,
    from which each episode takes one and turns it.
    """

    agents: int = 20  # N
    graph: str = "disk:0.9"  # who sees whom
    plant: HeldPointMasses = HeldPointMasses()  # pyright: ignore
    speed: float = 3.0  # velocities are uniform up to this, about one that is, too (m/s)
    near: float = 0.5  # an agent this close to the mean velocity has arrived (m/s)
    reach: float = 0.9  # everybody starts with two neighbours within this (m)
    apart: float = 0.1  # and nobody closer than this (m)
    push: float = 0.0  # largest steady acceleration of each agent in x and y (m/s^2)
    dt: float = 0.01  # s
    horizon: int = 200  # steps in an episode

    def __check_init__(self):
        for name in ("speed", "near", "reach"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        check_range("apart", self.apart, 0, 1e6)
        check_range("push", self.push, 0, min(self.plant.limits))
        if self.agents < 3:
            raise UserError("agents: everybody needs two neighbours; take 3 or more.")

    @property
    def edge(self):
        return self.near

    @property
    def unit(self):
        return "m/s"

    @property
    def tolerances(self):
        told = "velocity - mean velocity, {}"
        return tuple(Tolerance(told.format(axis), "m/s", self.near, "world") for axis in "xy")

    def reset(self, key):
        k_which, k_turn, k_each, k_all, k_push = jax.random.split(key, 5)
        places = jnp.asarray(bank(self.agents, self.reach, self.apart))
        q = places[jax.random.randint(k_which, (), 0, len(places))]
        turn = jax.random.uniform(k_turn, (), maxval=2 * jnp.pi)
        c, s = jnp.cos(turn), jnp.sin(turn)
        q = jnp.stack([c * q[:, 0] - s * q[:, 1], s * q[:, 0] + c * q[:, 1]], axis=1)
        v = jax.random.uniform(k_each, (self.agents, 2), minval=-1.0)
        v = self.speed * (v + jax.random.uniform(k_all, (1, 2), minval=-1.0))
        push = Push(self.push * jax.random.uniform(k_push, (self.agents, 2), minval=-1.0))
        return State(x=jnp.concatenate([q, v], axis=1), scenario=push, t=jnp.asarray(0))

    def observe(self, state, links):
        """Of those nearby, the place and the velocity against its own; nothing else."""
        return around(self, state, jnp.zeros((self.agents, 0)), links)

    def observation_entries(self):
        return beside_entries((), SEEN, self.slots.shape[1])

    def errors(self, state):
        v = state.x[:, 2:]
        return v - jnp.mean(v, axis=0, keepdims=True)

    def distance(self, state):
        return length(self.errors(state))

    def hold(self, state):
        return -state.scenario.push / jnp.asarray(self.plant.limits)[None]

    def costs(self, state, action):
        return jnp.sum(self.errors(state) ** 2, axis=1)

    @property
    def edge_cost(self):
        return self.near**2

    def at_target(self, state):
        x = state.x.at[:, 2:].add(-self.errors(state))
        return eqx.tree_at(lambda s: s.x, state, x)

    def scene(self, state):
        return flying(state)

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.agents, 4))}


@lru_cache(maxsize=8)
def bank(agents: int, reach: float, apart: float) -> Float[np.ndarray, "start agent 2"]:
    """Places of a flock (m), everybody with two neighbours within `reach`, nobody within `apart`.

    Raises UserError where hardly any draw is like that.
    """
    kept, themselves = [], np.diag(np.full(agents, np.inf))
    many, drawn = max(1, BANK // agents), max(1, PAIRS // agents**2)
    for seed in range(TRIES):
        key = np.zeros(1, np.uint32), np.array([seed], np.uint32)
        share, turn = np.moveaxis(uniform(key, drawn, agents, 2)[0], -1, 0)
        radius, angle = np.sqrt(share * np.sqrt(agents)), 2 * np.pi * turn
        q = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
        gap = np.sum((q[:, None] - q[:, :, None]) ** 2, axis=-1) + themselves
        near = (gap < reach**2).sum(axis=2)
        fine = (gap.min(axis=(1, 2)) > apart**2) & (near.min(axis=1) >= 2)
        kept += list(q[fine])
        if len(kept) >= many:
            return np.array(kept[:many], np.float32)
    raise UserError(f"reach: hardly any start of {agents} agents is like that; make it larger.")
