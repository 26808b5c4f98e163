"""Path points as the paper extracts them (section 3.6): minimal box, equal parts, centroids, nearest test points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import check_points
from grindvision.records import by_content

Floats = NDArray[np.float64]


@by_content
@dataclass(frozen=True)
class OrientedBox:
    """Box with ``centre_mm`` (3,), unit ``axes`` (3, 3) as rows, longest first, and full ``size_mm`` (3,)."""

    centre_mm: Floats
    axes: Floats
    size_mm: Floats

    def __str__(self) -> str:
        return "box of {:.2f} x {:.2f} x {:.2f} mm".format(*self.size_mm)


@by_content
@dataclass(frozen=True)
class BoxPath:
    """Path points (n, 3) with normals (n, 3), the centroids (n, 3) they were found from, and the box."""

    points: Floats
    normals: Floats
    centroids: Floats
    box: OrientedBox

    def __str__(self) -> str:
        return f"{len(self.points)} path points in a {self.box}"


def minimal_box(points: ArrayLike) -> OrientedBox:
    """Box of least volume among those with a face on the convex hull: for each hull face, the least rectangle around
    the points projected on it (rotating calipers). Exact but for boxes that touch the hull with edges only.

    Raises:
        DegenerateError: fewer than four points, or points in one plane.
    """
    points = check_points(points, "difference points", min_points=4)
    try:
        hull = ConvexHull(points)
    except QhullError:
        raise DegenerateError("the difference points lie in one plane; their box has no volume") from None
    corners = points[hull.vertices]
    _, faces = np.unique(np.round(hull.equations[:, :3], 6), axis=0, return_index=True)
    normals = hull.equations[faces, :3] / np.linalg.norm(hull.equations[faces, :3], axis=1, keepdims=True)
    heights = np.ptp(corners @ normals.T, axis=0)
    volume_bounds = heights * _shadows(hull, normals)  # a rectangle around the shadow is no smaller than the shadow
    best, least = np.eye(3), np.inf
    for face in np.argsort(volume_bounds, kind="stable"):
        if volume_bounds[face] > least:
            break
        normal = normals[face]
        across = np.linalg.svd(normal[None])[2][1:]
        flat = corners @ across.T
        outline = flat[ConvexHull(flat).vertices]
        edges = np.roll(outline, -1, axis=0) - outline
        edges /= np.linalg.norm(edges, axis=1, keepdims=True)
        along = np.ptp(outline @ edges.T, axis=0)
        aside = np.ptp(outline @ np.column_stack([-edges[:, 1], edges[:, 0]]).T, axis=0)
        at = int(np.argmin(along * aside))
        volume = along[at] * aside[at] * heights[face]
        if volume < least:
            first = edges[at] @ across
            best, least = np.stack([first, np.cross(normal, first), normal]), volume
    low, high = (points @ best.T).min(axis=0), (points @ best.T).max(axis=0)
    order = np.argsort(-(high - low), kind="stable")
    return OrientedBox((low + high) / 2 @ best, best[order], (high - low)[order])


def _shadows(hull: ConvexHull, normals: Floats) -> Floats:
    """Area (K,) of the hull's projection along ``normals`` (K, 3): half of what its faces, front and back, cast."""
    a, b, c = hull.points[hull.simplices].swapaxes(0, 1)
    return np.abs(np.cross(b - a, c - a) @ normals.T).sum(axis=0) / 4


def box_path(difference: ArrayLike, test: ArrayLike, test_normals: ArrayLike, points: int = 6) -> BoxPath:
    """Steps 1-4 of section 3.6.

    Args:
        difference: the difference cloud (N, 3).
        test: the test cloud (M, 3) in which the nearest point to each centroid is taken, and its normals (M, 3).
        points: number of equal parts along the longest side; a part without points gives none.
    """
    difference = check_points(difference, "difference points", min_points=4)
    if points < 1:
        raise InputError(f"{points} path points asked for; at least 1 is needed")
    box = minimal_box(difference)
    along = (difference - box.centre_mm) @ box.axes[0]
    part = np.clip(((along / box.size_mm[0] + 0.5) * points).astype(np.int64), 0, points - 1)
    centroids = np.stack([difference[part == k].mean(axis=0) for k in range(points) if (part == k).any()])
    if centroids[0, 0] > centroids[-1, 0]:
        centroids = centroids[::-1]
    test = check_points(test, "test points")
    _, at = cKDTree(test).query(centroids)
    return BoxPath(test[at], np.asarray(test_normals, dtype=float)[at], centroids, box)
