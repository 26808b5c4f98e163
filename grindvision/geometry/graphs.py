"""Shortest ways along graphs whose edges have lengths (Dijkstra's algorithm, SciPy's)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def edge_graph(starts: Integers, ends: Integers, lengths: Floats, count: int) -> csr_matrix:
    """Graph of ``count`` nodes with edges (E,) between them, which lead both ways."""
    return csr_matrix((lengths, (starts, ends)), shape=(count, count))


def walking_distances(graph: csr_matrix, start: int) -> Floats:
    """Length (N,) of the shortest way from node ``start`` to each node; infinite where none leads there."""
    return np.asarray(dijkstra(graph, directed=False, indices=start))


def farthest(distances: Floats) -> int:
    """The farthest node of those that are reached."""
    return int(np.where(np.isfinite(distances), distances, -1).argmax())


def shortest_way(graph: csr_matrix, start: int, end: int) -> Integers:
    """Nodes (M,) of the shortest way from ``start`` to ``end``, which must be joined."""
    before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)[1]
    way = [end]
    while way[-1] != start:
        way.append(int(before[way[-1]]))
    return np.array(way[::-1])
