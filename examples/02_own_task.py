"""Your own task in one file: the team gathers in a corner that only its leader knows.

From the command line: marlyap train examples/02_own_task.py:Corner masac
"""

import jax
import jax.numpy as jnp

from marlyap import MASAC, AbstractPlanar, Goals, Schedule, State, Unicycle, evaluate, train
from marlyap.games.dynamics import AbstractDynamics
from marlyap.tasks.rendezvous import scatter


class Corner(AbstractPlanar):
    """The goal is one of the four corners; only agent 0 knows which one."""

    agents: int = 3
    leaders: tuple[int, ...] = (0,)  # the agents that know the corner
    graph: str = "star"
    size: float = 1.0  # half the side of the square (m)
    radius: float = 0.15  # an agent has arrived when it is this close (m)
    dt: float = 0.1  # s
    horizon: int = 40  # steps in an episode
    dynamics: AbstractDynamics = Unicycle(limits=(5.0, 5.0))

    def reset(self, key):
        k_start, k_corner = jax.random.split(key)
        start = scatter(self.dynamics, self.agents, self.size, k_start)
        corner = self.size * jax.random.rademacher(k_corner, (2,), jnp.float32)
        return State(x=start.x, scenario=Goals(jnp.tile(corner, (self.agents, 1))), t=start.t)

    def observe(self, state, links):
        return self.local_view(state, links)


if __name__ == "__main__":
    trained = train(Corner(), MASAC(), Schedule(steps=102_400), on_iteration=print)
    print(evaluate(Corner(), trained.controller).summary())
