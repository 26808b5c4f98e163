"""Faces of a scanned surface: connected surfels across which the surface turns slowly, bounded by edges and steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.kernels import njit
from grindvision.vision.surface.clustering import root_of
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

REACH = 1.8
"""Surfels are neighbours within so many cells."""

COS_SMOOTH = float(np.cos(np.radians(12)))
"""Cosine of the angle between the normals of neighbours up to which they are of one face."""

MAX_STEP = 0.3
"""Largest distance of a neighbour from a surfel's plane, in cells: beyond, it lies on the other side of a step."""

MAX_ROUGH = 0.05
"""Surfels rougher than three times the usual and so many cells lie on edges, or where the surface curves strongly."""


def label_faces(surfels: Surfels, min_fraction: float = 0.01, min_surfels: int = 40) -> Integers:
    """Face (M,) of every surfel, largest first from 0 on; -1 on edges and on faces that are smaller than a share of all
    surfels or than so many."""
    points, normals, size = surfels.points, surfels.normals, surfels.grid.size_mm
    around = within_radius(build_cells(points, REACH * size), points, REACH * size)
    flat = surfels.roughness_mm < 3 * np.median(surfels.roughness_mm) + MAX_ROUGH * size
    roots = _joined(points, normals, around.starts, around.indices, flat, MAX_STEP * size)
    _, piece, counts = np.unique(roots, return_inverse=True, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    rank = np.full(len(counts), -1)
    large = counts[order] >= max(min_surfels, min_fraction * len(points))
    rank[order[large]] = np.arange(large.sum())
    labels = rank[piece].astype(np.int64)
    # surfels at a face's rim lie on its plane, but are rough for what lies beside it
    return _grown(points, normals, around.starts, around.indices, labels, MAX_STEP * size / 2)


@njit(cache=True, nogil=True)
def _joined(
    points: Floats, normals: Floats, starts: Integers, indices: Integers, flat: Flags, max_step: float
) -> Integers:
    """Root (M,), the first surfel of its piece, of every surfel once all flat neighbours are joined across which the
    surface turns slowly and makes no step of ``max_step``."""
    parent = np.arange(len(points))
    for one in range(len(points)):
        for at in range(starts[one], starts[one + 1]):
            other = indices[at]
            if not (flat[one] and flat[other] and _inner(normals, one, other) > COS_SMOOTH):
                continue
            if abs(_height(points, normals, other, one)) < max_step:
                a, b = root_of(parent, one), root_of(parent, other)
                parent[max(a, b)] = min(a, b)
    for one in range(len(points)):
        parent[one] = root_of(parent, one)
    return parent


@njit(cache=True, nogil=True)
def _grown(
    points: Floats, normals: Floats, starts: Integers, indices: Integers, labels: Integers, max_step: float
) -> Integers:
    """Faces (M,) with the surfels without one that lie on the plane of a neighbour that has one; the last of them."""
    grown = labels.copy()
    for one in range(len(points)):
        if labels[one] >= 0:
            continue
        for at in range(starts[one], starts[one + 1]):
            other = indices[at]
            if labels[other] > grown[one] and abs(_height(points, normals, one, other)) < max_step:
                grown[one] = labels[other]
    return grown


@njit(cache=True, nogil=True)
def _inner(rows: Floats, a: int, b: int) -> float:
    """Inner product of two rows."""
    return rows[a, 0] * rows[b, 0] + rows[a, 1] * rows[b, 1] + rows[a, 2] * rows[b, 2]


@njit(cache=True, nogil=True)
def _height(points: Floats, normals: Floats, one: int, base: int) -> float:
    """Height of a surfel above the plane of another."""
    x, y, z = points[one, 0] - points[base, 0], points[one, 1] - points[base, 1], points[one, 2] - points[base, 2]
    return x * normals[base, 0] + y * normals[base, 1] + z * normals[base, 2]
