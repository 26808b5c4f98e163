"""A scan as a height field over a plane: raster, smoothing and the morphological closing that fills valleys."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry.bounds import bounds_in_frame
from grindvision.kernels import njit
from grindvision.records import by_content

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: The area that points cover is counted in cells that hold at least so many of them.
MIN_POINTS_PER_CELL = 5


@by_content
@dataclass(frozen=True)
class HeightField:
    """Mean heights of a cloud's points over square cells of a plane, all in the field frame.

    ``T_field_cloud`` (4, 4) turns cloud coordinates into field coordinates: z is the height, x and y run along the rows
    and columns. ``heights_mm`` (R, C) is NaN where no point lies, ``counts`` (R, C) are the points of a cell; cell
    (i, j) covers x from ``i * cell_mm``.
    """

    T_field_cloud: Floats
    cell_mm: float
    heights_mm: Floats
    counts: Integers

    @property
    def filled(self) -> NDArray[np.bool_]:
        """Cells (R, C) that hold a point."""
        return self.counts > 0

    def positions(self, rows: ArrayLike, columns: ArrayLike) -> Floats:
        """Field coordinates x, y (N, 2) in mm of cell centres."""
        return (np.stack([np.asarray(rows), np.asarray(columns)], axis=-1) + 0.5) * self.cell_mm

    def __str__(self) -> str:
        rows, columns = self.heights_mm.shape
        return f"height field of {rows} x {columns} cells of {self.cell_mm:.3g} mm, {self.filled.mean():.0%} filled"


def rasterise(
    points: ArrayLike, T_field_cloud: ArrayLike, cell_mm: float, bounds: tuple[Floats, Floats] | None = None
) -> HeightField:
    """Mean height of the points (N, 3) over every cell; the frame is shifted so that all cells count from zero.

    ``bounds`` are the points' ``bounds_in_frame`` for callers who know them.
    """
    points = np.ascontiguousarray(points, dtype=float)
    frame = np.asarray(T_field_cloud, dtype=float)
    low, high = bounds or bounds_in_frame(points, frame)
    shifted = frame.copy()
    shifted[:2, 3] -= low[:2] - cell_mm / 2
    shape = np.floor((high[:2] - low[:2]) / cell_mm + 0.5).astype(int) + 1
    return HeightField(shifted, float(cell_mm), *_cell_means(points, shifted, cell_mm, shape[0], shape[1]))


def coarser(field: HeightField, factor: int) -> HeightField:
    """The same field over cells that each take ``factor`` x ``factor`` of its own."""
    if factor == 1:
        return field
    heights, counts = _merged(field.heights_mm, field.counts, factor)
    return HeightField(field.T_field_cloud, field.cell_mm * factor, heights, counts)


def spacing_of(points: ArrayLike, T_field_cloud: ArrayLike) -> float:
    """Typical distance in mm of neighbouring points over the field's plane: root of covered area per point."""
    points = np.ascontiguousarray(points, dtype=float)
    low, high = bounds_in_frame(points, np.asarray(T_field_cloud, dtype=float))
    cell = 2 * float(max(high[0] - low[0], high[1] - low[1])) / 200
    field = rasterise(points, T_field_cloud, cell, (low, high))
    cells = int(field.filled.sum())
    while cells * MIN_POINTS_PER_CELL > len(points):
        field = coarser(field, 2)
        cells = int(field.filled.sum())
    return float(np.sqrt(cells * field.cell_mm**2 / len(points)))


def smoothed(field: HeightField, sigma_mm: float) -> Floats:
    """Heights (R, C) after a Gaussian of ``sigma_mm`` that knows which cells are empty, float32; NaN stays."""
    sigma = sigma_mm / field.cell_mm
    reach = int(3 * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-9)) ** 2)
    level = float(np.nanmean(field.heights_mm))
    return np.asarray(_weighted_means((field.heights_mm - level).astype(np.float32), kernel.astype(np.float32)) + level)


def closed(heights_mm: Floats, radius_cells: float) -> Floats:
    """Morphological closing of heights (R, C) with a flat disc: dilation, then erosion.

    The dilation spreads into the empty cells and the erosion uses what it wrote there, so that surfaces that slope down
    to their outline are not lifted; empty cells themselves count as infinitely low.
    """
    margin = int(radius_cells) + 1
    low = np.pad(heights_mm.astype(np.float32), margin, constant_values=np.nan)
    low[np.isnan(low)] = -np.inf
    squared = radius_cells**2 - np.arange(margin + 1) ** 2
    reach = np.sqrt(squared[squared >= 0]).astype(np.int64)
    lifted = _disc_maximum(low, reach)
    lowered = -_disc_maximum(-lifted, reach)
    return np.where(np.isfinite(heights_mm), np.maximum(lowered[margin:-margin, margin:-margin], heights_mm), np.nan)


