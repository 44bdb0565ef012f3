"""Formation of point masses on a polygon, by the displacements between neighbours."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from marlyap.errors import check_range
from marlyap.games.dynamics import AbstractDynamics, DoubleIntegrator
from marlyap.games.planar import AbstractPlanar, Goals
from marlyap.games.sensing import body_frame, body_frame_entries
from marlyap.tasks.rendezvous import scatter


class DisplacementFormation(AbstractPlanar):
    """Agents take their places on a regular polygon round a centre that only leaders know.

    All share a compass and know the displacements d_i - d_j between their places, so that
    q_i = p_i - d_i have to meet: displacement-based control (Ren and Beard, Distributed Consensus
    in Multi-vehicle Cooperative Control, 2008; Oh, Park and Ahn, Automatica 53, 2015). The cost of
    an agent is |goal - p|^2 + 0.1 |v|^2 + 0.01 |a|^2.
    """

    agents: int = 5  # N
    leaders: tuple[int, ...] = (0,)  # the agents that see their place
    graph: str = "path"  # complete, path, ring, star, geometric:R, disk:R or edges like 0-1,1-2
    spread: float = 0.5  # radius of the circle on which the places lie (m)
    radius: float = 0.1  # an agent has arrived when it is this close to its place (m)
    size: float = 1.0  # starts and centres are uniform in [-size, size]^2 (m)
    rest_weight: float = 0.1  # of the squared velocity in the cost
    effort: float = 0.01  # weight of the squared action in the cost
    clearance: float = 0.0  # agents closer than this to another one violate it (m)
    dt: float = 0.1  # s
    horizon: int = 100  # steps in an episode
    dynamics: AbstractDynamics = DoubleIntegrator()  # how an agent moves, the same for all

    def __check_init__(self):
        for name in ("spread", "size"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("rest_weight", "effort", "clearance"):
            check_range(name, getattr(self, name), 0, 1e6)

    @property
    def places(self) -> Float[np.ndarray, "agent 2"]:
        """d_i, from the centre to each agent's place (m); the first lies ahead of it."""
        angle = 2 * np.pi * np.arange(self.agents) / self.agents
        return self.spread * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    @property
    def displacements(self):
        return self.places

    def reset(self, key):
        start = scatter(self.dynamics, self.agents, self.size, key)
        return replace(start, scenario=Goals(start.scenario.goal + self.places))

    def observe(self, state, links):
        """As in a rendezvous of q_i = p_i - d_i."""
        d, slots, leads = jnp.asarray(self.places, state.x.dtype), self.slots, self.leads
        q, centre = state.x.at[:, :2].add(-d), self.goals(state) - d
        where = jnp.asarray(slots), links, jnp.asarray(leads), self.radius
        return body_frame(self.dynamics, q, centre, *where, headings=False)

    def observation_entries(self):
        entries = body_frame_entries(self.dynamics, self.slots.shape[1], headings=False)
        off = lambda name: name.replace("own position", "own position - displacement")
        return tuple(e._replace(name=off(e.name)) for e in entries)

    def sight(self):
        return self.local_sight()._replace(places=self.places)

    def costs(self, state, action):
        effort = jnp.sum(jnp.clip(action, -1.0, 1.0) ** 2, axis=1)
        gap = jnp.sum((self.goals(state) - self.positions(state)) ** 2, axis=1)
        return gap + self.rest_weight * self.motion(state) + self.effort * effort

    @property
    def edge_cost(self):
        return self.radius**2

    def farther(self, state, factor):
        """The start with every agent `factor` times as far from its place."""
        goal = self.goals(state)
        away = goal + factor * (self.positions(state) - goal)
        return eqx.tree_at(lambda s: s.x, state, state.x.at[:, :2].set(away))

    def violations(self, state):
        return self.crowded(state, self.clearance)
