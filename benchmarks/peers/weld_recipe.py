"""The second paper's groove descriptor and way points in NumPy and SciPy, for a peer that brings normals only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.peers.recipe import largest_cluster

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.int64]

VOTE_MM = 5.0
SLABS = 50
CHUNK = 20_000


def groove_labels(points: Floats, normals: Floats, radius_mm: float, threshold_deg: float) -> Flags:
    """Mark the groove (N,): spread of the normals above the threshold, majority of neighbours, largest cluster."""
    tree = cKDTree(points)
    base = normals.sum(axis=0) / np.linalg.norm(normals.sum(axis=0))
    to_base = _angles_deg(normals @ base)
    above = np.zeros(len(points), dtype=bool)
    for rows in np.array_split(np.arange(len(points)), len(points) // CHUNK + 1):
        near, starts, own = _neighbours(tree, points[rows], radius_mm)
        to_own = _angles_deg((normals[rows][own] * normals[near]).sum(axis=1))
        variances = [_variance(values, starts) for values in (to_own, to_base[near])]
        above[rows] = (variances[0] * variances[1]) ** 0.25 > threshold_deg
    high = np.flatnonzero(above)
    voted = np.zeros(len(points), dtype=bool)
    for rows in np.array_split(high, len(high) // CHUNK + 1):
        if len(rows):
            near, starts, _ = _neighbours(tree, points[rows], VOTE_MM)
            voted[rows] = np.add.reduceat(above[near].astype(float), starts) * 2 > np.diff([*starts, len(near)])
    labels = np.zeros(len(points), dtype=bool)
    if voted.any():
        labels[np.flatnonzero(voted)[largest_cluster(points[voted])]] = True
    return labels


def slab_medians(points: Floats) -> Floats:
    """Geometric median of each of the slabs along the longest axis."""
    axis = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    along = points @ axis
    slab = np.clip(((along - along.min()) / np.ptp(along) * SLABS).astype(int), 0, SLABS - 1)
    medians = []
    for own in (points[slab == number] for number in range(SLABS) if (slab == number).any()):
        place = own.mean(axis=0)
        for _ in range(100):
            weights = 1 / np.maximum(np.linalg.norm(own - place, axis=1), 1e-9)
            place, before = weights @ own / weights.sum(), place
            if np.linalg.norm(place - before) < 1e-4:
                break
        medians.append(place)
    return np.array(medians)


def _neighbours(tree: cKDTree, points: Floats, radius_mm: float) -> tuple[Rows, Rows, Rows]:
    """Neighbours of all points in one row, where each point's begin, and whose they are."""
    lists = tree.query_ball_point(points, radius_mm, workers=-1)
    counts = np.fromiter(map(len, lists), int, len(lists))
    return np.concatenate(lists).astype(int), np.cumsum(counts) - counts, np.repeat(np.arange(len(lists)), counts)


def _variance(values: Floats, starts: Rows) -> Floats:
    counts = np.diff([*starts, len(values)])
    mean, square = (np.add.reduceat(power, starts) / counts for power in (values, values**2))
    return np.maximum(square - mean**2, 0)


def _angles_deg(cosines: Floats) -> Floats:
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))
