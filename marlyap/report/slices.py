"""V around the target set: over the places of one agent, the others resting on theirs."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from marlyap import graph as graphs
from marlyap.certificates.lyapunov import CostSum
from marlyap.games.game import AbstractRegulation
from marlyap.games.planar import AbstractPlanar
from marlyap.report.data import Slice


REACH = 1.5  # half the side of a slice, in the unit of the game's distance


def slices(
    game: AbstractRegulation, V: CostSum, level: float | None, run: str = ""
) -> tuple[Slice, ...]:
    """V around a leader, and around the agent that is farthest from all leaders.

    Only robots in the plane have places that V can be drawn over.
    """
    if not isinstance(game, AbstractPlanar):
        return ()
    hops = graphs.hops(game.adjacency, game.informed)
    agents = sorted({int(np.argmin(hops)), int(np.argmax(hops))})
    return tuple(slice_of(game, V, agent, level, run=run) for agent in agents)


def slice_of(
    game: AbstractPlanar,
    V: CostSum,
    agent: int,
    level: float | None,
    side: int = 41,
    run: str = "",
) -> Slice:
    """V where one agent rests beside the goal and all others on it."""
    grid = np.linspace(-REACH, REACH, side)
    values = np.asarray(_plane(game, V, np.asarray(agent), grid))
    known = level is not None and np.min(values) < level < np.max(values)
    return Slice(
        label=f"agent {agent}, {'a leader' if game.leads[agent] else 'a follower'}",
        values=values,
        reach=REACH,
        radius=game.edge,
        unit=game.unit,
        level=level if known else None,
        facing="psi" in game.dynamics.names,
        run=run,
    )


@eqx.filter_jit
def _plane(game: AbstractPlanar, V: CostSum, agent: Any, grid: Any) -> jax.Array:
    """V [y, x] with one agent at (x, y) from its goal, facing along x."""
    rest = game.at_target(game.reset(jax.random.key(0)))
    if "psi" in game.dynamics.names:
        rest = eqx.tree_at(lambda s: s.x, rest, rest.x.at[:, 2].set(0.0))

    def at(x, y):
        moved = rest.x.at[agent, :2].add(jnp.stack([x, y]))
        return V.value(game, eqx.tree_at(lambda s: s.x, rest, moved))

    row = lambda y: jax.vmap(lambda x: at(x, y))(jnp.asarray(grid))
    return jax.lax.map(row, jnp.asarray(grid))
