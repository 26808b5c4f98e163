"""Neighbours in point clouds through a grid of cubic cells: nearest point, and all points within a radius.

The kernels release the interpreter lock and start no threads; two clouds can be searched at once from two threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry.hash_grid import AXIS_CELLS, CellGrid, any_in_blocks, cell_key, find_slot, in_block
from grindvision.kernels import njit
from grindvision.records import by_content

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@by_content
@dataclass(frozen=True)
class Neighbourhoods:
    """Neighbours of M queries: those of query i are ``indices[starts[i]:starts[i + 1]]``.

    ``squared_mm2`` holds their squared distances.
    """

    starts: Integers
    indices: Integers
    squared_mm2: Floats

    def __len__(self) -> int:
        return len(self.starts) - 1


def nearest(grid: CellGrid, queries: ArrayLike, max_mm: float) -> tuple[Integers, Floats]:
    """Nearest grid point of each query (M, 3) within ``max_mm``: index (M,), -1 where none, and distance (M,).

    Exact. Fast while ``max_mm`` is a few cells; the distance is infinite where none was found.
    """
    queries = np.ascontiguousarray(queries, dtype=float)
    indices = np.empty(len(queries), dtype=np.int64)
    distances = np.empty(len(queries))
    _nearest_all(queries, float(max_mm), grid, indices, distances)
    return indices, distances


def within_radius(
    grid: CellGrid, queries: ArrayLike, radius_mm: float, max_neighbours: int | None = None
) -> Neighbourhoods:
    """All grid points within ``radius_mm`` of each query (M, 3), in no order; or the ``max_neighbours`` nearest ones.

    The radius may not exceed the grid's cell size. A query that is itself a grid point is its own neighbour.
    """
    if radius_mm > grid.size_mm * (1 + 1e-12):
        raise InputError(
            f"radius {radius_mm} mm exceeds the cell size {grid.size_mm} mm; build the cells as large as it"
        )
    queries = np.ascontiguousarray(queries, dtype=float)
    most = -1 if max_neighbours is None else int(max_neighbours)
    starts, indices, squared = _within_all(queries, float(radius_mm), most, grid)
    return Neighbourhoods(starts, indices, squared)


@njit(cache=True, nogil=True)
def nearest_one(
    x: float,
    y: float,
    z: float,
    max_mm: float,
    grid: CellGrid,
) -> tuple[int, float]:
    """Index and squared distance of the grid point nearest to (x, y, z) within ``max_mm``; -1 where there is none."""
    points, order, starts = grid.points, grid.order, grid.starts
    table_keys, table_cells = grid.table_keys, grid.table_cells
    bits, blocks = grid.block_bits, grid.blocks
    origin, per_mm = grid.origin_mm, 1.0 / grid.size_mm
    cx, cy, cz = (x - origin[0]) * per_mm, (y - origin[1]) * per_mm, (z - origin[2]) * per_mm
    i0, j0, k0 = int(np.floor(cx)), int(np.floor(cy)), int(np.floor(cz))
    inside = min(min(cx - i0, i0 + 1 - cx), min(cy - j0, j0 + 1 - cy), min(cz - k0, k0 + 1 - cz))
    best, best_squared = -1, max_mm * max_mm
    rings = int(max_mm * per_mm) + 1
    for ring in range(rings + 1):
        # all in cells: how far away this ring begins, and how far the best point is
        clear, limit = max(ring - 1 + inside, 0.0), best_squared * per_mm * per_mm
        if ring > 0 and clear * clear > limit:
            break
        if ring == 2 and best < 0:
            low = (i0 - rings) >> bits, (j0 - rings) >> bits, (k0 - rings) >> bits
            high = (i0 + rings) >> bits, (j0 + rings) >> bits, (k0 + rings) >> bits
            if not any_in_blocks(blocks, low, high):
                break
        for i in range(max(i0 - ring, 0), min(i0 + ring + 1, blocks.shape[0] << bits)):
            away_i = _gap(cx, i)
            if away_i > limit:
                continue
            for j in range(max(j0 - ring, 0), min(j0 + ring + 1, blocks.shape[1] << bits)):
                away_ij = away_i + _gap(cy, j)
                if away_ij > limit:
                    continue
                step = 1 if ring == 0 or abs(i - i0) == ring or abs(j - j0) == ring else 2 * ring
                for k in range(k0 - ring, k0 + ring + 1, step):
                    if k < 0 or k >= blocks.shape[2] << bits or away_ij + _gap(cz, k) > limit:
                        continue
                    if not in_block(blocks, bits, i, j, k):
                        continue
                    slot = find_slot(table_keys, cell_key(i, j, k))
                    if table_keys[slot] < 0:
                        continue
                    cell = table_cells[slot]
                    for at in range(starts[cell], starts[cell + 1]):
                        p = order[at]
                        dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                        squared = dx * dx + dy * dy + dz * dz
                        if squared < best_squared or (squared == best_squared and best < 0):
                            best, best_squared = p, squared
                            limit = best_squared * per_mm * per_mm
    return best, best_squared


@njit(cache=True, nogil=True, inline="always")
def _gap(place: float, cell: int) -> float:
    """Squared distance, in cells, of a place on an axis from a cell that does not hold it; 0 from the one that does."""
    away = max(cell - place, place - cell - 1, 0.0)
    return away * away


@njit(cache=True, nogil=True)
def _nearest_all(
    queries: Floats,
    max_mm: float,
    grid: CellGrid,
    indices: Integers,
    distances: Floats,
) -> None:
    """``nearest_one`` of every query (M, 3), into ``indices`` and ``distances`` (M,), infinite where there is none."""
    for q in range(len(queries)):
        best, squared = nearest_one(queries[q, 0], queries[q, 1], queries[q, 2], max_mm, grid)
        indices[q] = best
        distances[q] = np.sqrt(squared) if best >= 0 else np.inf


@njit(cache=True, nogil=True)
def _within_all(
    queries: Floats,
    radius: float,
    max_neighbours: int,
    grid: CellGrid,
) -> tuple[Integers, Integers, Floats]:
    """``Neighbourhoods`` of queries (M, 3), the ``max_neighbours`` nearest of each, or all where it is negative."""
    first = np.zeros(len(queries) + 1, dtype=np.int64)
    # generous: memory that is not written to is not taken
    indices = np.empty(128 * len(queries) + 64, dtype=np.int64)
    squares = np.empty(len(indices))
    used = q = 0
    while q < len(queries):
        end = _within_one(queries[q], radius, used, indices, squares, grid)
        if end < 0:
            more, more_squares = np.empty(2 * len(indices), dtype=np.int64), np.empty(2 * len(indices))
            more[:used], more_squares[:used] = indices[:used], squares[:used]
            indices, squares = more, more_squares
            continue
        if 0 <= max_neighbours < end - used:
            rank = used + np.argsort(squares[used:end], kind="mergesort")[:max_neighbours]
            indices[used : used + max_neighbours], squares[used : used + max_neighbours] = indices[rank], squares[rank]
            end = used + max_neighbours
        used = end
        q += 1
        first[q] = used
    return first, indices[:used], squares[:used]


@njit(cache=True, nogil=True)
def _within_one(
    query: Floats,
    radius: float,
    used: int,
    indices: Integers,
    squares: Floats,
    grid: CellGrid,
) -> int:
    """Append the neighbours of one query from place ``used`` on: the place behind the last; -1 when there is no room.

    Arrays that grow are replaced outside, as in ``_enter``.
    """
    points, order, starts = grid.points, grid.order, grid.starts
    table_keys, table_cells = grid.table_keys, grid.table_cells
    origin, per_mm = grid.origin_mm, 1.0 / grid.size_mm
    x, y, z = query[0], query[1], query[2]
    cx, cy, cz = (x - origin[0]) * per_mm, (y - origin[1]) * per_mm, (z - origin[2]) * per_mm
    i0, j0, k0 = int(np.floor(cx)), int(np.floor(cy)), int(np.floor(cz))
    limit = radius * radius
    reach = limit * per_mm * per_mm * (1 + 1e-9)
    for i in range(max(i0 - 1, 0), min(i0 + 2, AXIS_CELLS)):
        for j in range(max(j0 - 1, 0), min(j0 + 2, AXIS_CELLS)):
            for k in range(max(k0 - 1, 0), min(k0 + 2, AXIS_CELLS)):
                if _gap(cx, i) + _gap(cy, j) + _gap(cz, k) > reach:
                    continue
                slot = find_slot(table_keys, cell_key(i, j, k))
                if table_keys[slot] < 0:
                    continue
                cell = table_cells[slot]
                if used + starts[cell + 1] - starts[cell] > len(indices):
                    return -1
                for at in range(starts[cell], starts[cell + 1]):
                    p = order[at]
                    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    # always written, and overwritten if too far: a third are near, no processor guesses which
                    indices[used] = p
                    squares[used] = dx * dx + dy * dy + dz * dz
                    used += squares[used] <= limit
    return used
