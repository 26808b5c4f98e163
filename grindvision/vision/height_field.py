"""A scan as a height field over a plane: raster, smoothing and the morphological closing that fills valleys."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from grindvision.errors import DegenerateError
from grindvision.geometry import check_points, inverse, move_points, rigid, vector_angle
from grindvision.vision.surfels import build_surfels

Floats = NDArray[np.float64]

#: Edge of the surfels that give the viewing direction, as a share of the cloud's diagonal.
SURFEL_SHARE = 1 / 60

#: The area that points cover is counted in cells that hold at least so many of them.
LEAST_POINTS_PER_CELL = 5

#: A scanner at the origin is believed when the mean normal points towards it within this angle.
CAMERA_CONE_RAD = np.radians(45)

#: A camera looks along its z axis, forward or (in graphics) backward, the middle of the scan within this angle of it.
CAMERA_FIELD_RAD = np.radians(40)

#: Length of the mean of all normals, each turned to the origin, below which the origin is no camera.
LEAST_AGREEMENT = 0.6

#: Normals within this angle belong to one main direction, if they are at least this share of all.
MODE_CONE_RAD, MODE_SHARE = np.radians(45), 0.12


@dataclass(frozen=True)
class HeightField:
    """Mean heights of a cloud's points over square cells of a plane, all in the field frame.

    ``T_field_cloud`` (4, 4) turns cloud coordinates into field coordinates: z is the height, x and y run along the rows
    and columns. ``heights_mm`` (R, C) is NaN where no point lies; cell (i, j) covers x from ``i * cell_mm``.
    """

    T_field_cloud: Floats
    cell_mm: float
    heights_mm: Floats

    @property
    def filled(self) -> NDArray[np.bool_]:
        """Cells (R, C) that hold a point."""
        return np.isfinite(self.heights_mm)

    def positions(self, rows: ArrayLike, columns: ArrayLike) -> Floats:
        """Field coordinates x, y (N, 2) in mm of cell centres."""
        return (np.stack([np.asarray(rows), np.asarray(columns)], axis=-1) + 0.5) * self.cell_mm

    def __str__(self) -> str:
        rows, columns = self.heights_mm.shape
        return f"height field of {rows} x {columns} cells of {self.cell_mm:.3g} mm, {self.filled.mean():.0%} filled"


def field_frames(points: ArrayLike, viewpoint_mm: ArrayLike | None = None) -> list[list[Floats]]:
    """Frames from which a cloud's surfaces are seen nearly straight on, for each side it may have been scanned from.

    A frame is a transform (4, 4) ``T_field_cloud`` whose z axis is one of the main directions of the surface normals
    (the largest first) and whose x axis is the cloud's long side. There is one list of frames when the scanned side is
    known, from ``viewpoint_mm`` (3,) or because the origin stands where a camera would and z points as a camera's does
    (a robot's base does so by chance only); otherwise two, for both sides.

    Raises:
        DegenerateError: the points span no surface.
    """
    points = check_points(points, "points", least=10)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not diagonal > 0:
        raise DegenerateError(f"all {len(points)} points lie in one spot; they span no surface")
    T_own_cloud = _own_frame(points)
    surfels = build_surfels(move_points(T_own_cloud, points), diagonal * SURFEL_SHARE)
    centre = surfels.points.mean(axis=0)
    towards = move_points(T_own_cloud, np.zeros(3) if viewpoint_mm is None else viewpoint_mm)
    normals = _facing(surfels.normals, towards - surfels.points)
    mean = normals.mean(axis=0)
    gap = towards - centre
    believed = np.linalg.norm(gap) > diagonal / 2 and np.linalg.norm(mean) > LEAST_AGREEMENT
    off_axis = vector_angle(T_own_cloud[:3, 2], gap)
    believed = believed and min(off_axis, np.pi - off_axis) < CAMERA_FIELD_RAD
    if viewpoint_mm is not None or (believed and vector_angle(mean, gap) < CAMERA_CONE_RAD):
        return [[_frame(surfels.points, centre, up) @ T_own_cloud for up in _main_directions(normals)]]
    directions = _main_directions(_facing(surfels.normals, _dominant(surfels.normals)[None, :]))
    return [[_frame(surfels.points, centre, side * up) @ T_own_cloud for up in directions] for side in (1, -1)]


def rasterise(points: ArrayLike, T_field_cloud: ArrayLike, cell_mm: float) -> HeightField:
    """Mean height of the points (N, 3) over every cell; the frame is shifted so that all cells count from zero."""
    points = np.ascontiguousarray(points, dtype=float)
    frame = np.asarray(T_field_cloud, dtype=float)
    low, high = field_bounds(points, frame)
    shifted = frame.copy()
    shifted[:2, 3] -= low[:2] - cell_mm / 2
    shape = np.floor((high[:2] - low[:2]) / cell_mm + 0.5).astype(int) + 1
    return HeightField(shifted, float(cell_mm), _cell_means(points, shifted, cell_mm, shape[0], shape[1]))


def spacing_of(points: ArrayLike, T_field_cloud: ArrayLike) -> float:
    """Typical distance in mm of neighbouring points over the field's plane: root of covered area per point."""
    points = np.ascontiguousarray(points, dtype=float)
    low, high = field_bounds(points, np.asarray(T_field_cloud, dtype=float))
    cell = float(max(high[0] - low[0], high[1] - low[1])) / 200
    cells = len(points)
    while cells * LEAST_POINTS_PER_CELL > len(points):
        cell *= 2
        cells = int(rasterise(points, T_field_cloud, cell).filled.sum())
    return float(np.sqrt(cells * cell**2 / len(points)))


def smoothed(field: HeightField, sigma_mm: float) -> Floats:
    """Heights (R, C) after a Gaussian of ``sigma_mm`` that knows which cells are empty; NaN stays NaN."""
    filled = field.filled
    weight = gaussian_filter(filled.astype(np.float32), sigma_mm / field.cell_mm, mode="constant", truncate=3.0)
    level = np.median(field.heights_mm[filled])
    total = np.where(filled, field.heights_mm - level, 0).astype(np.float32)
    total = gaussian_filter(total, sigma_mm / field.cell_mm, mode="constant", truncate=3.0)
    return np.where(filled, total / np.maximum(weight, 1e-6) + level, np.nan)


def closed(heights_mm: Floats, radius_cells: float) -> Floats:
    """Morphological closing of heights (R, C) with a flat disc: dilation, then erosion.

    The dilation spreads into the empty cells and the erosion uses what it wrote there, so that surfaces that slope down
    to their outline are not lifted; empty cells themselves count as infinitely low.
    """
    margin = int(radius_cells) + 1
    low = np.pad(np.where(np.isfinite(heights_mm), heights_mm, -np.inf), margin, constant_values=-np.inf)
    squared = radius_cells**2 - np.arange(-margin, margin + 1) ** 2
    reach = np.where(squared >= 0, np.sqrt(np.maximum(squared, 0)), -1).astype(np.int64)
    lifted = _disc_maximum(low.astype(np.float32), reach)
    lowered = -_disc_maximum(-lifted, reach)
    result = lowered[margin:-margin, margin:-margin].astype(float)
    return np.where(np.isfinite(heights_mm), np.maximum(result, heights_mm), np.nan)


def _own_frame(points: Floats) -> Floats:
    """``T_own_cloud`` (4, 4) along the cloud's own axes, so that no result depends on the frame it came in."""
    centre = points.mean(axis=0)
    centred = points - centre
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1]
    turned = centred @ axes
    axes = axes * np.where(np.einsum("ij,ij,ij->j", turned, turned, turned) >= 0, 1, -1)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return inverse(rigid(axes, centre))


