"""Neighbours in point clouds through a hashed grid of cubic cells: nearest point, and all points within a radius.

The kernels release the interpreter lock and start no threads; two clouds can be searched at once from two threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

AXIS_CELLS = 1 << 20
"""Most cells along one axis; three axes share one 63-bit key."""

_EMPTY = np.int64(-1)
_MIX = np.int64(-7046029254386353131)


@dataclass(frozen=True)
class CellGrid:
    """Points (N, 3) sorted into cubic cells of ``size_mm``; the cells are found through a hash table.

    ``order`` (N,) lists the points cell by cell; cell c owns ``order[starts[c]:starts[c + 1]]``. ``table_keys`` and
    ``table_cells`` are the open-addressed table from packed cell coordinates to c.
    """

    points: Floats
    size_mm: float
    origin_mm: Floats
    order: Integers
    starts: Integers
    table_keys: Integers
    table_cells: NDArray[np.int32]

    def __str__(self) -> str:
        return f"{len(self.points):,} points in {len(self.starts) - 1:,} cells of {self.size_mm:.3g} mm"


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


def build_cells(points: ArrayLike, size_mm: float) -> CellGrid:
    """Sort points (N, 3) into cubic cells of edge ``size_mm``.

    Raises:
        InputError: the size is not above zero, or so small that an axis has more than ``AXIS_CELLS`` cells.
    """
    points = np.ascontiguousarray(points, dtype=float)
    origin = cell_origin(points, size_mm)
    cell_of_point, keys, table_keys, table_cells = assign_cells(points, origin, 1.0 / size_mm)
    order, starts = _sorted_by_cell(cell_of_point, len(keys))
    return CellGrid(points, float(size_mm), origin, order, starts, table_keys, table_cells)


def cell_origin(points: Floats, size_mm: float) -> Floats:
    """Corner (3,) from which cells are counted; checks that the cells can be keyed.

    It lies a cell and a half below the points: the outermost ones, which define it, then stand in the middle of their
    cell, and rounding moves none of them into another.
    """
    if not size_mm > 0:
        raise InputError(f"the cell size is {size_mm} mm; it must be above zero")
    if len(points) == 0:
        return np.zeros(3)
    low, high = bounds(points)
    cells = float((high - low).max()) / size_mm
    if not cells < AXIS_CELLS - 4:
        raise InputError(
            f"the points span {float((high - low).max()):.3g} mm, {cells:.3g} cells of {size_mm:.3g} mm; drop far"
            " outliers or take larger cells"
        )
    return low - 1.5 * size_mm


@njit(cache=True, nogil=True)
def bounds(points):
    """Lowest and highest coordinates (3,), (3,) of points (N, 3)."""
    x = x_low = points[0, 0]
    y = y_low = points[0, 1]
    z = z_low = points[0, 2]
    for p in range(len(points)):
        x_low, y_low, z_low = min(x_low, points[p, 0]), min(y_low, points[p, 1]), min(z_low, points[p, 2])
        x, y, z = max(x, points[p, 0]), max(y, points[p, 1]), max(z, points[p, 2])
    return np.array([x_low, y_low, z_low]), np.array([x, y, z])


def nearest(grid: CellGrid, queries: ArrayLike, most_mm: float) -> tuple[Integers, Floats]:
    """Nearest grid point of each query (M, 3) within ``most_mm``: index (M,), -1 where none, and distance (M,).

    Exact. Fast while ``most_mm`` is a few cells; the distance is infinite where none was found.
    """
    queries = np.ascontiguousarray(queries, dtype=float)
    indices = np.empty(len(queries), dtype=np.int64)
    distances = np.empty(len(queries))
    _nearest_all(
        queries, float(most_mm), grid.points, grid.order, grid.starts, grid.table_keys, grid.table_cells,
        grid.origin_mm, 1.0 / grid.size_mm, indices, distances,
    )  # fmt: skip
    return indices, distances


def within_radius(grid: CellGrid, queries: ArrayLike, radius_mm: float, most: int | None = None) -> Neighbourhoods:
    """All grid points within ``radius_mm`` of each query (M, 3), in no order; or the ``most`` nearest ones.

    The radius may not exceed the grid's cell size. A query that is itself a grid point is its own neighbour.
    """
    if radius_mm > grid.size_mm * (1 + 1e-12):
        raise InputError(
            f"radius {radius_mm} mm exceeds the cell size {grid.size_mm} mm; build the cells as large as it"
        )
    queries = np.ascontiguousarray(queries, dtype=float)
    starts, indices, squared = _within_all(
        queries, float(radius_mm), -1 if most is None else int(most), grid.points, grid.order, grid.starts,
        grid.table_keys, grid.table_cells, grid.origin_mm, 1.0 / grid.size_mm,
    )  # fmt: skip
    return Neighbourhoods(starts, indices, squared)


@njit(cache=True, nogil=True, inline="always")
def cell_key(i, j, k):
    """Pack three non-negative cell coordinates into one key."""
    return (np.int64(i) << 42) | (np.int64(j) << 21) | np.int64(k)


@njit(cache=True, nogil=True)
def find_slot(table_keys, key):
    """Slot of ``key`` in the open-addressed table, or the free slot where it belongs.

    Eight cells in a row along z begin their search in one line of the processor's cache.
    """
    mask = table_keys.size - 1
    slot = ((((key >> 3) * _MIX) >> 30) & ~7 | (key & 7)) & mask
    while table_keys[slot] != _EMPTY and table_keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def grown_table(keys, count, size):
    """Fresh table of ``size`` slots (a power of two) holding the first ``count`` keys."""
    table_keys = np.full(size, _EMPTY, dtype=np.int64)
    table_cells = np.empty(size, dtype=np.int32)
    for cell in range(count):
        slot = find_slot(table_keys, keys[cell])
        table_keys[slot] = keys[cell]
        table_cells[slot] = cell
    return table_keys, table_cells


@njit(cache=True, nogil=True)
def assign_cells(points, origin, per_mm):
    """Cell number of each point, keys of the cells in order of first appearance, and the table."""
    cell_of_point = np.empty(len(points), dtype=np.int32)
    keys = np.empty(2048, dtype=np.int64)
    table_keys, table_cells = grown_table(keys, 0, 2 * len(keys))
    done = count = 0
    while True:
        done, count = _enter(points, done, origin, per_mm, keys, count, table_keys, table_cells, cell_of_point)
        if done == len(points):
            return cell_of_point, keys[:count].copy(), table_keys, table_cells
        more = np.empty(2 * len(keys), dtype=np.int64)
        more[:count] = keys
        keys = more
        table_keys, table_cells = grown_table(keys, count, 2 * len(keys))


@njit(cache=True, nogil=True)
def _enter(points, first, origin, per_mm, keys, count, table_keys, table_cells, cell_of_point):
    """Number the cells of points from ``first`` on, while there is room for keys: where it stopped, and how many.

    Arrays that grow are replaced outside: a loop that replaces its arrays counts references in every round. Neighbours
    in a scan's row share a cell: the table is asked when it changes.
    """
    last, cell = _EMPTY, 0
    for p in range(first, len(points)):
        i = int((points[p, 0] - origin[0]) * per_mm)
        j = int((points[p, 1] - origin[1]) * per_mm)
        k = int((points[p, 2] - origin[2]) * per_mm)
        key = cell_key(i, j, k)
        if key != last:
            slot = find_slot(table_keys, key)
            if table_keys[slot] == _EMPTY:
                if count == len(keys):
                    return p, count
                keys[count] = key
                table_keys[slot] = key
                table_cells[slot] = count
                count += 1
            last, cell = key, table_cells[slot]
        cell_of_point[p] = cell
    return len(points), count


@njit(cache=True, nogil=True)
def _sorted_by_cell(cell_of_point, cells):
    starts = np.zeros(cells + 1, dtype=np.int64)
    for cell in cell_of_point:
        starts[cell + 1] += 1
    for cell in range(cells):
        starts[cell + 1] += starts[cell]
    fill = starts[:-1].copy()
    order = np.empty(len(cell_of_point), dtype=np.int64)
    for p in range(len(cell_of_point)):
        cell = cell_of_point[p]
        order[fill[cell]] = p
        fill[cell] += 1
    return order, starts


@njit(cache=True, nogil=True)
def nearest_one(x, y, z, most_mm, points, order, starts, table_keys, table_cells, origin, per_mm):
    """Index and squared distance of the grid point nearest to (x, y, z) within ``most_mm``; -1 where there is none."""
    cx, cy, cz = (x - origin[0]) * per_mm, (y - origin[1]) * per_mm, (z - origin[2]) * per_mm
    i0, j0, k0 = int(np.floor(cx)), int(np.floor(cy)), int(np.floor(cz))
    inside = min(min(cx - i0, i0 + 1 - cx), min(cy - j0, j0 + 1 - cy), min(cz - k0, k0 + 1 - cz))
    best, best_squared = -1, most_mm * most_mm
    rings = int(most_mm * per_mm) + 1
    for ring in range(rings + 1):
        # all in cells: how far away this ring begins, and how far the best point is
        clear, limit = max(ring - 1 + inside, 0.0), best_squared * per_mm * per_mm
        if ring > 0 and clear * clear > limit:
            break
        for i in range(max(i0 - ring, 0), min(i0 + ring + 1, AXIS_CELLS)):
            away_i = _gap(cx, i)
            if away_i > limit:
                continue
            for j in range(max(j0 - ring, 0), min(j0 + ring + 1, AXIS_CELLS)):
                away_ij = away_i + _gap(cy, j)
                if away_ij > limit:
                    continue
                step = 1 if ring == 0 or abs(i - i0) == ring or abs(j - j0) == ring else 2 * ring
                for k in range(k0 - ring, k0 + ring + 1, step):
                    if k < 0 or k >= AXIS_CELLS or away_ij + _gap(cz, k) > limit:
                        continue
                    slot = find_slot(table_keys, cell_key(i, j, k))
                    if table_keys[slot] == _EMPTY:
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
def _gap(place, cell):
    """Squared distance, in cells, of a place on an axis from a cell that does not hold it; 0 from the one that does."""
    away = max(cell - place, place - cell - 1, 0.0)
    return away * away


@njit(cache=True, nogil=True)
def _nearest_all(
    queries, most_mm, points, order, starts, table_keys, table_cells, origin, per_mm, indices, distances
):  # fmt: skip
    for q in range(len(queries)):
        best, squared = nearest_one(
            queries[q, 0], queries[q, 1], queries[q, 2], most_mm, points, order, starts, table_keys, table_cells,
            origin, per_mm,
        )  # fmt: skip
        indices[q] = best
        distances[q] = np.sqrt(squared) if best >= 0 else np.inf


@njit(cache=True, nogil=True)
def _within_all(queries, radius, most, points, order, starts, table_keys, table_cells, origin, per_mm):
    first = np.zeros(len(queries) + 1, dtype=np.int64)
    # generous: memory that is not written to is not taken
    indices = np.empty(128 * len(queries) + 64, dtype=np.int64)
    squares = np.empty(len(indices))
    used = q = 0
    while q < len(queries):
        end = _within_one(
            queries[q], radius, used, indices, squares, points, order, starts, table_keys, table_cells, origin, per_mm
        )
        if end < 0:
            more, more_squares = np.empty(2 * len(indices), dtype=np.int64), np.empty(2 * len(indices))
            more[:used], more_squares[:used] = indices[:used], squares[:used]
            indices, squares = more, more_squares
            continue
        if 0 <= most < end - used:
            rank = used + np.argsort(squares[used:end], kind="mergesort")[:most]
            indices[used : used + most], squares[used : used + most] = indices[rank], squares[rank]
            end = used + most
        used = end
        q += 1
        first[q] = used
    return first, indices[:used], squares[:used]


@njit(cache=True, nogil=True)
def _within_one(
    query, radius, used, indices, squares, points, order, starts, table_keys, table_cells, origin, per_mm
):  # fmt: skip
    """Append the neighbours of one query from place ``used`` on: the place behind the last; -1 when there is no room.

    Arrays that grow are replaced outside, as in ``_enter``.
    """
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
                if table_keys[slot] == _EMPTY:
                    continue
                cell = table_cells[slot]
                if used + starts[cell + 1] - starts[cell] > len(indices):
                    return -1
                for at in range(starts[cell], starts[cell + 1]):
                    p = order[at]
                    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    squared = dx * dx + dy * dy + dz * dz
                    if squared <= limit:
                        indices[used], squares[used] = p, squared
                        used += 1
    return used
