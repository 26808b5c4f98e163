"""Euclidean clusters: points belong together when steps no longer than a given distance lead from one to the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry import check_points
from grindvision.geometry.hash_grid import CellGrid, build_cells, cell_key, find_slot
from grindvision.kernels import njit

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]


def euclidean_clusters(points: ArrayLike, distance_mm: float) -> Integers:
    """Number (N,) of each point's cluster, the largest cluster first (of equal ones, that of the earlier point)."""
    points = check_points(points, "points", min_points=0)
    if not distance_mm > 0:
        raise InputError(f"the cluster distance is {distance_mm} mm; it must be above zero")
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    # Two points of one cell of this size are never farther apart than the distance.
    grid = build_cells(points, distance_mm / np.sqrt(3) * (1 - 1e-9))
    cell_roots = _joined_cells(grid, float(distance_mm))
    root = np.empty(len(points), dtype=np.int64)
    root[grid.order] = np.repeat(cell_roots, np.diff(grid.starts))
    _, first, inverse, sizes = np.unique(root, return_index=True, return_inverse=True, return_counts=True)
    rank = np.empty(len(sizes), dtype=np.int64)
    rank[np.lexsort((first, -sizes))] = np.arange(len(sizes))
    return rank[inverse]


@njit(cache=True, nogil=True)
def _joined_cells(
    grid: CellGrid,
    distance: float,
) -> Integers:
    """Root cell of every cell once all cells with points near enough are joined."""
    points, order, starts = grid.points, grid.order, grid.starts
    table_keys, table_cells = grid.table_keys, grid.table_cells
    origin, per_mm = grid.origin_mm, 1.0 / grid.size_mm
    cells = len(starts) - 1
    parent = np.arange(cells)
    for cell in range(cells):
        p = order[starts[cell]]
        i = int((points[p, 0] - origin[0]) * per_mm)
        j = int((points[p, 1] - origin[1]) * per_mm)
        k = int((points[p, 2] - origin[2]) * per_mm)
        for di in range(-2, 3):
            for dj in range(-2, 3):
                for dk in range(-2, 3):
                    if i + di < 0 or j + dj < 0 or k + dk < 0:
                        continue
                    key = cell_key(i + di, j + dj, k + dk)
                    slot = find_slot(table_keys, key)
                    if table_keys[slot] != key or table_cells[slot] <= cell:
                        continue
                    other = table_cells[slot]
                    a, b = root_of(parent, cell), root_of(parent, other)
                    if a != b and _touch(grid, cell, other, distance):
                        parent[max(a, b)] = min(a, b)
    for cell in range(cells):
        parent[cell] = root_of(parent, cell)
    return parent


@njit(cache=True, nogil=True)
def root_of(parent: Integers, cell: int) -> int:
    """Root of a cell in the union-find forest ``parent``, halving the path on the way."""
    while parent[cell] != cell:
        parent[cell] = parent[parent[cell]]
        cell = parent[cell]
    return cell


@njit(cache=True, nogil=True)
def _touch(grid: CellGrid, cell: int, other: int, distance: float) -> bool:
    """Whether two cells have points within ``distance`` of each other."""
    points, order, starts = grid.points, grid.order, grid.starts
    for a in range(starts[cell], starts[cell + 1]):
        for b in range(starts[other], starts[other + 1]):
            total = 0.0
            for k in range(3):
                total += (points[order[a], k] - points[order[b], k]) ** 2
            if total <= distance * distance:
                return True
    return False