def _facing(normals: Floats, towards: Floats) -> Floats:
    return normals * np.sign(np.einsum("ij,ij->i", normals, np.broadcast_to(towards, normals.shape)))[:, None]


def _dominant(normals: Floats) -> Floats:
    return np.linalg.eigh(normals.T @ normals)[1][:, 2]


def _main_directions(normals: Floats) -> list[Floats]:
    """Unit directions around which the normals gather: the mean normal led to the nearest peak, then what is left."""
    left, directions = normals[np.linalg.norm(normals, axis=1) > 0.5], []
    least = MODE_SHARE * len(left)
    while len(left) > max(least, 3):
        up = left.mean(axis=0)
        for _ in range(20):
            up = up / max(np.linalg.norm(up), 1e-12)
            near = left @ up > np.cos(MODE_CONE_RAD)
            up = left[near].sum(axis=0) if near.any() else left[np.argmax(left @ up)]
        up = up / np.linalg.norm(up)
        near = left @ up > np.cos(MODE_CONE_RAD)
        if near.sum() > least:
            directions.append(up)
        left = left[~near] if near.any() else left[:0]
    return directions or [normals.mean(axis=0) / np.linalg.norm(normals.mean(axis=0))]


def _frame(points: Floats, centre: Floats, up: Floats) -> Floats:
    """Field frame with z along ``up``; x is the long side of the points in the plane across it."""
    flat = points - centre
    flat = flat - np.outer(flat @ up, up)
    along = np.linalg.eigh(flat.T @ flat)[1][:, 2]
    skewness = ((flat @ along) ** 3).sum()
    along = along - up * (along @ up)
    along *= (1 if skewness >= 0 else -1) / np.linalg.norm(along)
    rotation = np.stack([along, np.cross(up, along), up], axis=1)
    return inverse(rigid(rotation, centre))


