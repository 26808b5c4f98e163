"""Stray points: a few that lie alone, away from all others, such as pixels without depth stored as (0, 0, 0)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.bounds import bounds
from grindvision.geometry.hash_grid import assign_cells, cell_indices, cell_origin
from grindvision.vision.surface.clustering import euclidean_clusters

Floats = NDArray[np.float64]

MAX_STRAY = 0.002
"""Fraction of a cloud that may lie alone and be stray; what is larger is another part of the scene."""

CELLS_ACROSS = 40
"""Cells along the diagonal: points are alone where they share no cell, and no corner of one, with the rest."""

MIN_POINTS_PER_CELL = 1.0
"""Mean number of points per occupied cell below which a cloud is too thin to say what lies alone."""

CORNER = 1.8
"""Cells whose indices are no farther apart than this share a face, an edge or a corner."""

MAX_ROUNDS = 6
"""What one far point hides, a nearer one, shows when it is gone."""


def stray_points(points: Floats) -> NDArray[np.bool_]:
    """Flags (N,) of the points (N, 3) that lie alone: groups of less than ``MAX_STRAY`` of all, a fortieth of the
    diagonal or more away from every other point.

    The order of the points plays no part.
    """
    stray = np.zeros(len(points), dtype=bool)
    allowed = int(MAX_STRAY * len(points))
    kept = points = np.ascontiguousarray(points, dtype=float)
    for _ in range(MAX_ROUNDS):
        low, high = bounds(kept)
        size = float(np.linalg.norm(high - low)) / CELLS_ACROSS
        if not (size > 0 and np.isfinite(size)):
            break
        cell_of_point, keys, _, _ = assign_cells(kept, cell_origin(kept, size), 1.0 / size)
        if len(kept) < MIN_POINTS_PER_CELL * len(keys):
            break
        group = euclidean_clusters(cell_indices(keys), CORNER)[cell_of_point]
        alone = np.bincount(group)[group] <= allowed
        if not alone.any() or alone.sum() + stray.sum() > allowed:
            break
        stray[np.flatnonzero(~stray)[alone]] = True
        kept = points[~stray]
    return stray
