"""A scan as small planes (surfels): one per cubic cell, with its mean, normal, number of points and noise.

One pass over the points; afterwards every stage works on some tens of thousands of surfels and returns to the points
only where it matters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import check_points
from grindvision.geometry.bounds import bounds
from grindvision.geometry.hash_grid import (
    CellGrid,
    assign_cells,
    cell_key,
    cell_origin,
    count_cells,
    find_slot,
    grid_of_means,
)
from grindvision.kernels import njit
from grindvision.records import by_content
from grindvision.vision.surface.normals import smallest_eigenpair

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MIN_FLATNESS = 1e-4
"""A plane is fitted where the two larger variances of the points are nearer to each other than this ratio: points in
one line lie in any plane through it, and rounding would choose."""


USUAL_EXCESS = 2.0
"""A plane that misses the points around by so many times the usual noise beyond its own counts half."""


@by_content
@dataclass(frozen=True)
class Surfels:
    """Planes of a scan, one per occupied cell of ``grid``; the grid's points are the means of the cells' points.

    ``normals`` (M, 3) unit, unsigned until oriented, zero where no plane could be fitted; ``counts`` (M,) points per
    cell; ``noise_mm`` (M,) standard deviation of the cell's points along the normal; ``roughness_mm`` (M,) rms distance
    of the points of the 27 cells around from their common plane.
    """

    grid: CellGrid
    normals: Floats
    counts: Integers
    noise_mm: Floats
    roughness_mm: Floats

    @property
    def points(self) -> Floats:
        """Means (M, 3) of the cells' points, mm."""
        return self.grid.points

    @property
    def excess_mm2(self) -> Floats:
        """Variances (M,) of the points about a common plane beyond the noise: edges, and surfaces that curve."""
        return np.maximum(self.roughness_mm**2 - self.noise_mm**2, 0)

    @cached_property
    def planes(self) -> Floats:
        """Rows (M, 8) in the order of the grid's cells: mean, normal, number of points, variance of the plane's height.

        A surfel is one row, and a cell's rows lie together: one line of the processor's cache each.
        """
        variance = self.noise_mm**2 / np.maximum(self.counts, 1) + 0.25 * self.excess_mm2
        rows = np.empty((len(self), 8))
        rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7] = self.points, self.normals, self.counts, variance
        return rows[self.grid.order]

    @cached_property
    def trusted_planes(self) -> Floats:
        """``planes`` in which a plane that misses its points counts for less than its number of points.

        A plane through a corner runs through neither face. Beside planes that err by the noise alone it must not count.
        """
        usual = float(np.median(self.noise_mm)) if len(self) else 0.0
        rows = self.planes.copy()
        if usual > 0:
            rows[:, 6] /= 1 + self.excess_mm2[self.grid.order] / max((USUAL_EXCESS * usual) ** 2, 1e-300)
        return rows

    def __len__(self) -> int:
        return len(self.counts)

    def __str__(self) -> str:
        return f"{len(self):,} surfels of {self.grid.size_mm:.3g} mm, noise {np.median(self.noise_mm):.3g} mm"


def build_surfels(points: ArrayLike, size_mm: float) -> Surfels:
    """Gather points (N, 3) into cells of edge ``size_mm``; a cell's plane is fitted over the 27 cells around it."""
    points = np.ascontiguousarray(points, dtype=float)
    origin = cell_origin(points, size_mm)
    cell_of_point, keys, table_keys, table_cells = assign_cells(points, origin, 1.0 / size_mm)
    sums = _moments(points, cell_of_point, len(keys), origin, 1.0 / size_mm)
    means, normals, noise, roughness = _fit_planes(keys, sums, table_keys, table_cells, origin, float(size_mm))
    grid = grid_of_means(means, size_mm, origin, keys, (table_keys, table_cells))
    return Surfels(grid, normals, sums[:, 0].astype(np.int64), noise, roughness)


def surface_area(points: ArrayLike) -> float:
    """Rough area in mm^2 of the scanned surface: occupied cells of 1/70 of the diagonal.

    Raises:
        DegenerateError: fewer than 10 points, or all in one place.
    """
    points = np.ascontiguousarray(check_points(points, "points", min_points=10))
    low, high = bounds(points)
    size = float(np.linalg.norm(high - low)) / 70
    if not size > 0:
        raise DegenerateError("all points of the cloud coincide; is this the right file?")
    cells = count_cells(points, cell_origin(points, size), 1.0 / size)
    return cells * size**2 / 1.5


