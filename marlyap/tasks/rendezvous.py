"""Rendezvous (section 4): all agents must meet at a target that only the leaders see."""

import jax
import jax.numpy as jnp

from marlyap.dynamics import AbstractDynamics, Unicycle
from marlyap.errors import UserError
from marlyap.game import AbstractGame
from marlyap.sensing import body_frame
from marlyap.types import State


class Rendezvous(AbstractGame):
    """Agents start at rest anywhere in a square and end within `radius` of one target.

    The target is drawn anew each episode, or followers could learn it by heart. The cost of an
    agent is its distance to the target (m).
    """

    agents: int = 3  # N
    leaders: tuple[int, ...] = (0,)  # the agents that see the target
    graph: str = "complete"  # complete, path, ring, star, disk:RADIUS or edges such as 0-1,1-2
    radius: float = 0.1  # an agent has arrived when it is this close (m)
    size: float = 1.0  # starts and targets are uniform in [-size, size]^2 (m)
    headings: bool = False  # whether neighbours' headings are seen
    dt: float = 0.1  # s
    horizon: int = 40  # steps in an episode
    dynamics: AbstractDynamics = Unicycle()

    def __check_init__(self):
        if not 0 < self.size < 1e6:
            raise UserError(f"size: {self.size} m must be a positive distance in metres.")

    def reset(self, key):
        k_position, k_heading, k_target = jax.random.split(key, 3)
        n = self.agents
        spread = lambda k, shape: jax.random.uniform(k, shape, minval=-self.size, maxval=self.size)
        angle = jax.random.uniform(k_heading, (n,), minval=-jnp.pi, maxval=jnp.pi)
        x = jax.vmap(self.dynamics.rest)(spread(k_position, (n, 2)), angle)
        goal = jnp.broadcast_to(spread(k_target, (2,)), (n, 2))
        return State(x=x, goal=goal, t=jnp.asarray(0))

    def observe(self, state):
        slots, leads = jnp.asarray(self.slots), jnp.asarray(self.leads)
        return body_frame(self.dynamics, state, slots, self.linked(state), leads, self.headings)
