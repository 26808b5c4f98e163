"""Signed distances of points from a scanned surface: the planes of its surfels, blended where several are near."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry.hash_grid import CellGrid, cell_key, find_slot
from grindvision.geometry.neighbours import nearest_one
from grindvision.kernels import njit
from grindvision.parallel import parallel_map
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def signed_distances(target: Surfels, points: ArrayLike, max_mm: float) -> tuple[Floats, Floats, Floats]:
    """Signed distances (N,) of points (N, 3) from a surface of surfels, positive outside, its normals (N, 3) there, and
    the variance (N,).

    The planes around the nearest surfel are blended, weighted by their points and nearness along the surface. NaN
    where no surfel lies within ``max_mm`` or the point is beside the surface.
    """
    grid = target.grid
    planes = grid._replace(points=target.planes, order=np.arange(len(target)))

    def blended(part: Floats) -> tuple[Floats, Floats, Floats]:
        return _blended(part, float(max_mm), planes)

    halves = np.array_split(np.ascontiguousarray(points, dtype=float), 2)
    distances, normals, variances = (
        np.concatenate(column) for column in zip(*parallel_map(blended, halves), strict=True)
    )
    return distances, normals, variances


@njit(cache=True, nogil=True)
def _blended(
    queries: Floats,
    max_mm: float,
    grid: CellGrid,
) -> tuple[Floats, Floats, Floats]:
    """Signed distances, normals, variances; the grid's points are the ``planes`` of ``Surfels``, in its order."""
    planes, starts = grid.points, grid.starts
    table_keys, table_cells = grid.table_keys, grid.table_cells
    origin, per_mm = grid.origin_mm, 1.0 / grid.size_mm
    number = len(queries)
    distances, variances = np.full(number, np.nan), np.zeros(number)
    blended = np.zeros((number, 3))
    size = 1.0 / per_mm
    two_variances = 2 * (0.9 * size) ** 2
    for p in range(number):
        x, y, z = queries[p, 0], queries[p, 1], queries[p, 2]
        q, squared = nearest_one(x, y, z, max_mm, grid)
        if q < 0:
            continue
        nx, ny, nz = planes[q, 3], planes[q, 4], planes[q, 5]
        along = nx * (x - planes[q, 0]) + ny * (y - planes[q, 1]) + nz * (z - planes[q, 2])
        if squared - along * along > (1.2 * size) ** 2:
            continue
        # foot of the point on the nearest surfel's plane, around which the planes are blended
        fx, fy, fz = x - along * nx, y - along * ny, z - along * nz
        i0, j0, k0 = int((fx - origin[0]) * per_mm), int((fy - origin[1]) * per_mm), int((fz - origin[2]) * per_mm)
        total = distance = variance = 0.0
        ax = ay = az = 0.0
        for i in range(max(i0 - 1, 0), i0 + 2):
            for j in range(max(j0 - 1, 0), j0 + 2):
                for k in range(max(k0 - 1, 0), k0 + 2):
                    slot = find_slot(table_keys, cell_key(i, j, k))
                    if table_keys[slot] < 0:
                        continue
                    cell = table_cells[slot]
                    for c in range(starts[cell], starts[cell + 1]):
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
