"""Consensus: agents agree on a number by hearing their neighbours only."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from marlyap.errors import check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.games.sensing import beside, beside_entries, noise
from marlyap.types import Entry, State


# A ring of ten with two chords.
NETWORK = "0-1,1-2,2-3,3-4,4-5,5-6,6-7,7-8,8-9,9-0,0-5,2-7"


class Hearing(eqx.Module):
    """The scenario: what this episode's noise follows from."""

    seed: UInt32[Array, "2"]


class Averaging(AbstractPlant):
    """Numbers of which each agent changes its own: with steps of 1 s

        x_i+ = growth x_i + u_i.

    x_i counts from the mean of the starts. With a growth above 1 it counts from the mean of now,

        x+ = (I - 1 1'/N) (growth x + u),

    since otherwise the mean, and its round-off, would grow for ever.
    """

    limits: tuple[float, ...] = (2.0,)  # largest change in a step
    integrator: Integrator = "euler"
    growth: float = 1.0  # of a number that is left alone, by step; 1 or more
    states: ClassVar[tuple[Entry, ...]] = (Entry("number - mean"),)
    inputs: ClassVar[tuple[Entry, ...]] = (Entry("change of the number"),)
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((0,),)

    def __check_init__(self):
        check_range("growth", self.growth, 1, 100)

    def field(self, x, u, scenario, time):
        moved = self.growth * x + u
        if self.growth > 1:
            moved = moved - jnp.mean(moved, axis=0, keepdims=True)
        return moved - x


class Consensus(AbstractRegulation):
    """Each agent hears how its neighbours' numbers differ from its own, and all are to agree.

    With a growth of 1 they agree on the mean of the starts (Xiao and Boyd, Systems and Control
    Letters 53, 2004; Olfati-Saber, Fax and Murray, Proc. IEEE 95(1), 2007). With a larger one the
    game is unstable without control, and agreement is possible exactly for

        growth < (1 + l_2 / l_N) / (1 - l_2 / l_N),

    l_2 and l_N being the smallest positive and the largest eigenvalue of the graph's Laplacian
    (You and Xie, IEEE Trans. Automatic Control 56(10), 2011): 1.316 here. The cost of an agent is
    the square of its error. The team fails when an error exceeds `most`.
    """

    agents: int = 10  # N
    graph: str = NETWORK  # who hears whom
    plant: Averaging = Averaging()  # pyright: ignore
    near: float = 0.01  # an agent this close to the mean has arrived
    most: float = 10.0  # farther from the mean the team has failed
    start: float = 1.0  # numbers start uniform up to this far from 0
    noise: float = 0.0  # standard deviation of what is heard of a neighbour
    dt: float = 1.0  # s
    horizon: int = 40  # steps in an episode

    def __check_init__(self):
        for name in ("near", "most", "start"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        check_range("noise", self.noise, 0, 1e6)

    @property
    def tolerances(self):
        return (Tolerance(self.plant.states[0].name, "1", self.near),)

    def reset(self, key):
        k_x, k_noise = jax.random.split(key)
        x = self.start * jax.random.uniform(k_x, (self.agents, 1), minval=-1.0)
        x = x - jnp.mean(x, axis=0, keepdims=True)
        return State(x=x, scenario=Hearing(jax.random.key_data(k_noise)), t=jnp.asarray(0))

    def heard(self, state: State) -> Float[Array, "agent agent"]:
        """x_j - x_i as agent i hears it of j."""
        gap = state.x[None, :, 0] - state.x[:, None, 0]
        if self.noise:
            gap = gap + self.noise * noise(state.scenario.seed, state.t, gap.shape)
        return gap

    def observe(self, state, links):
        """The differences to its neighbours, and nothing else: no agent knows the mean."""
        own = jnp.zeros((self.agents, 0))
        return beside(own, self.heard(state)[..., None], jnp.asarray(self.slots), links)

    def observation_entries(self):
        return beside_entries((), (Entry("number of {j} - own number"),), self.slots.shape[1])

    def errors(self, state):
        return state.x

    def costs(self, state, action):
        return state.x[:, 0] ** 2

    def failed(self, state):
        return ~jnp.all(jnp.abs(state.x) <= self.most)

    @property
    def edge_cost(self):
        return self.near**2

    @property
    def failure_cost(self):
        return 100.0

    def at_target(self, state):
        return eqx.tree_at(lambda s: s.x, state, jnp.zeros_like(state.x))

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.agents, 1))}
