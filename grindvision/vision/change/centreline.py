"""The rough centreline of a bead: its cells walked from one end, cut into bands of equal walking distance, in order.

The bands tell an open bead from a closed one and from one that branches.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from grindvision.errors import DegenerateError, TooSmallError
from grindvision.geometry.graphs import walking_distances
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import Neighbourhoods, within_radius
from grindvision.vision.change.pieces import Cluster
from grindvision.vision.surface.clustering import euclidean_clusters

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def bead_centreline(cluster: Cluster) -> tuple[Floats, bool, float]:
    """Rough ordered curve (M, 3) along the cluster, whether it is closed, and the bead's width in mm.

    Raises:
        TooSmallError: too few points. DegenerateError: the bead branches.
    """
    core = cluster.signed_mm > 0.35 * cluster.peak_mm
    if core.sum() < 12:
        raise TooSmallError(f"the bead has only {int(core.sum())} points; too few to follow its ridge, scan it denser")
    size = cluster.spacing_mm
    points = cluster.points[core]
    grid = build_cells(points, size)
    cells = np.repeat(np.arange(len(grid.starts) - 1), np.diff(grid.starts))
    weight = cluster.signed_mm[core][grid.order]
    total = np.bincount(cells, weight)
    nodes = np.column_stack([np.bincount(cells, weight * points[grid.order, k]) / total for k in range(3)])
    step = 2.6 * size  # the means of thinly filled cells stand farther apart than their points
    main = euclidean_clusters(nodes, step) == 0
    nodes, total = nodes[main], total[main]
    around = within_radius(build_cells(nodes, step), nodes, step)
    graph = csr_matrix((np.sqrt(around.squared_mm2), around.indices, around.starts), shape=(len(nodes),) * 2)
    end = int(np.argmax(walking_distances(graph, 0)))
    walked = walking_distances(graph, end)
    area = len(nodes) * size**2 / 1.5
    reach = float(walked.max())
    width = max(area / max(reach, size), 1.5 * size)
    if reach < 2.5 * width:
        return _axis(nodes, total), False, max(float(np.sqrt(area) / 1.5), 1.5 * size)
    # no step leads past a whole band, or a straight bead would seem to branch
    bands = np.minimum((walked / max(1.2 * width, step)).astype(np.int64), 10_000)
    curve, closed = _ordered(around, nodes, total, bands, step)
    if closed:
        return _counterclockwise(curve, cluster.normals.mean(axis=0)), True, max(width / 2, 1.5 * size)
    return curve, False, width


def _axis(nodes: Floats, weights: Floats) -> Floats:
    """Ends of a compact piece along its longest principal axis."""
    middle = np.average(nodes, axis=0, weights=weights)
    _, _, axes = np.linalg.svd(nodes - middle, full_matrices=False)
    along = (nodes - middle) @ axes[0]
    return _directed(middle + np.linspace(along.min(), along.max(), 5)[:, None] * axes[0])


def _ordered(
    around: Neighbourhoods, nodes: Floats, weights: Floats, bands: Integers, step_mm: float
) -> tuple[Floats, bool]:
    """Centroids of the connected pieces of each band of equal walking distance, in order along the bead."""
    piece = np.empty(len(nodes), dtype=np.int64)
    number = 0
    for band in np.unique(bands):
        members = np.flatnonzero(bands == band)
        piece[members] = number + euclidean_clusters(nodes[members], step_mm)
        number = int(piece[members].max()) + 1
    places: Floats = np.column_stack([np.bincount(piece, weights * nodes[:, k], number) for k in range(3)])
    places = places / np.bincount(piece, weights, number)[:, None]
    amounts = np.bincount(piece, minlength=number)
    links: list[set[int]] = [set() for _ in range(number)]
    pairs = np.unique(np.repeat(piece, np.diff(around.starts)) * number + piece[around.indices])
    for a, b in zip(*np.divmod(pairs, number), strict=True):
        if a != b:
            links[a].add(int(b))
    _prune(links, amounts)
    alive = [at for at in range(number) if links[at]]
    forks = [at for at in alive if len(links[at]) > 2]
    if forks:
        x, y, z = places[forks[0]]
        raise DegenerateError(
            f"the bead branches near ({x:.1f}, {y:.1f}, {z:.1f}) mm; grind one branch first, or cut the test scan so"
            " that each bead is by itself"
        )
    leaves = [at for at in alive if len(links[at]) == 1]
    order = [min(leaves, key=lambda at: places[at, 0]) if leaves else min(alive, key=lambda at: places[at, 0])]
    previous = -1
    while True:
        ahead = [at for at in sorted(links[order[-1]]) if at != previous and (len(order) < 3 or at != order[0])]
        ahead = [at for at in ahead if at not in order]
        if not ahead:
            break
        previous = order[-1]
        order.append(ahead[0])
    return (places[order], True) if not leaves else (_directed(places[order]), False)


def _prune(links: list[set[int]], amounts: Integers) -> None:
    """Drop stubs: leaves beside a fork that hold less than half of what an ordinary piece holds."""
    usual = np.median(amounts[[at for at in range(len(links)) if links[at]]])
    while True:
        stubs = [
            at
            for at in range(len(links))
            if len(links[at]) == 1 and amounts[at] < 0.5 * usual and len(links[next(iter(links[at]))]) > 2
        ]
        if not stubs:
            return
        stub = min(stubs, key=lambda at: (amounts[at], at))
        links[links[stub].pop()].discard(stub)


def _counterclockwise(places: Floats, normal: Floats) -> Floats:
    """Places (M, 3) of a closed curve, from the same first one, in the sense that turns about ``normal`` (3,)."""
    spokes = places - places.mean(axis=0)
    area = np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0) @ normal
    return places if area > 0 else np.roll(places[::-1], 1, axis=0)


def _directed(places: Floats) -> Floats:
    return places if places[0, 0] <= places[-1, 0] else places[::-1]
