"""The interaction graph G = <I, E> of section 2.1: undirected, connected, written as text.

complete | path | ring | star      named graphs on n agents
geometric:0.3                      n points drawn once in a unit square, the same for every n, and
                                   edges between those closer than 0.3
disk:0.8                           neighbours are those closer than 0.8 m at this instant
0-1,1-2,1-3                        any edge list
complete/8                         any of these, of which an agent observes 8 neighbours: the first
                                   by number, with empty places where it has fewer, so that the
                                   size of an observation does not depend on how many agents there
                                   are
"""

import re

import numpy as np
from jaxtyping import Bool, Int

from marlyap.errors import UserError
from marlyap.threefry import uniform


NAMED = ("complete", "path", "ring", "star")


def adjacency(graph: str, n: int) -> Bool[np.ndarray, "agent agent"]:
    """Which pairs may interact. For `disk:R` all pairs may; distance then decides at each step.

    Raises UserError for an unknown graph, a bad edge, or a graph that is not connected.
    """
    room(graph)
    graph = graph.partition("/")[0]
    i = np.arange(n)
    gap = np.abs(i[:, None] - i[None, :])
    if graph == "complete" or disk_radius(graph) is not None:
        return gap > 0
    if graph == "path":
        return gap == 1
    if graph == "ring":
        return (gap == 1) | ((gap == n - 1) & (gap > 0))
    if graph == "star":
        return (gap > 0) & ((i[:, None] == 0) | (i[None, :] == 0))
    linked, within = np.zeros((n, n), bool), _radius(graph, "geometric")
    if within is None:
        for a, b in _edges(graph, n):
            linked[a, b] = linked[b, a] = True
    else:
        p = uniform((np.zeros(1, np.uint32), np.array([n], np.uint32)), n, 2)[0]
        linked = (np.linalg.norm(p[:, None] - p[None, :], axis=-1) < within) & (gap > 0)
    apart = np.flatnonzero(hops(linked, (0,)) < 0)
    if apart.size:
        raise UserError(
            f"graph: '{graph}' is not connected (no path from agent 0 to agent {apart[0]}); "
            f"{'add an edge that joins them' if within is None else 'take a larger radius'}."
        )
    return linked


def disk_radius(graph: str) -> float | None:
    """The radius R (m) of `disk:R`, None for every other graph."""
    return _radius(graph, "disk")


def room(graph: str) -> int | None:
    """The k of `GRAPH/k`: how many neighbours an observation has places for; None: for all."""
    _, slash, places = graph.partition("/")
    if slash and not re.fullmatch(r"[1-9]\d{0,3}", places):
        raise UserError(
            f"graph: '{graph}' needs a whole number from 1 to 9999 after the /, as in complete/8."
        )
    return int(places) if slash else None


def neighbours(
    linked: Bool[np.ndarray, "agent agent"], places: int | None = None
) -> Int[np.ndarray, "agent slot"]:
    """The neighbours of each agent in ascending order, padded with -1 to the largest degree.

    With a number of `places`, the first neighbours, padded with -1 to that number.
    """
    rows = [np.flatnonzero(row)[:places] for row in linked]
    most = max((len(r) for r in rows), default=0)
    table = np.full((len(rows), most if places is None else places), -1)
    for i, row in enumerate(rows):
        table[i, : len(row)] = row
    return table


def hops(
    linked: Bool[np.ndarray, "agent agent"], leaders: tuple[int, ...]
) -> Int[np.ndarray, "agent"]:
    """Edges from each agent to its nearest leader, -1 where there is no path."""
    distance = np.full(len(linked), -1)
    frontier = np.unique(np.array(leaders, int))
    step = 0
    while frontier.size:
        distance[frontier] = step
        step += 1
        frontier = np.flatnonzero(linked[frontier].any(0) & (distance < 0))
    return distance


def _radius(graph: str, name: str) -> float | None:
    """The number after `name:`, None where the graph is another one."""
    start, colon, rest = graph.partition(":")
    if start != name or not colon:
        return None
    try:
        radius = float(rest.partition("/")[0])
    except ValueError:
        radius = -1.0
    if not 0 < radius < np.inf:
        raise UserError(f"graph: '{graph}' needs a positive radius in metres, as in {name}:0.8.")
    return radius


def _edges(graph: str, n: int) -> list[tuple[int, int]]:
    pairs = [re.fullmatch(r"\s*(\d{1,6})\s*-\s*(\d{1,6})\s*", e) for e in graph.split(",")]
    if not graph or any(p is None for p in pairs):
        raise UserError(
            f"graph: '{graph}' is none of {', '.join(NAMED)}, geometric:RADIUS, "
            "disk:RADIUS or an edge list such as 0-1,1-2."
        )
    edges = [(int(p[1]), int(p[2])) for p in pairs if p]
    for a, b in edges:
        if a == b or max(a, b) >= n:
            raise UserError(
                f"graph: edge {a}-{b} must join two different agents among 0 to {n - 1}."
            )
    return edges
