"""Curves through places that lie along seams in no order: linked, cut at branches, joined across interruptions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from grindvision.geometry import vector_angle
from grindvision.geometry.graphs import edge_graph, farthest, shortest_way, walking_distances

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Places of one seam are at most so many cells apart, and their directions differ by less than this.
LINK_CELLS, LINK_RAD = 2.2, np.radians(35.0)
#: What lies farther than this from a traced curve, in cells, is a branch or the other half of a ring.
MAX_LATERAL_CELLS = 2.0
#: Curves are joined where the way between their ends is short and in line: a clamp or a tack lies between them.
JOIN_RAD = np.radians(25.0)
#: So many of the longest pieces are looked at.
MAX_PIECES = 40
#: A seam turns a corner, round a plate's or to the next edge of a body, where two straight lines that turn by this
#: leave less than this fraction of what an arc leaves, a ring's, over so many cells to both sides, at least and at
#: most. So many cells at the corner itself, which pairs of surfaces show rounded, are left out. Places are so many
#: cells apart.
CORNER_RAD, CORNER_FRACTION = np.radians(50.0), 0.6
CORNER_CELLS, ROUNDED_CELLS, PLACE_CELLS = (2.0, 5.0), 1.0, 0.5


def trace_curves(places: Floats, along: Floats, size_mm: float, join_mm: float, min_length_mm: float) -> list[Floats]:
    """Ordered curves (M, 3) through places (K, 3) with directions (K, 3) of any sign, longest first.

    Args:
        places: points on seams, mm.
        along: unit directions of the seams there.
        size_mm: the cell to which the places belong; it scales all distances.
        join_mm: longest interruption that is bridged.
        min_length_mm: shorter curves are left out.
    """
    if len(places) < 3:
        return []
    left, curves = np.arange(len(places)), []
    while len(left) >= 3:
        names = _linked(places[left], along[left], size_mm)
        done = []
        for name in range(names.max() + 1):
            members = left[names == name]
            if len(members) < 3:
                done.append(members)
                continue
            curve = _longest_way(places[members], size_mm)
            if len(curve) >= 2:
                curves.append(curve)
            away = cKDTree(_dense(curve, size_mm / 4)).query(places[members])[0]
            done.append(members[away < MAX_LATERAL_CELLS * size_mm])
        left = np.setdiff1d(left, np.concatenate(done))
    pieces = sorted((curve for curve in curves if _length(curve) > size_mm), key=lambda curve: -_length(curve))
    joined = _joined(pieces[:MAX_PIECES], join_mm, 1.5 * size_mm)
    straight_on = [part for curve in joined for part in cut_at_corners(curve, size_mm)]
    long_enough = [curve for curve in straight_on if _length(curve) >= min_length_mm]
    return sorted(long_enough, key=lambda curve: -_length(curve))


def cut_at_corners(curve: Floats, size_mm: float) -> list[Floats]:
    """A curve (M, 3) in the parts between its corners; a seam is fitted as a smooth line, which no corner is."""
    places = _dense(curve, PLACE_CELLS * size_mm)
    least, most, rounded = (round(cells / PLACE_CELLS) for cells in (*CORNER_CELLS, ROUNDED_CELLS))
    best: tuple[float, int] | None = None
    for at in range(least + rounded, len(places) - least - rounded):
        before = places[max(at - rounded - most, 0) : at - rounded + 1]
        after = places[at + rounded : at + rounded + most + 1]
        if vector_angle(_direction(before), _direction(after)) < CORNER_RAD:
            continue
        lines = np.sqrt(np.mean(np.concatenate([_off_line(before), _off_line(after)]) ** 2))
        arc = _off_arc(places[max(at - rounded - most, 0) : at + rounded + most + 1])
        if lines < CORNER_FRACTION * arc and (best is None or lines / arc < best[0]):
            best = float(lines / arc), at
    if best is None:
        return [curve]
    halves = places[: best[1] - rounded + 1], places[best[1] + rounded :]
    return [part for half in halves for part in cut_at_corners(half, size_mm)]


def _direction(places: Floats) -> Floats:
    """Unit direction of places (K, 3) in order, from the first to the last."""
    away = places - places.mean(axis=0)
    way = np.linalg.svd(away, full_matrices=False)[2][0]
    return np.asarray(way * np.sign(way @ (places[-1] - places[0])))


def _off_line(places: Floats) -> Floats:
    """Distances (K,) of places (K, 3) from the straight line through them."""
    away, way = places - places.mean(axis=0), _direction(places)
    return np.asarray(np.linalg.norm(away - np.outer(away @ way, way), axis=1))


def _off_arc(places: Floats) -> float:
    """Root mean square of the distances of places (K, 3) from the circle through them."""
    away = places - places.mean(axis=0)
    axes = np.linalg.svd(away, full_matrices=False)[2]
    u, v, up = (away @ axis for axis in axes)
    solution = np.linalg.lstsq(np.column_stack([2 * u, 2 * v, np.ones(len(u))]), u * u + v * v, rcond=None)[0]
    radius = np.sqrt(max(solution[2] + solution[0] ** 2 + solution[1] ** 2, 0.0))
    off = np.hypot(u - solution[0], v - solution[1]) - radius
    return float(np.sqrt(np.mean(off**2 + up**2)))


def _linked(places: Floats, along: Floats, size_mm: float) -> Integers:
    """Number of the connected group (K,) of every place."""
    pairs = cKDTree(places).query_pairs(LINK_CELLS * size_mm, output_type="ndarray")
    if len(pairs):
        agree = np.abs((along[pairs[:, 0]] * along[pairs[:, 1]]).sum(axis=1)) > np.cos(LINK_RAD)
        way = places[pairs[:, 1]] - places[pairs[:, 0]]
        aside = np.linalg.norm(way - (way * along[pairs[:, 0]]).sum(axis=1)[:, None] * along[pairs[:, 0]], axis=1)
        pairs = pairs[agree & (aside < 1.2 * size_mm)]
    graph = edge_graph(pairs[:, 0], pairs[:, 1], np.ones(len(pairs)), len(places))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _longest_way(places: Floats, size_mm: float) -> Floats:
    """The shortest way (M, 3) between the two places that are farthest from each other along the group."""
    pairs = cKDTree(places).query_pairs(LINK_CELLS * size_mm, output_type="ndarray")
    length = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    # Squared steps prefer many short ones: the way keeps to the middle of the places.
    graph = edge_graph(pairs[:, 0], pairs[:, 1], length**2 + 1e-9, len(places))
    first = farthest(walking_distances(graph, 0))
    return places[shortest_way(graph, first, farthest(walking_distances(graph, first)))]


def _joined(curves: list[Floats], join_mm: float, near_mm: float) -> list[Floats]:
    """Curves put together end to end where one goes on as the other, across gaps of at most ``join_mm``."""
    curves = list(curves)
    while True:
        best: tuple[float, int, int, Floats] | None = None
        for i, first in enumerate(curves):
            for j in range(i + 1, len(curves)):
                for one in (first, first[::-1]):
                    for other in (curves[j], curves[j][::-1]):
                        gap = float(np.linalg.norm(other[0] - one[-1]))
                        if gap < join_mm and (best is None or gap < best[0]) and _in_line(one, other, gap, near_mm):
                            best = gap, i, j, np.concatenate([one, other])
        if best is None:
            return curves
        _, i, j, both = best
        curves = [curve for number, curve in enumerate(curves) if number not in (i, j)] + [both]


def _in_line(one: Floats, other: Floats, gap: float, near_mm: float) -> bool:
    """Whether the second curve goes on where the first one ends."""
    end, start = -_end_direction(one[::-1], 4 * near_mm), _end_direction(other, 4 * near_mm)
    turn = np.arccos(np.clip(end @ start, -1, 1))
    if gap < near_mm:
        return bool(turn < 1.5 * JOIN_RAD)
    way = (other[0] - one[-1]) / gap
    aside = max(np.arccos(np.clip(end @ way, -1, 1)), np.arccos(np.clip(start @ way, -1, 1)))
    return bool(turn < 2 * JOIN_RAD and aside < JOIN_RAD)


def _end_direction(curve: Floats, reach_mm: float) -> Floats:
    """Unit direction in which a curve leaves its first point."""
    away = np.linalg.norm(curve - curve[0], axis=1)
    at = int(np.argmax(away >= min(reach_mm, away.max())))
    way = curve[max(at, 1)] - curve[0]
    return np.asarray(way / max(float(np.linalg.norm(way)), 1e-9))


def _length(curve: Floats) -> float:
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


def _dense(curve: Floats, step_mm: float) -> Floats:
    """The polygon (M, 3) with points at most ``step_mm`` apart."""
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    fine = np.linspace(0, at[-1], int(at[-1] / step_mm) + 2)
    return np.stack([np.interp(fine, at, curve[:, k]) for k in range(3)], axis=1)
