"""Stray points: a few that lie alone, away from all others, such as pixels without depth stored as (0, 0, 0)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.bounds import bounds
from grindvision.geometry.hash_grid import assign_cells, cell_key, cell_origin, find_slot
from grindvision.kernels import njit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MAX_STRAY = 0.002
"""Fraction of a cloud that may lie alone and be stray; what is larger is another part of the scene."""

CELLS_ACROSS = 40
"""Cells along the diagonal: points are alone where they share no cell, and no corner of one, with the rest."""

MIN_POINTS_PER_CELL = 1.0
"""Mean number of points per occupied cell below which a cloud is too thin to say what lies alone."""

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
        cell_of_point, keys, table_keys, table_cells = assign_cells(kept, cell_origin(kept, size), 1.0 / size)
        if len(kept) < MIN_POINTS_PER_CELL * len(keys):
            break
        group = _groups(keys, table_keys, table_cells)[cell_of_point]
        alone = np.bincount(group)[group] <= allowed
        if not alone.any() or alone.sum() + stray.sum() > allowed:
            break
        stray[np.flatnonzero(~stray)[alone]] = True
        kept = points[~stray]
    return stray


@njit(cache=True, nogil=True)
def _groups(keys: Integers, table_keys: Integers, table_cells: NDArray[np.int32]) -> Integers:
    """Group (C,) of every cell; cells that share a corner are of one group."""
    count = len(keys)
    groups = np.full(count, -1, dtype=np.int64)
    stack = np.empty(count, dtype=np.int64)
    axis = np.int64((1 << 21) - 1)
    number = 0
    for first in range(count):
        if groups[first] >= 0:
            continue
        groups[first] = number
        stack[0] = first
        waiting = 1
        while waiting > 0:
            waiting -= 1
            key = keys[stack[waiting]]
            i, j, k = (key >> 42) & axis, (key >> 21) & axis, key & axis
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    for dk in range(-1, 2):
                        slot = find_slot(table_keys, cell_key(i + di, j + dj, k + dk))
                        if table_keys[slot] < 0:
                            continue
                        other = table_cells[slot]
                        if groups[other] < 0:
                            groups[other] = number
                            stack[waiting] = other
                            waiting += 1
        number += 1
    return groups
