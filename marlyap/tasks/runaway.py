"""Rendezvous of agents that are unstable by themselves: who is too fast is lost for good."""

import jax.numpy as jnp
import numpy as np

from marlyap.errors import check_range
from marlyap.games.dynamics import AbstractDynamics, UnstablePoint
from marlyap.games.planar import AbstractPlanar
from marlyap.tasks.rendezvous import scatter


class Runaway(AbstractPlanar):
    """Point masses with v' = growth v + u meet at one target that only the leaders see.

    They start at rest anywhere in a square. Beyond |v| = limit / growth on an axis (2 m/s) no input
    brings a velocity back, so that a policy without fault near the target may lose agents that
    start far from it, or after a push. The cost of an agent is its distance to the target (m). A
    team has failed once an agent is farther off than `lost`.
    """

    agents: int = 3  # N
    leaders: tuple[int, ...] = (0,)  # the agents that see the target
    graph: str = "complete"  # complete, path, ring, star, geometric:R, disk:R or edges like 0-1,1-2
    radius: float = 0.1  # an agent has arrived when it is this close (m)
    size: float = 1.0  # starts and targets are uniform in [-size, size]^2 (m)
    lost: float = 20.0  # an agent this far from the target is lost (m)
    dt: float = 0.1  # s
    horizon: int = 40  # steps in an episode
    dynamics: AbstractDynamics = UnstablePoint()  # how an agent moves, the same for all

    def __check_init__(self):
        check_range("size", self.size, 0, 1e6, open=True)
        check_range("lost", self.lost, 3 * self.size, 1e6, open=True)

    @property
    def displacements(self):
        return np.zeros((self.agents, 2))

    def reset(self, key):
        return scatter(self.dynamics, self.agents, self.size, key)

    def observe(self, state, links):
        return self.local_view(state, links)

    def observation_entries(self):
        return self.local_entries()

    def failed(self, state):
        return jnp.any(self.distance(state) > self.lost)

    @property
    def failure_cost(self):
        return 2 * self.lost
