"""Curves through places that lie along seams in no order: linked, cut at branches, joined across interruptions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

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
    long_enough = [curve for curve in joined if _length(curve) >= min_length_mm]
    return sorted(long_enough, key=lambda curve: -_length(curve))


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