@njit(cache=True, nogil=True)
def field_bounds(points, frame):
    """Lowest and highest coordinates (3,) of points (N, 3) in a field frame (4, 4)."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for p in range(len(points)):
        for k in range(3):
            value = frame[k, 3]
            for m in range(3):
                value += frame[k, m] * points[p, m]
            low[k] = min(low[k], value)
            high[k] = max(high[k], value)
    return low, high


@njit(cache=True, nogil=True)
def _cell_means(points, frame, cell, rows, columns):
    totals, counts = np.zeros((rows, columns)), np.zeros((rows, columns), np.int64)
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        i = int((frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z + frame[0, 3]) / cell)
        j = int((frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z + frame[1, 3]) / cell)
        totals[i, j] += frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z + frame[2, 3]
        counts[i, j] += 1
    for i in range(rows):
        for j in range(columns):
            totals[i, j] = totals[i, j] / counts[i, j] if counts[i, j] > 0 else np.nan
    return totals


@njit(cache=True, nogil=True)
def _disc_maximum(heights, reach):
    """Maximum over a disc whose row k spans ``reach[k]`` columns to both sides (-1: none), by doubling windows."""
    rows, columns = heights.shape
    half = len(reach) // 2
    result = np.full((rows, columns), -np.inf, np.float32)
    powers = 1
    while 2**powers <= 2 * reach.max() + 1:
        powers += 1
    table = np.empty((powers, columns), np.float32)
    for i in range(rows):
        table[0] = heights[i]
        for power in range(1, powers):
            step = 2 ** (power - 1)
            for j in range(columns):
                other = table[power - 1, j + step] if j + step < columns else np.float32(-np.inf)
                table[power, j] = max(table[power - 1, j], other)
        for k in range(len(reach)):
            target = i + k - half
            if reach[k] < 0 or target < 0 or target >= rows:
                continue
            power = 0
            while 2 ** (power + 1) <= 2 * reach[k] + 1:
                power += 1
            width = 2**power
            for j in range(columns):
                left = max(j - reach[k], 0)
                right = max(min(j + reach[k], columns - 1) - width + 1, left)
                best = max(table[power, left], table[power, right])
                if best > result[target, j]:
                    result[target, j] = best
    return result
