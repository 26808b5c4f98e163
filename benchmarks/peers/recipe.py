"""From a difference cloud to path points with SciPy: what the Python peers share, as no library brings it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]

THRESHOLD_MM = 0.5
HIGHEST_MM = 4.0
BESIDE_MM = 1.0
CLUSTER_MM = 1.5
POINTS = 6


def bead_path(
    points: Floats, moved: Floats, distances_mm: Floats, surface: Floats, normals: Floats, count: int = POINTS
) -> Floats:
    """Path points (count, 3) along the largest cluster of points that stand out of the sample.

    Of the points farther than ``THRESHOLD_MM`` from the sample, those count that lie so high above the plane of their
    nearest voxel of the sample's ``surface`` (with ``normals``), and not farther than ``BESIDE_MM`` beside it: what
    only one scan shows is no bead. The cluster's longest axis is cut into equal slabs; in each the highest quarter of
    the points is averaged.

    Args:
        points: test scan (N, 3) in its own frame, as the path will be; ``moved``: the same in the sample's frame.
    """
    changed = np.flatnonzero((distances_mm > THRESHOLD_MM) & (distances_mm < HIGHEST_MM))
    _, near = cKDTree(surface).query(moved[changed])
    away = moved[changed] - surface[near]
    facing = np.where(normals[near, 2] > 0, -1.0, 1.0)
    heights = facing * (away * normals[near]).sum(axis=1)
    beside = np.sqrt(np.maximum((away**2).sum(axis=1) - heights**2, 0))
    above = (heights > THRESHOLD_MM) & (beside < BESIDE_MM)
    points, heights = points[changed[above]], heights[above]
    if len(points) < 4 * count:
        return np.empty((0, 3))
    chosen = largest_cluster(points)
    points, heights = points[chosen], heights[chosen]
    axis = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    along = (points - points.mean(axis=0)) @ axis
    slab = np.clip(((along - along.min()) / np.ptp(along) * count).astype(int), 0, count - 1)
    path = []
    for number in range(count):
        own = np.flatnonzero(slab == number)
        if len(own):
            path.append(points[own[np.argsort(heights[own])[-max(len(own) // 4, 1) :]]].mean(axis=0))
    return np.array(path)


def largest_cluster(points: Floats) -> NDArray[np.bool_]:
    """Mark the largest set of points (N,) connected through steps of ``CLUSTER_MM``, on a grid of a third of it."""
    cells, cell = np.unique(np.floor(points / (CLUSTER_MM / 3)).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(3.0, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(cells),) * 2)
    label = connected_components(graph, directed=False)[1][cell.ravel()]
    return label == np.bincount(label).argmax()
