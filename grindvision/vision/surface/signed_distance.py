"""Signed distances of points from a scanned surface: the planes of its surfels, blended where several are near."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry.hash_grid import AXIS_CELLS, CellGrid, cell_key, find_slot
from grindvision.geometry.neighbours import nearest_one
from grindvision.kernels import njit
from grindvision.parallel import parallel_map
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class CellBlocks(NamedTuple):
    """The rows of a target in the 27 cells around each of N points: what ``signed_distances`` has looked up.

    ``keys`` (N,) of the middle cells, -1 where none has been looked up; ``runs`` (N, 9, 2): first row, and the one
    behind the last, of each three cells in a row along z, which lie together.
    """

    keys: Integers
    runs: NDArray[np.int32]

    @classmethod
    def unknown(cls, count: int) -> CellBlocks:
        """Blocks of so many points, none looked up yet."""
        return cls(np.full(count, -1, dtype=np.int64), np.empty((count, 9, 2), dtype=np.int32))


def signed_distances(
    target: Surfels, points: ArrayLike, max_mm: float, blocks: CellBlocks | None = None, trusted: bool = False
) -> tuple[Floats, Floats, Floats]:
    """Signed distances (N,) of points (N, 3) from a surface of surfels, positive outside, its normals (N, 3) there, and
    the variance (N,).

    The planes around the nearest surfel are blended, weighted by their points and nearness along the surface. NaN
    where no surfel lies within ``max_mm`` or the point is beside the surface. Who asks for the same points again, moved
    a little, gives the same ``blocks`` each time: most points stay in their cell. ``trusted``: planes that miss their
    own points, as those through corners do, count for less.
    """
    grid = target.grid
    rows = target.trusted_planes if trusted else target.planes
    planes = grid._replace(points=rows, order=np.arange(len(target)))
    queries = np.ascontiguousarray(points, dtype=float)
    blocks = CellBlocks.unknown(len(queries)) if blocks is None else blocks

    def blended(part: Floats, keys: Integers, runs: NDArray[np.int32]) -> tuple[Floats, Floats, Floats]:
        return _blended(part, float(max_mm), planes, keys, runs)

    halves = (np.array_split(whole, 2) for whole in (queries, *blocks))
    distances, normals, variances = (
        np.concatenate(column) for column in zip(*parallel_map(blended, *halves), strict=True)
    )
    return distances, normals, variances


@njit(cache=True, nogil=True)
def _runs_around(i: int, j: int, k: int, grid: CellGrid, runs: NDArray[np.int32]) -> None:
    """Enter the ``runs`` (9, 2) of rows in the cells around a cell, as ``CellBlocks`` has them."""
    for column in range(9):
        first, end = 0, 0
        for dk in range(-1, 2):
            slot = find_slot(grid.table_keys, cell_key(i + column // 3 - 1, j + column % 3 - 1, k + dk))
            if grid.table_keys[slot] >= 0:
                cell = grid.table_cells[slot]
                first = grid.starts[cell] if end == 0 else first
                end = grid.starts[cell + 1]
        runs[column, 0], runs[column, 1] = first, end


@njit(cache=True, nogil=True)
def _nearest_row(
    x: float, y: float, z: float, max_mm: float, rows: Floats, runs: NDArray[np.int32]
) -> tuple[int, float]:
    """The row nearest to (x, y, z) within ``max_mm`` of those in ``runs``, -1 where none is, and its squared
    distance."""
    best, best_squared = -1, max_mm * max_mm
    for column in range(9):
        for q in range(runs[column, 0], runs[column, 1]):
            dx, dy, dz = rows[q, 0] - x, rows[q, 1] - y, rows[q, 2] - z
            squared = dx * dx + dy * dy + dz * dz
            if squared < best_squared:
                best, best_squared = q, squared
    return best, best_squared


@njit(cache=True, nogil=True)
def _blended(
    queries: Floats, max_mm: float, grid: CellGrid, keys: Integers, runs: NDArray[np.int32]
) -> tuple[Floats, Floats, Floats]:
    """Signed distances, normals, variances; the grid's points are the ``planes`` of ``Surfels``, in its order.

    ``keys`` and ``runs`` are the ``CellBlocks`` of the queries, brought up to date in place.
    """
    planes, origin, size = grid.points, grid.origin_mm, grid.size_mm
    per_mm = 1.0 / size
    number = len(queries)
    distances, variances = np.full(number, np.nan), np.zeros(number)
    blended = np.zeros((number, 3))
    two_variances = 2 * (0.9 * size) ** 2
    around_foot = np.empty((9, 2), dtype=np.int32)
    for p in range(number):
        x, y, z = queries[p, 0], queries[p, 1], queries[p, 2]
        cx, cy, cz = (x - origin[0]) * per_mm, (y - origin[1]) * per_mm, (z - origin[2]) * per_mm
        if min(cx, cy, cz) < 1 or max(cx, cy, cz) > AXIS_CELLS - 2:  # no cell, or one whose block is cut off
            key = np.int64(-1)
            q, squared = nearest_one(x, y, z, max_mm, grid)
        else:
            i, j, k = int(cx), int(cy), int(cz)
            key = cell_key(i, j, k)
            if key != keys[p]:
                _runs_around(i, j, k, grid, runs[p])
                keys[p] = key
            q, squared = _nearest_row(x, y, z, max_mm, planes, runs[p])
            inside = min(min(cx - i, i + 1 - cx), min(cy - j, j + 1 - cy), min(cz - k, k + 1 - cz))
            if squared * per_mm * per_mm > (1 + inside) ** 2:  # one outside the block may be nearer
                q, squared = nearest_one(x, y, z, max_mm, grid)
        if q < 0:
            continue
        nx, ny, nz = planes[q, 3], planes[q, 4], planes[q, 5]
        along = nx * (x - planes[q, 0]) + ny * (y - planes[q, 1]) + nz * (z - planes[q, 2])
        if squared - along * along > (1.2 * size) ** 2:
            continue
        # foot of the point on the nearest surfel's plane, around which the planes are blended
        fx, fy, fz = x - along * nx, y - along * ny, z - along * nz
        i, j, k = int((fx - origin[0]) * per_mm), int((fy - origin[1]) * per_mm), int((fz - origin[2]) * per_mm)
        block = runs[p]
        if cell_key(i, j, k) != key:
            block = around_foot
            _runs_around(i, j, k, grid, block)
        total = distance = variance = 0.0
        ax = ay = az = 0.0
        for column in range(9):
            for c in range(block[column, 0], block[column, 1]):
                mx, my, mz = planes[c, 3], planes[c, 4], planes[c, 5]
                facing = mx * nx + my * ny + mz * nz
                if facing < 0.8:
                    continue
                dx, dy, dz = fx - planes[c, 0], fy - planes[c, 1], fz - planes[c, 2]
                up = mx * dx + my * dy + mz * dz
                lateral = dx * dx + dy * dy + dz * dz - up * up
                weight = planes[c, 6] * np.exp(-lateral / two_variances)
                total += weight
                distance += weight * (up + facing * along)
                ax += weight * mx
                ay += weight * my
                az += weight * mz
                variance += weight * weight * planes[c, 7]
        if total == 0.0:
            continue
        distances[p] = distance / total
        variances[p] = variance / (total * total)
        length = np.sqrt(ax * ax + ay * ay + az * az)
        blended[p, 0], blended[p, 1], blended[p, 2] = ax / length, ay / length, az / length
    return distances, blended, variances
