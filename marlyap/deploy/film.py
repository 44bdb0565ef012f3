"""An episode of a swarm as a film."""

from typing import Any

import numpy as np

from marlyap.deploy.swarm import Episode
from marlyap.deploy.team import distances
from marlyap.report.data import Film, Frames


def film(contract: dict[str, Any], played: Episode, number: int) -> Film:
    """One episode, seen from above."""
    roles, heading = contract["roles"], contract["sight"]["heading"]
    index = {r["name"]: r["index"] for r in roles}
    links = {tuple(sorted((r["index"], index[n]))) for r in roles for n in r["neighbours"] if n}
    time, away = len(played.x), distances(played.x, played.goal)
    psi = None if heading is None else played.x[..., heading]
    frames = Frames(
        times=np.arange(time) * contract["timing"]["period"],
        positions=played.x[..., :2],
        headings=None if psi is None else np.stack([np.cos(psi), np.sin(psi)], -1),
        goals=np.broadcast_to(played.goal, (time, *played.goal.shape)),
        leaders=tuple(r["leads"] and not all(q["leads"] for q in roles) for r in roles),
        links=(tuple((a, b) for a, b in sorted(links)),),
        edge=contract["domain"]["edge"],
        unit="m",
    )
    return Film(
        frames=frames,
        label=f"separate processes, start {number}",
        start=str(number),
        distance=away.max(axis=1),
        edge=contract["domain"]["edge"],
        unit="m",
        level=away[:, played.alive].max(axis=1),
        level_name="distance",
        success=played.success,
    )
