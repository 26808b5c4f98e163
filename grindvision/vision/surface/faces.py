"""Faces of a scanned surface: connected surfels across which the surface turns slowly, bounded by edges and steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

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
    one = np.repeat(np.arange(len(points)), np.diff(around.starts))
    other = around.indices
    step = np.abs(((points[other] - points[one]) * normals[one]).sum(axis=1))
    alike = (normals[one] * normals[other]).sum(axis=1) > COS_SMOOTH
    flat = surfels.roughness_mm < 3 * np.median(surfels.roughness_mm) + MAX_ROUGH * size
    linked = alike & (step < MAX_STEP * size) & flat[one] & flat[other]
    links = coo_matrix((np.ones(int(linked.sum())), (one[linked], other[linked])), shape=(len(points),) * 2)
    _, piece = connected_components(links, directed=False)
    counts = np.bincount(piece)
    order = np.argsort(-counts, kind="stable")
    rank = np.full(len(counts), -1)
    large = counts[order] >= max(min_surfels, min_fraction * len(points))
    rank[order[large]] = np.arange(large.sum())
    labels = rank[piece].astype(np.int64)
    # surfels at a face's rim lie on its plane, but are rough for what lies beside it
    beside = (
        (labels[one] < 0)
        & (labels[other] >= 0)
        & (np.abs(((points[one] - points[other]) * normals[other]).sum(axis=1)) < MAX_STEP * size / 2)
    )
    grown = labels.copy()
    np.maximum.at(grown, one[beside], labels[other[beside]])
    return grown
