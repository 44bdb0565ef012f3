"""Interaction graphs: the named ones by hand, any other against scipy and by their laws."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.sparse.csgraph import connected_components, shortest_path

from marlyap.errors import UserError
from marlyap.graph import NAMED, adjacency, disk_radius, hops, neighbours, room


def edges(linked):
    return {(int(a), int(b)) for a, b in np.argwhere(linked) if a < b}


@pytest.mark.parametrize(
    ("graph", "n", "want"),
    [
        ("complete", 4, {(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)}),
        ("path", 4, {(0, 1), (1, 2), (2, 3)}),
        ("ring", 4, {(0, 1), (1, 2), (2, 3), (0, 3)}),
        ("ring", 3, {(0, 1), (1, 2), (0, 2)}),
        ("ring", 2, {(0, 1)}),
        ("star", 4, {(0, 1), (0, 2), (0, 3)}),
        ("disk:0.8", 3, {(0, 1), (0, 2), (1, 2)}),
        ("0-1,1-2,1-3", 4, {(0, 1), (1, 2), (1, 3)}),
        (" 3 - 1, 2-1 ,1-0, 0-1", 4, {(0, 1), (1, 2), (1, 3)}),
        ("0-10,10-9,9-8,8-7,7-6,6-5,5-4,4-3,3-2,2-1", 11,
         {(0, 10), *((i, i + 1) for i in range(1, 10))}),
    ],
)  # fmt: skip
def test_graphs_by_hand(graph, n, want):
    linked = adjacency(graph, n)
    assert linked.dtype == bool and linked.shape == (n, n)
    assert edges(linked) == want
    np.testing.assert_array_equal(linked, linked.T)
    assert not linked.diagonal().any()


@pytest.mark.parametrize("graph", [*NAMED, "geometric:1.5", "disk:1"])
@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_named_graphs_are_connected(graph, n):
    linked = adjacency(graph, n)
    np.testing.assert_array_equal(linked, linked.T)
    assert not linked.diagonal().any()
    assert connected_components(linked)[0] == 1


@pytest.mark.parametrize(
    ("graph", "n", "says"),
    [
        (
            "tree",
            3,
            r"^graph: 'tree' is none of complete, path, ring, star, geometric:RADIUS, disk:RADIUS",
        ),
        ("", 3, r"^graph: '' is none of"),
        ("0-1,", 3, r"^graph: '0-1,' is none of"),
        ("0-1;1-2", 3, r"^graph: .* is none of"),
        ("0--1", 3, r"^graph: .* is none of"),
        ("Complete", 3, r"^graph: 'Complete' is none of"),
        ("0-1,1-3", 3, r"^graph: edge 1-3 must join two different agents among 0 to 2\."),
        ("0-1,1-1,1-2", 3, r"^graph: edge 1-1 must join two different"),
        ("0-1", 3, r"^graph: '0-1' is not connected \(no path from agent 0 to agent 2\)"),
        ("0-1,2-3", 4, r"^graph: .*no path from agent 0 to agent 2\); add an edge"),
        ("disk:", 3, r"^graph: 'disk:' needs a positive radius in metres, as in disk:0\.8"),
        ("disk:x", 3, r"^graph: 'disk:x' needs a positive radius"),
        ("disk:0", 3, r"^graph: 'disk:0' needs a positive radius"),
        ("disk:-1", 3, r"^graph: 'disk:-1' needs a positive radius"),
        ("disk:nan", 3, r"^graph: 'disk:nan' needs a positive radius"),
        ("geometric:-1", 3, r"^graph: 'geometric:-1' needs a positive radius .* geometric:0\.8"),
        ("geometric:1e-6", 3, r"^graph: .*no path from agent 0 to agent 1\); take a larger radius"),
        ("disk:inf", 3, r"^graph: 'disk:inf' needs a positive radius"),
        ("9999999-0", 3, r"^graph: .* is none of"),
        ("path/0", 3, r"^graph: 'path/0' needs a whole number from 1 to 9999 after the /"),
        ("path/", 3, r"^graph: 'path/' needs a whole number"),
        ("disk:1/x", 3, r"^graph: 'disk:1/x' needs a whole number"),
        ("/2", 3, r"^graph: '' is none of"),
    ],
)
def test_bad_graphs_are_named(graph, n, says):
    with pytest.raises(UserError, match=says):
        adjacency(graph, n)


def test_a_geometric_graph_is_that_of_points_in_a_square():
    """A larger radius only adds edges, beyond the diagonal there are all; their share is known."""
    nested = [adjacency(f"geometric:{r}", 64) for r in (0.25, 0.4, 0.8, 1.5)]
    for fewer, more in zip(nested, nested[1:], strict=False):
        assert (fewer <= more).all() and fewer.sum() < more.sum()
    assert edges(nested[-1]) == edges(adjacency("complete", 64))
    assert not nested[0].diagonal().any() and (nested[0] == nested[0].T).all()
    share = adjacency("geometric:0.1", 1000).sum() / (1000 * 999)
    # The distribution of the distance of two points in a unit square, up to 1.
    assert share == pytest.approx(np.pi * 0.1**2 - 8 / 3 * 0.1**3 + 0.1**4 / 2, rel=0.05)
    assert neighbours(nested[0], room("geometric:0.25/8")).shape == (64, 8)


def test_disk_radius():
    assert disk_radius("disk:0.8") == 0.8
    assert disk_radius("complete") is None
    assert disk_radius("disk:0.8/2") == 0.8


def test_room_for_neighbours():
    """What is observed has one size; who is linked does not change."""
    assert room("path") is None and room("disk:0.8/12") == 12
    for name in ("complete", "path", "0-1,1-2,2-3"):
        np.testing.assert_array_equal(adjacency(name + "/2", 4), adjacency(name, 4))
    table = neighbours(adjacency("complete", 4), 2)
    np.testing.assert_array_equal(table, [[1, 2], [0, 2], [0, 1], [0, 1]])
    table = neighbours(adjacency("path", 3), 3)
    np.testing.assert_array_equal(table, [[1, -1, -1], [0, 2, -1], [1, -1, -1]])


def test_neighbours_are_in_order_and_padded():
    table = neighbours(adjacency("0-1,1-2,1-3,3-4", 5))
    np.testing.assert_array_equal(
        table, [[1, -1, -1], [0, 2, 3], [1, -1, -1], [1, 4, -1], [3, -1, -1]]
    )
    assert neighbours(adjacency("complete", 1)).shape == (1, 0)


@st.composite
def any_graph(draw):
    """(n, edges), connected or not."""
    n = draw(st.integers(2, 9))
    pair = st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)).filter(lambda e: e[0] != e[1])
    return n, draw(st.lists(pair, min_size=1, max_size=14))


@settings(max_examples=200, deadline=None)
@given(any_graph())
def test_edge_lists_are_read_or_refused_as_scipy_says(sample):
    n, pairs = sample
    text = ",".join(f"{a}-{b}" for a, b in pairs)
    want = np.zeros((n, n), bool)
    for a, b in pairs:
        want[a, b] = want[b, a] = True
    if connected_components(want)[0] > 1:
        with pytest.raises(UserError, match="^graph: .*not connected"):
            adjacency(text, n)
    else:
        np.testing.assert_array_equal(adjacency(text, n), want)


@settings(max_examples=200, deadline=None)
@given(any_graph(), st.data())
def test_hops_are_shortest_paths(sample, data):
    n, pairs = sample
    linked = np.zeros((n, n), bool)
    for a, b in pairs:
        linked[a, b] = linked[b, a] = True
    leaders = tuple(data.draw(st.sets(st.integers(0, n - 1), min_size=1)))
    want = shortest_path(linked, unweighted=True)[list(leaders)].min(0)
    np.testing.assert_array_equal(hops(linked, leaders), np.where(np.isinf(want), -1, want))


@settings(max_examples=100, deadline=None)
@given(any_graph())
def test_neighbours_say_the_same_as_the_adjacency(sample):
    n, pairs = sample
    linked = np.zeros((n, n), bool)
    for a, b in pairs:
        linked[a, b] = linked[b, a] = True
    table = neighbours(linked)
    assert table.shape == (n, linked.sum(1).max())
    for i, row in enumerate(table):
        there = row[row >= 0]
        np.testing.assert_array_equal(there, np.flatnonzero(linked[i]))
        assert (row[len(there) :] == -1).all()


def test_hops_by_hand():
    path = adjacency("path", 5)
    np.testing.assert_array_equal(hops(path, (0,)), [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(hops(path, (1, 4)), [1, 0, 1, 1, 0])
