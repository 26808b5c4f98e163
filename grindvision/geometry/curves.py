"""Smooth curves through ordered points, by arc length."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest

Floats = NDArray[np.float64]


class Curve:
    """Cubic spline through ordered points (M, 3), by arc length in mm along their chords; straight at open ends.

    A closed curve comes back to its first point. ``arc`` holds the arc lengths of ``places``, ``length_mm`` the whole.
    """

    def __init__(self, places: ArrayLike, closed: bool = False) -> None:
        places = np.asarray(places, dtype=float)
        places = places[np.r_[True, np.linalg.norm(np.diff(places, axis=0), axis=1) > 1e-9]]
        if closed:
            places = np.vstack([places, places[:1]])
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        self.closed = closed
        self.places = places
        self.arc = np.r_[0, np.cumsum(steps)]
        self.length_mm = float(self.arc[-1])
        self._steps = steps
        self._slopes = np.diff(places, axis=0) / steps[:, None]
        self._bends = _second_derivatives(steps, self._slopes, closed)

    def at(self, arc: ArrayLike) -> Floats:
        """Points (K, 3) at arc lengths (K,)."""
        segment, s, slope, bend, change = self._segments(arc)
        return self.places[segment] + s * (slope + s * (bend / 2 + s * change / 6))

    def tangents(self, arc: ArrayLike) -> Floats:
        """Unit tangents (K, 3) at arc lengths (K,)."""
        _, s, slope, bend, change = self._segments(arc)
        direction = slope + s * (bend + s * change / 2)
        return direction / np.linalg.norm(direction, axis=1, keepdims=True)

    def smooth(self, vectors: ArrayLike, arc: ArrayLike) -> Floats:
        """Unit vectors (K, 3) interpolated between those (M, 3) that belong to the places."""
        given, arc = np.asarray(vectors, dtype=float), np.asarray(arc, dtype=float)
        ends = np.vstack([given, given[:1]]) if self.closed else given
        found = np.column_stack([np.interp(arc, self.arc, ends[: len(self.arc), k]) for k in range(3)])
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    def arc_of(self, points: ArrayLike) -> Floats:
        """Arc lengths (K,) of the places on the curve nearest to points (K, 3); beyond the ends it runs on straight."""
        points = np.asarray(points, dtype=float)
        fine = np.linspace(0, self.length_mm, max(int(len(self.places) * 8), 50))
        places = self.at(fine)
        extent = float(np.linalg.norm(np.ptp(np.concatenate([places, points]), axis=0)))
        near, _ = nearest(build_cells(places, extent / 20), points, 2 * extent)
        along = ((points - places[near]) * self.tangents(fine)[near]).sum(axis=1)
        return fine[near] + np.asarray(along)

    def distances(self, points: ArrayLike) -> Floats:
        """Distances (K,) in mm of points (K, 3) from the curve; beyond its ends, from the ends."""
        points = np.asarray(points, dtype=float)
        arc = self.arc_of(points)
        feet = self.at(arc if self.closed else np.clip(arc, 0, self.length_mm))
        return np.linalg.norm(points - feet, axis=1)

    def _segments(self, arc: ArrayLike) -> tuple[NDArray[np.int64], Floats, Floats, Floats, Floats]:
        """Segment (K,) of each arc length, the way (K, 1) into it, and the first three derivatives at its beginning."""
        arc = np.asarray(arc, dtype=float)
        if self.closed:
            arc = arc % self.length_mm
        at = np.clip(np.searchsorted(self.arc, arc, side="right") - 1, 0, len(self._steps) - 1)
        step, bend, next_bend = self._steps[at, None], self._bends[at], self._bends[at + 1]
        slope = self._slopes[at] - step * (2 * bend + next_bend) / 6
        return at, (arc - self.arc[at])[:, None], slope, bend, (next_bend - bend) / step


def _second_derivatives(steps: Floats, slopes: Floats, closed: bool) -> Floats:
    """Second derivatives (M, 3) of the spline at its places, from lengths (M - 1,) and slopes (M - 1, 3) of chords."""
    count = len(steps)
    matrix, right = np.eye(count + 1), np.zeros((count + 1, 3))
    for at in range(0 if closed else 1, count):
        before = at - 1 if at else count - 1
        matrix[at, at] = 2 * (steps[before] + steps[at])
        matrix[at, before] += steps[before]
        matrix[at, at + 1] += steps[at]
        right[at] = 6 * (slopes[at] - slopes[before])
    if closed:
        matrix[count, 0] = -1.0
    return np.asarray(np.linalg.solve(matrix, right), dtype=float)
