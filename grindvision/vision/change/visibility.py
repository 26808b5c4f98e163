"""Whether the sample shows its surface where it is asked: behind a point as its scanner sees it, or all around a foot.

What only the test scan shows is no difference: at a rim, behind a shadow, on a wall that the sample's scanner missed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.kernels import njit
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

MAX_OPEN = np.radians(130)
"""Largest sector around a foot that may be empty of sample surface; straight rims leave 180 degrees."""

MIN_SHOWN = 8
"""Of the nine pixels about a doubtful point, so many must show surface behind it: at a rim it may be surface unseen."""


def in_front(surface: Surfels, viewpoint: Floats | None, points: Floats, size: float) -> Flags:
    """Points that the sample's scanner would have seen in front of what it saw: new material, not an unseen wall."""
    if viewpoint is None or len(points) == 0:
        return np.zeros(len(points), dtype=bool)
    middle = surface.points.mean(axis=0) - viewpoint
    distance = float(np.linalg.norm(middle))
    ahead = middle / distance
    across = np.linalg.svd(ahead[None])[2][1:]
    pixel = 1.5 * size / distance

    def project(places: Floats) -> tuple[Integers, Floats]:
        rays = places - viewpoint
        depth = rays @ ahead
        return np.round(rays @ across.T / np.maximum(depth, 1e-9)[:, None] / pixel).astype(np.int64), depth

    pixels, depths = project(surface.points)
    low, high = pixels.min(axis=0) - 2, pixels.max(axis=0) + 3
    nearest_depth = np.full(tuple(high - low), np.inf)
    np.minimum.at(nearest_depth, tuple((pixels - low).T), depths)
    asked, asked_depths = project(points)
    inside = ((asked > low) & (asked < high - 1)).all(axis=1)
    spot = np.where(inside[:, None], asked - low, 1)
    window, shown = np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            depth = nearest_depth[spot[:, 0] + i, spot[:, 1] + j]
            np.minimum(window, depth, out=window)
            shown += np.isfinite(depth)
    return inside & (shown >= MIN_SHOWN) & (asked_depths < window)


def surrounded(surface: Surfels, feet: Floats, normals: Floats) -> Flags:
    """Whether the sample's surface lies all around these feet (N, 3); at a rim there is nothing to compare with."""
    reach = 2.5 * surface.grid.size_mm
    around = within_radius(build_cells(surface.points, reach), feet, reach)
    return _largest_gaps(surface.points, feet, normals, around.starts, around.indices) < MAX_OPEN


@njit(cache=True, nogil=True)
def _largest_gaps(points: Floats, feet: Floats, normals: Floats, starts: Integers, indices: Integers) -> Floats:
    """Largest angle (N,) about each foot's normal between successive neighbours."""
    gaps = np.full(len(feet), 2 * np.pi)
    for f in range(len(feet)):
        count = starts[f + 1] - starts[f]
        if count < 4:
            continue
        n = normals[f]
        u = np.array([n[1], -n[0], 0.0]) if abs(n[2]) < 0.9 else np.array([0.0, n[2], -n[1]])
        u /= np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
        v = np.array([n[1] * u[2] - n[2] * u[1], n[2] * u[0] - n[0] * u[2], n[0] * u[1] - n[1] * u[0]])
        angles = np.empty(count)
        for k in range(count):
            d = points[indices[starts[f] + k]] - feet[f]
            angles[k] = np.arctan2(v[0] * d[0] + v[1] * d[1] + v[2] * d[2], u[0] * d[0] + u[1] * d[1] + u[2] * d[2])
        angles.sort()
        gap = angles[0] + 2 * np.pi - angles[-1]
        for k in range(1, count):
            gap = max(gap, angles[k] - angles[k - 1])
        gaps[f] = gap
    return gaps
