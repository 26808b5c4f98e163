"""Path points along the ridge of a bead (ours, in place of section 3.6's boxes).

The pieces of the difference are ordered along themselves by the distance walked on them from one end; that also tells
an open bead from a closed one and from one that branches. The ridge is where the height over the good surface is
greatest across the bead: the vertex of a parabola fitted across, which uneven sampling does not pull aside as it does a
centroid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry.neighbours import build_cells, within_radius
from grindvision.vision.difference import Cluster

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class BeadPath:
    """Path of one bead, frame of the test scan.

    ``points`` (n, 3) on the ridge and unit ``normals`` (n, 3) of the good surface there, pointing off the part;
    ``ridge`` (M, 3) the whole curve; ``closed`` whether it comes back to its start; ``length_mm``, ``width_mm`` at half
    height, ``height_mm`` of the ridge over the good surface (median).
    """

    points: Floats
    normals: Floats
    ridge: Floats
    closed: bool
    length_mm: float
    width_mm: float
    height_mm: float

    def __str__(self) -> str:
        shape = "closed" if self.closed else "open"
        size = f"{self.length_mm:.1f} mm long, {self.width_mm:.1f} wide, {self.height_mm:.2f} high"
        return f"{shape} bead, {size}: {len(self.points)} points"

    def tool_axes(self) -> Floats:
        """Directions (n, 3) in which the tool points: opposite to the normals."""
        return -self.normals


def trace_bead(cluster: Cluster, points: int = 6) -> BeadPath:
    """Follow the ridge of a bead and place ``points`` on it, each in the middle of an equal part of its length.

    An open bead is walked from its end with the smaller x; a closed one from its point of smallest x, counterclockwise
    about its normal.

    Raises:
        InputError: fewer than one point. DegenerateError: the bead branches, or is too small to follow.
    """
    if points < 1:
        raise InputError(f"{points} path points asked for; at least 1 is needed")
    curve, closed, width = _walk(cluster)
    stations = _Stations(curve, closed)
    for _ in range(2):
        stations = _Stations(_smoothed(_vertices(cluster, stations, width)[0], closed), closed)
    feet, normals, heights = _vertices(cluster, stations, width)
    ridge = _Stations(feet + heights[:, None] * normals, closed)
    start, end = (0.0, ridge.length_mm) if closed else _ends(cluster, ridge)
    at = start + (end - start) * ((np.arange(points) + (0.0 if closed else 0.5)) / points)
    chosen = ridge.at(at)
    up = ridge.smooth(normals, at)
    dense = ridge.at(np.linspace(start, end, max(int((end - start) / (0.1 * width)), 2 * points, 20)))
    across = cluster.area_mm2 / max(end - start, 1e-9)
    return BeadPath(
        chosen, up, dense, closed, float(end - start), float(min(across, 10 * width)), float(np.median(heights))
    )


class _Stations:
    """A curve through ordered points (M, 3), by arc length in mm; walked in a fixed direction."""

    def __init__(self, places: Floats, closed: bool) -> None:
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        places = places[np.r_[True, steps > 1e-9]]
        if closed:
            places = np.vstack([places, places[:1]])
        self.closed = closed
        self.places = places
        self.arc = np.r_[0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))]
        self.length_mm = float(self.arc[-1])
        if len(places) > 2:
            self.curve = CubicSpline(self.arc, places, bc_type="periodic" if closed else "natural")
        else:
            self.curve = CubicSpline(self.arc, places, bc_type="natural")

    def at(self, arc: Floats) -> Floats:
        """Points (K, 3) at arc lengths (K,)."""
        return self.curve(arc)

    def tangents(self, arc: Floats) -> Floats:
        """Unit tangents (K, 3) at arc lengths (K,)."""
        slope = self.curve(arc, 1)
        return slope / np.linalg.norm(slope, axis=1, keepdims=True)

    def smooth(self, vectors: Floats, arc: Floats) -> Floats:
        """Unit vectors (K, 3) interpolated between those (M, 3) that belong to the places."""
        if self.closed:
            vectors = np.vstack([vectors, vectors[:1]])
        found = np.column_stack([np.interp(arc, self.arc, vectors[: len(self.arc), k]) for k in range(3)])
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    def arc_of(self, points: Floats) -> Floats:
        """Arc lengths (K,) of the places on the curve nearest to points (K, 3); beyond the ends it runs on straight."""
        fine = np.linspace(0, self.length_mm, max(int(len(self.places) * 8), 50))
        places = self.at(fine)
        _, near = cKDTree(places).query(points)
        along = ((points - places[near]) * self.tangents(fine)[near]).sum(axis=1)
        return fine[near] + along


def _walk(cluster: Cluster) -> tuple[Floats, bool, float]:
    """Rough ordered curve (M, 3) along the cluster, whether it is closed, and the bead's width in mm."""
    core = cluster.heights_mm > 0.35 * cluster.peak_mm
    if core.sum() < 12:
        raise DegenerateError(
            f"the bead has only {int(core.sum())} points; too few to follow its ridge, scan it denser"
        )
    size = cluster.spacing_mm
    points = cluster.points[core]
    grid = build_cells(points, size)
    cells = np.repeat(np.arange(len(grid.starts) - 1), np.diff(grid.starts))
    weight = cluster.heights_mm[core][grid.order]
    total = np.bincount(cells, weight)
    nodes = np.column_stack([np.bincount(cells, weight * points[grid.order, k]) / total for k in range(3)])
    around = within_radius(build_cells(nodes, 2.2 * size), nodes, 2.2 * size)
    rows = np.repeat(np.arange(len(nodes)), np.diff(around.starts))
    lengths = np.sqrt(around.squared_mm2)
    graph = coo_array((lengths, (rows, around.indices)), shape=(len(nodes),) * 2).tocsr()
    _, labels = connected_components(graph, directed=False)
    main = np.flatnonzero(labels == np.bincount(labels).argmax())
    graph, nodes, total = graph[main][:, main], nodes[main], total[main]
    end = int(np.argmax(np.nan_to_num(dijkstra(graph, indices=0), posinf=-1)))
    walked = dijkstra(graph, indices=end)
    area = len(nodes) * size**2 / 1.5
    reach = float(walked.max())
    width = max(area / max(reach, size), 1.5 * size)
    if reach < 2.5 * width:
        return _axis(nodes, total), False, max(float(np.sqrt(area) / 1.5), 1.5 * size)
    bands = np.minimum((walked / max(1.2 * width, 2 * size)).astype(np.int64), 10_000)
    curve, closed = _ordered(graph, nodes, total, bands)
    return curve, closed, max(width / 2, 1.5 * size) if closed else width


