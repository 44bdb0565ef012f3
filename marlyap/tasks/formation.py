"""Formation: the agents take their places on a circle round a centre that only leaders see."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.errors import UserError, check_range
from marlyap.games.dynamics import AbstractDynamics, Unicycle
from marlyap.games.planar import AbstractPlanar, Goals
from marlyap.tasks.rendezvous import scatter, with_motion
from marlyap.types import State


class Formation(AbstractPlanar):
    """Agent i ends within `radius` of its place; a leader sees its own place.

    The formation is turned by a random angle each episode, so followers must read it off the
    others.
    """

    agents: int = 3  # N
    leaders: tuple[int, ...] = (0, 1)  # the agents that see their place
    graph: str = "complete"  # complete, path, ring, star, geometric:R, disk:R or edges like 0-1,1-2
    spread: float = 0.5  # radius of the circle on which the places lie (m)
    radius: float = 0.1  # an agent has arrived when it is this close to its place (m)
    size: float = 1.0  # starts and centres are uniform in [-size, size]^2 (m)
    headings: bool = False  # whether neighbours' headings are seen
    rest_weight: float = 0.0  # of the squared rates in the cost, so that agents come to rest
    clearance: float = 0.0  # agents closer than this to another one violate it (m)
    dt: float = 0.1  # s
    horizon: int = 40  # steps in an episode
    dynamics: AbstractDynamics = Unicycle()  # how an agent moves, the same for all

    def __check_init__(self):
        if not 0 < self.spread < 1e6:
            raise UserError(f"spread: {self.spread} m must be a positive distance in metres.")
        check_range("rest_weight", self.rest_weight, 0, 1e6)
        check_range("clearance", self.clearance, 0, 1e6)

    def reset(self, key):
        k_start, k_turn = jax.random.split(key)
        start = scatter(self.dynamics, self.agents, self.size, k_start)
        turn = jax.random.uniform(k_turn, (), minval=-jnp.pi, maxval=jnp.pi)
        return State(x=start.x, scenario=Goals(start.scenario.goal + self.places(turn)), t=start.t)

    def places(self, turn: Float[Array, ""]) -> Float[Array, "agent 2"]:
        """Offsets of the agents' places from the centre (m)."""
        angle = turn + 2 * jnp.pi * jnp.arange(self.agents) / self.agents
        return self.spread * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)

    def observe(self, state, links):
        return self.local_view(state, links, self.headings)

    def observation_entries(self):
        return self.local_entries(self.headings)

    def sight(self):
        return self.local_sight(self.headings)

    def costs(self, state, action):
        return with_motion(self, self.distance(state), state, self.rest_weight)

    def violations(self, state):
        return self.crowded(state, self.clearance)