@njit(cache=True, nogil=True)
def _cell_means(points: Floats, frame: Floats, cell: float, rows: int, columns: int) -> tuple[Floats, Integers]:
    """Mean height (R, C) in a field frame (4, 4) of the points (N, 3) over each cell, and their number (R, C)."""
    totals, counts = np.zeros((rows, columns)), np.zeros((rows, columns), np.int64)
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        i = int((frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z + frame[0, 3]) / cell)
        j = int((frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z + frame[1, 3]) / cell)
        totals[i, j] += frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z + frame[2, 3]
        counts[i, j] += 1
    return _divided(totals, counts), counts


@njit(cache=True, nogil=True)
def _merged(heights: Floats, counts: Integers, factor: int) -> tuple[Floats, Integers]:
    """Mean heights and counts over blocks of ``factor`` x ``factor`` cells."""
    shape = ((heights.shape[0] + factor - 1) // factor, (heights.shape[1] + factor - 1) // factor)
    totals, numbers = np.zeros(shape), np.zeros(shape, np.int64)
    for row in range(shape[0]):
        for i in range(row * factor, min((row + 1) * factor, heights.shape[0])):
            for column in range(shape[1]):
                for j in range(column * factor, min((column + 1) * factor, heights.shape[1])):
                    if counts[i, j] > 0:
                        totals[row, column] += counts[i, j] * heights[i, j]
                        numbers[row, column] += counts[i, j]
    return _divided(totals, numbers), numbers


@njit(cache=True, nogil=True)
def _divided(totals: Floats, counts: Integers) -> Floats:
    """Means (R, C), in place of their totals; NaN where nothing was counted."""
    for i in range(totals.shape[0]):
        for j in range(totals.shape[1]):
            totals[i, j] = totals[i, j] / counts[i, j] if counts[i, j] > 0 else np.nan
    return totals


@njit(cache=True, nogil=True)
def _weighted_means(values: NDArray[np.float32], kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means (R, C) of the values that are no NaN, weighted with a kernel (K,) along rows and columns; NaN stays."""
    rows, columns = values.shape
    half = len(kernel) // 2
    means = np.empty((rows, columns), np.float32)
    totals, fractions = np.empty(columns + 2 * half, np.float32), np.empty(columns + 2 * half, np.float32)
    inner_totals, inner_fractions = totals[half : half + columns], fractions[half : half + columns]
    total, fraction = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for i in range(rows):
        totals[:], fractions[:], total[:], fraction[:] = 0, 0, 0, 0
        for k in range(max(i - half, 0), min(i + half + 1, rows)):
            here, weight = values[k], kernel[k - i + half]
            for j in range(columns):
                known = here[j] == here[j]
                inner_totals[j] += weight * here[j] if known else np.float32(0)
                inner_fractions[j] += weight if known else np.float32(0)
        for k in range(len(kernel)):
            shifted_totals, shifted_fractions = totals[k : k + columns], fractions[k : k + columns]
            for j in range(columns):
                total[j] += kernel[k] * shifted_totals[j]
                fraction[j] += kernel[k] * shifted_fractions[j]
        for j in range(columns):
            means[i, j] = total[j] / fraction[j] if values[i, j] == values[i, j] else np.float32(np.nan)
    return means


@njit(cache=True, nogil=True)
def _disc_maximum(heights: NDArray[np.float32], reach: Integers) -> NDArray[np.float32]:
    """Maximum over a disc whose rows k and -k span ``reach[k]`` columns to both sides, by doubling windows."""
    rows, columns = heights.shape
    half = reach[0]
    result = np.full((rows, columns), -np.inf, np.float32)
    powers = 1
    while 2**powers <= 2 * half + 1:
        powers += 1
    table = np.full((powers, columns + 2 * half), -np.inf, np.float32)
    for i in range(rows):
        table[0, half : half + columns] = heights[i]
        for power in range(1, powers):
            step = 2 ** (power - 1)
            wide, near, far = table[power, :-step], table[power - 1, :-step], table[power - 1, step:]
            for j in range(len(wide)):
                wide[j] = near[j] if near[j] > far[j] else far[j]
        for k in range(len(reach)):
            power = 0
            while 2 ** (power + 1) <= 2 * reach[k] + 1:
                power += 1
            first = half - reach[k]
            second = half + reach[k] + 1 - 2**power
            near, far = table[power, first : first + columns], table[power, second : second + columns]
            for target in (i - k, i + k):
                if target < 0 or target >= rows or (k == 0 and target > i):
                    continue
                best = result[target]
                for j in range(columns):
                    value = near[j] if near[j] > far[j] else far[j]
                    best[j] = value if value > best[j] else best[j]
    return result