@njit(cache=True, nogil=True)
def _moments(points: Floats, cell_of_point: NDArray[np.int32], cells: int, origin: Floats, per_mm: float) -> Floats:
    """Per cell: number, sum and second moments of its points about the cell's corner, in cells."""
    sums = np.zeros((cells, 10))
    for p in range(len(points)):
        x = (points[p, 0] - origin[0]) * per_mm
        y = (points[p, 1] - origin[1]) * per_mm
        z = (points[p, 2] - origin[2]) * per_mm
        x, y, z = x - int(x), y - int(y), z - int(z)
        row = sums[cell_of_point[p]]
        row[0] += 1
        row[1] += x
        row[2] += y
        row[3] += z
        row[4] += x * x
        row[5] += x * y
        row[6] += x * z
        row[7] += y * y
        row[8] += y * z
        row[9] += z * z
    return sums


@njit(cache=True, nogil=True)
def _fit_planes(
    keys: Integers, sums: Floats, table_keys: Integers, table_cells: NDArray[np.int32], origin: Floats, size: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Means, normals, noise and roughness of the cells from their moments (``_moments``), as ``Surfels`` has them."""
    cells = len(keys)
    means, normals = np.empty((cells, 3)), np.zeros((cells, 3))
    noise, roughness = np.zeros(cells), np.zeros(cells)
    axis = np.int64((1 << 21) - 1)
    for c in range(cells):
        key = keys[c]
        i, j, k = (key >> 42) & axis, (key >> 21) & axis, key & axis
        number = sums[c, 0]
        means[c, 0] = origin[0] + (i + sums[c, 1] / number) * size
        means[c, 1] = origin[1] + (j + sums[c, 2] / number) * size
        means[c, 2] = origin[2] + (k + sums[c, 3] / number) * size
        n = x = y = z = xx = xy = xz = yy = yz = zz = 0.0
        for di in range(-1, 2):
            for dj in range(-1, 2):
                for dk in range(-1, 2):
                    slot = find_slot(table_keys, cell_key(i + di, j + dj, k + dk))
                    if table_keys[slot] < 0:
                        continue
                    s = sums[table_cells[slot]]
                    n += s[0]
                    x += s[1] + di * s[0]
                    y += s[2] + dj * s[0]
                    z += s[3] + dk * s[0]
                    xx += s[4] + di * (2 * s[1] + di * s[0])
                    xy += s[5] + di * s[2] + dj * s[1] + di * dj * s[0]
                    xz += s[6] + di * s[3] + dk * s[1] + di * dk * s[0]
                    yy += s[7] + dj * (2 * s[2] + dj * s[0])
                    yz += s[8] + dj * s[3] + dk * s[2] + dj * dk * s[0]
                    zz += s[9] + dk * (2 * s[3] + dk * s[0])
        if n < 4:
            continue
        xx, xy, xz, yy, yz, zz = (
            xx - x * x / n, xy - x * y / n, xz - x * z / n, yy - y * y / n, yz - y * z / n, zz - z * z / n
        )  # fmt: skip
        value, a, b, d = smallest_eigenpair(xx, xy, xz, yy, yz, zz)
        others = xx + yy + zz - value
        product = xx * yy + xx * zz + yy * zz - xy * xy - xz * xz - yz * yz - value * others
        if product < MIN_FLATNESS * others * others:
            continue
        normals[c, 0], normals[c, 1], normals[c, 2] = a, b, d
        roughness[c] = size * np.sqrt(max(value, 0.0) / (n - 3))
        s = sums[c]
        along = (
            a * a * (s[4] - s[1] * s[1] / number)
            + b * b * (s[7] - s[2] * s[2] / number)
            + d * d * (s[9] - s[3] * s[3] / number)
            + 2 * a * b * (s[5] - s[1] * s[2] / number)
            + 2 * a * d * (s[6] - s[1] * s[3] / number)
            + 2 * b * d * (s[8] - s[2] * s[3] / number)
        )
        noise[c] = size * np.sqrt(max(along, 0.0) / (number - 1)) if number > 1 else roughness[c]
    return means, normals, noise, roughness


def same_within(source: Surfels, target: Surfels) -> float:
    """Distance in mm within which two surfaces count as the same: their roughness, and a little of the cell size."""
    rough = np.hypot(np.median(source.roughness_mm), np.median(target.roughness_mm))
    return float(3 * rough + 0.1 * target.grid.size_mm)