def _axis(nodes: Floats, weights: Floats) -> Floats:
    """Ends of a compact piece along its longest principal axis."""
    middle = np.average(nodes, axis=0, weights=weights)
    _, _, axes = np.linalg.svd(nodes - middle, full_matrices=False)
    along = (nodes - middle) @ axes[0]
    return _directed(middle + np.linspace(along.min(), along.max(), 5)[:, None] * axes[0])


def _ordered(graph: coo_array, nodes: Floats, weights: Floats, bands: Integers) -> tuple[Floats, bool]:
    """Centroids of the connected pieces of each band of equal walking distance, in order along the bead."""
    pairs = graph.tocoo()
    same = bands[pairs.row] == bands[pairs.col]
    within = coo_array((np.ones(same.sum()), (pairs.row[same], pairs.col[same])), shape=graph.shape)
    number, piece = connected_components(within, directed=False)
    places = np.column_stack([np.bincount(piece, weights * nodes[:, k], number) for k in range(3)])
    places /= np.bincount(piece, weights, number)[:, None]
    amounts = np.bincount(piece, minlength=number)
    links: list[set[int]] = [set() for _ in range(number)]
    for a, b in zip(piece[pairs.row[~same]], piece[pairs.col[~same]], strict=True):
        links[a].add(int(b))
        links[b].add(int(a))
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


