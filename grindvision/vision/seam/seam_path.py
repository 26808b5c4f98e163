"""From a groove to way points: the paper's slabs with a geometric median each, and ours on the fitted root line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import check_points
from grindvision.records import by_content
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.joints import Seam

Floats = NDArray[np.float64]

#: As the paper prints them (Section IV): the descent stops at a smaller change of cost, or after so many steps.
COST_CHANGE, MAX_STEPS = 1e-4, 1000
#: As the first author's early code has them: first step, and its shortening when the cost rises.
FIRST_STEP, SHORTENING = 0.01, 0.8


@by_content
@dataclass(frozen=True)
class SeamPath:
    """Way points (W, 3) in mm in the order of the seam, with unit outward normals (W, 3); ``closed`` for a ring."""

    points: Floats
    normals: Floats
    closed: bool = False

    @property
    def length_mm(self) -> float:
        """Length of the polygon through the way points."""
        line = np.concatenate([self.points, self.points[:1]]) if self.closed else self.points
        return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())

    def begun_at(self, waypoint: int) -> SeamPath:
        """The same ring with another way point as its first one.

        Raises:
            InputError: the path is open, which begins at one of its ends.
        """
        if not self.closed:
            raise InputError("an open path begins at one of its ends; only a closed one can begin elsewhere")
        return SeamPath(np.roll(self.points, -waypoint, axis=0), np.roll(self.normals, -waypoint, axis=0), True)

    def __len__(self) -> int:
        return len(self.points)

    def __str__(self) -> str:
        shape = "closed" if self.closed else "open"
        return f"{shape} path of {len(self)} way points, {self.length_mm:.0f} mm long"


def root_path(groove: DetectedGroove | Seam, waypoints: int = 50) -> SeamPath:
    """Way points at equal distances along the root of a groove or another seam, from one end to the other.

    Raises:
        InputError: fewer than two way points.
    """
    _check_count(waypoints)
    line = np.concatenate([groove.root, groove.root[:1]]) if groove.closed else groove.root
    normals = np.concatenate([groove.normals, groove.normals[:1]]) if groove.closed else groove.normals
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    wanted = np.linspace(0, at[-1], waypoints, endpoint=not groove.closed)
    points = np.stack([np.interp(wanted, at, line[:, k]) for k in range(3)], axis=1)
    up = np.stack([np.interp(wanted, at, normals[:, k]) for k in range(3)], axis=1)
    return SeamPath(points, up / np.linalg.norm(up, axis=1, keepdims=True), groove.closed)


def slab_path(points: ArrayLike, normals: ArrayLike, waypoints: int = 50) -> SeamPath:
    """The paper's path: slabs of equal width along the groove's longest axis, the geometric median of each (Eq 7).

    A slab's normal is the unit sum of its points' normals (Eq 8). Slabs without points are left out.

    Args:
        points: the groove's points (N, 3), mm.
        normals: their unit normals (N, 3).
        waypoints: number of slabs; the paper takes 50 to 60.

    Raises:
        InputError: shapes differ, fewer than two slabs. DegenerateError: fewer than two slabs hold points.
    """
    _check_count(waypoints)
    points = check_points(points, "groove points", min_points=2)
    normals = check_points(normals, "normals", min_points=2)
    if points.shape != normals.shape:
        raise InputError(f"{len(points)} groove points but {len(normals)} normals; give one normal per point")
    centred = points - points.mean(axis=0)
    along = centred @ np.linalg.eigh(centred.T @ centred)[1][:, 2]
    edges = np.linspace(along.min(), along.max(), waypoints + 1)
    slab = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, waypoints - 1)
    filled = [np.flatnonzero(slab == number) for number in range(waypoints)]
    filled = [members for members in filled if len(members)]
    if len(filled) < 2:
        raise DegenerateError("all groove points fall into one slab; they make no path")
    medians = np.array([descended_median(points[members]) for members in filled])
    sums = np.array([normals[members].sum(axis=0) for members in filled])
    return SeamPath(medians, sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12))


def descended_median(points: ArrayLike) -> Floats:
    """Geometric median (3,) of points (N, 3) by the paper's gradient descent, from their mean."""
    points = np.asarray(points, dtype=float)
    place, step = points.mean(axis=0), FIRST_STEP
    cost = np.linalg.norm(points - place, axis=1).sum()
    for _ in range(MAX_STEPS):
        away = place - points
        lengths = np.linalg.norm(away, axis=1)
        trial = place - step * (away / np.maximum(lengths, 1e-9)[:, None]).sum(axis=0)
        trial_cost = np.linalg.norm(points - trial, axis=1).sum()
        if trial_cost > cost:
            step *= SHORTENING
            continue
        change, place, cost = cost - trial_cost, trial, trial_cost
        if change < COST_CHANGE:
            break
    return place


def weiszfeld_median(points: ArrayLike, tolerance_mm: float = 1e-6) -> Floats:
    """Geometric median (3,) of points (N, 3) by Weiszfeld's iteration: the mean weighted by inverse distance."""
    points = np.asarray(points, dtype=float)
    place = points.mean(axis=0)
    for _ in range(MAX_STEPS):
        weights = 1 / np.maximum(np.linalg.norm(points - place, axis=1), 1e-9)
        moved = weights @ points / weights.sum()
        if np.linalg.norm(moved - place) < tolerance_mm:
            return moved
        place = moved
    return place


def _check_count(waypoints: int) -> None:
    if waypoints < 2:
        raise InputError(f"{waypoints} way points make no path; ask for at least 2")
