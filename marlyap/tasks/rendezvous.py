"""Rendezvous (section 4): all agents must meet at a target that only the leaders see."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.errors import UserError, check_range
from marlyap.games.dynamics import AbstractDynamics, Unicycle
from marlyap.games.planar import AbstractPlanar, Goals
from marlyap.types import Key, State


class Rendezvous(AbstractPlanar):
    """Agents start at rest anywhere in a square and end within `radius` of one target.

    The target is drawn anew each episode, or followers could learn it by heart. The cost of an
    agent is its distance to the target (m), plus `rest_weight` (v^2 + omega^2).
    """

    agents: int = 3  # N
    leaders: tuple[int, ...] = (0,)  # the agents that see the target
    graph: str = "complete"  # complete, path, ring, star, geometric:R, disk:R or edges like 0-1,1-2
    radius: float = 0.1  # an agent has arrived when it is this close (m)
    size: float = 1.0  # starts and targets are uniform in [-size, size]^2 (m)
    headings: bool = False  # whether neighbours' headings are seen
    rest_weight: float = 0.0  # of the squared rates in the cost, so that agents come to rest
    dt: float = 0.1  # s
    horizon: int = 40  # steps in an episode
    dynamics: AbstractDynamics = Unicycle()  # how an agent moves, the same for all

    def __check_init__(self):
        if not 0 < self.size < 1e6:
            raise UserError(f"size: {self.size} m must be a positive distance in metres.")
        check_range("rest_weight", self.rest_weight, 0, 1e6)

    @property
    def displacements(self):
        return np.zeros((self.agents, 2))

    def reset(self, key):
        return scatter(self.dynamics, self.agents, self.size, key)

    def observe(self, state, links):
        return self.local_view(state, links, self.headings)

    def observation_entries(self):
        return self.local_entries(self.headings)

    def sight(self):
        return self.local_sight(self.headings)

    def costs(self, state, action):
        return with_motion(self, self.distance(state), state, self.rest_weight)


def scatter(dynamics: AbstractDynamics, agents: int, size: float, key: Key) -> State:
    """Agents at rest anywhere in [-size, size]^2, any heading, and one target in it for all."""
    k_position, k_heading, k_target = jax.random.split(key, 3)
    spread = lambda k, shape: jax.random.uniform(k, shape, minval=-size, maxval=size)
    angle = jax.random.uniform(k_heading, (agents,), minval=-jnp.pi, maxval=jnp.pi)
    x = jax.vmap(dynamics.rest)(spread(k_position, (agents, 2)), angle)
    goal = jnp.broadcast_to(spread(k_target, (2,)), (agents, 2))
    return State(x=x, scenario=Goals(goal), t=jnp.asarray(0))


def with_motion(
    game: AbstractPlanar, distance: Float[Array, "agent"], state: State, weight: float
) -> Float[Array, "agent"]:
    """distance + weight (v^2 + omega^2): without the second term, motion at the goal is free."""
    return distance + weight * game.motion(state) if weight else distance