def _directed(places: Floats) -> Floats:
    return places if places[0, 0] <= places[-1, 0] else places[::-1]


def _vertices(cluster: Cluster, stations: _Stations, width: float) -> tuple[Floats, Floats, Floats]:
    """Ridge over stations along the curve: feet (M, 3) on the good surface, its normals (M, 3), ridge heights (M,).

    Points are taken in the curve's own coordinates: arc length s, distance b across, height h over the good surface.
    Around each station h = c0 + c1 s + c2 s^2 + (c3 + c4 s) b + c5 b^2 is fitted; the ridge lies at b = -c3 / (2 c5).
    """
    feet = cluster.points - cluster.heights_mm[:, None] * cluster.normals
    s_all = stations.arc_of(feet)
    offsets = feet - stations.at(np.clip(s_all, 0, stations.length_mm))
    tangents = stations.tangents(np.clip(s_all, 0, stations.length_mm))
    sides = np.cross(cluster.normals, tangents)
    b_all = (offsets * sides).sum(axis=1) / np.linalg.norm(sides, axis=1)
    step = stations.length_mm / max(int(np.ceil(stations.length_mm / (0.35 * width))), 4)
    arcs = np.arange(0.0 if stations.closed else 0.5 * step, stations.length_mm - 1e-9, step)
    window, across = 1.2 * width, 0.6 * width
    found = []
    for arc in arcs:
        away = s_all - arc
        if stations.closed:
            away -= stations.length_mm * np.round(away / stations.length_mm)
        used = (np.abs(away) < window) & (np.abs(b_all) < across)
        if used.sum() < 12:
            continue
        s, b, h = away[used], b_all[used], cluster.heights_mm[used]
        weights = (1 - (np.abs(s) / window) ** 3) ** 3
        design = np.column_stack([np.ones_like(s), s, s * s, b, s * b, b * b])
        root = np.sqrt(weights)
        c, _, rank, _ = np.linalg.lstsq(design * root[:, None], h * root, rcond=1e-9)
        curved = rank == 6 and c[5] < 0
        lateral = -c[3] / (2 * c[5]) if curved else np.average(b, weights=weights * h)
        lateral = float(np.clip(lateral, -0.6 * across, 0.6 * across))
        tangent = stations.tangents(np.array([arc]))[0]
        up = (weights[:, None] * cluster.normals[used]).sum(axis=0)
        up -= (up @ tangent) * tangent
        up /= np.linalg.norm(up)
        side = np.cross(up, tangent)
        place = stations.at(np.array([arc]))[0]
        foot = place + np.average((offsets[used] * up).sum(axis=1), weights=weights) * up + lateral * side
        found.append((foot, up, c[0] + c[3] * lateral + c[5] * lateral**2))
    if len(found) < 2:
        raise DegenerateError("the bead is too small or too thinly sampled to follow its ridge; scan it denser")
    places, normals, heights = (np.array(column) for column in zip(*found, strict=True))
    return places, normals, heights


def _smoothed(places: Floats, closed: bool) -> Floats:
    """Places (M, 3) averaged with their neighbours in the ratio 1 : 2 : 1; ends of an open curve stay."""
    before, after = np.roll(places, 1, axis=0), np.roll(places, -1, axis=0)
    mean = (before + 2 * places + after) / 4
    if not closed:
        mean[[0, -1]] = places[[0, -1]]
    return mean


def _ends(cluster: Cluster, ridge: _Stations) -> tuple[float, float]:
    """Arc lengths between which the bead stands at least half as high as its ridge."""
    high = cluster.heights_mm > 0.5 * cluster.peak_mm
    arcs = ridge.arc_of(cluster.points[high])
    return float(np.quantile(arcs, 0.005)), float(np.quantile(arcs, 0.995))
