"""Heights of points above a scanned surface: the planes of its surfels, blended where several are near."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry.neighbours import cell_key, find_slot, nearest_one
from grindvision.vision.surfels import Surfels

Floats = NDArray[np.float64]


def heights_above(good: Surfels, points: ArrayLike, most_mm: float) -> tuple[Floats, Floats, Floats]:
    """Signed heights (N,) of points (N, 3) above a surface of surfels, its normals (N, 3) there, and the variance (N,).

    The planes around the nearest surfel are blended, weighted by their points and nearness along the surface. NaN
    where no surfel lies within ``most_mm`` or the point is beside the surface.
    """
    grid, counts = good.grid, good.counts.astype(float)

    def blended(part: Floats) -> tuple[Floats, Floats, Floats]:
        return _blended(
            part, float(most_mm), good.normals, counts, good.noise_mm, good.roughness_mm, grid.points, grid.order,
            grid.starts, grid.table_keys, grid.table_cells, grid.origin_mm, 1.0 / grid.size_mm,
        )  # fmt: skip

    halves = np.array_split(np.ascontiguousarray(points, dtype=float), 2)
    with ThreadPoolExecutor(2) as pool:
        heights, normals, variances = (
            np.concatenate(column) for column in zip(*pool.map(blended, halves), strict=True)
        )
    return heights, normals, variances


@njit(cache=True, nogil=True)
def _blended(
    queries, most, normals, counts, noise, roughness, points, order, starts, table_keys, table_cells, origin, per_mm
):  # fmt: skip
    number = len(queries)
    heights, variances = np.full(number, np.nan), np.zeros(number)
    blended = np.zeros((number, 3))
    size = 1.0 / per_mm
    spread = 2 * (0.9 * size) ** 2
    for p in range(number):
        x, y, z = queries[p, 0], queries[p, 1], queries[p, 2]
        q, squared = nearest_one(x, y, z, most, points, order, starts, table_keys, table_cells, origin, per_mm)
        if q < 0:
            continue
        n = normals[q]
        along = n[0] * (x - points[q, 0]) + n[1] * (y - points[q, 1]) + n[2] * (z - points[q, 2])
        if squared - along * along > (1.2 * size) ** 2:
            continue
        # foot of the point on the nearest surfel's plane, around which the planes are blended
        fx, fy, fz = x - along * n[0], y - along * n[1], z - along * n[2]
        i0, j0, k0 = int((fx - origin[0]) * per_mm), int((fy - origin[1]) * per_mm), int((fz - origin[2]) * per_mm)
        total = height = variance = 0.0
        ax = ay = az = 0.0
        for i in range(i0 - 1, i0 + 2):
            for j in range(j0 - 1, j0 + 2):
                for k in range(k0 - 1, k0 + 2):
                    if i < 0 or j < 0 or k < 0:
                        continue
                    slot = find_slot(table_keys, cell_key(i, j, k))
                    if table_keys[slot] < 0:
                        continue
                    cell = table_cells[slot]
                    for at in range(starts[cell], starts[cell + 1]):
                        c = order[at]
                        m = normals[c]
                        if m[0] * n[0] + m[1] * n[1] + m[2] * n[2] < 0.8:
                            continue
                        dx, dy, dz = fx - points[c, 0], fy - points[c, 1], fz - points[c, 2]
                        up = m[0] * dx + m[1] * dy + m[2] * dz
                        lateral = dx * dx + dy * dy + dz * dz - up * up
                        weight = counts[c] * np.exp(-lateral / spread)
                        total += weight
                        height += weight * (
                            m[0] * (x - points[c, 0]) + m[1] * (y - points[c, 1]) + m[2] * (z - points[c, 2])
                        )
                        ax += weight * m[0]
                        ay += weight * m[1]
                        az += weight * m[2]
                        excess = max(roughness[c] ** 2 - noise[c] ** 2, 0.0)
                        variance += weight * (noise[c] ** 2 * weight / max(counts[c], 1.0) + 0.25 * excess * weight)
        if total == 0.0:
            continue
        heights[p] = height / total
        variances[p] = variance / (total * total)
        length = np.sqrt(ax * ax + ay * ay + az * az)
        blended[p, 0], blended[p, 1], blended[p, 2] = ax / length, ay / length, az / length
    return heights, blended, variances
