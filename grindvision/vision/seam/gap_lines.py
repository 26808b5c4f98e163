"""Narrow gaps in a surface: strips a few points wide in which the scan shows nothing, or something far below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from grindvision.geometry import inverse, move_points
from grindvision.records import by_content
from grindvision.vision.seam.height_field import HeightField, closed, rasterise, smoothed
from grindvision.vision.seam.seam_tracing import trace_curves

Floats = NDArray[np.float64]

#: A gap is at least so many point spacings wide, or it cannot be told from the spacing itself; and at most so many.
MIN_SPACINGS, MAX_SPACINGS = 2.0, 12.0
#: Half the width of the largest hole between points that are not quite evenly spread, in spacings.
HOLE_SPACINGS = 0.95
#: What lies so many spacings, and so many times the noise, below the surface belongs to the gap.
DEEP_SPACINGS, DEEP_NOISE = 1.0, 6.0
#: Pieces of a gap are joined over so many spacings; gaps shorter than this fraction of the longest are left out.
JOIN_SPACINGS, LONG_FRACTION = 30.0, 0.3
#: More gaps than this are the rows of the scanner, or a grid, and no joints.
MAX_GAPS = 6
#: More cells than this in holes are no few narrow gaps.
MAX_CELLS = 20_000
#: A gap is so many times as long as wide.
MIN_ASPECT = 8.0


@by_content
@dataclass(frozen=True)
class GapLine:
    """A rough gap: ``path`` (M, 3) along its middle at the level of the surface, mm, and its rough ``width_mm``."""

    path: Floats
    width_mm: float


def find_gaps(
    points: Floats, T_field_cloud: Floats, spacing_mm: float, noise_mm: float, min_length_mm: float
) -> list[GapLine]:
    """Gaps of a cloud (N, 3) seen along z of the field frame, longest first; none where there are implausibly many."""
    field = rasterise(points, T_field_cloud, 1.2 * spacing_mm)
    reach = MAX_SPACINGS / 1.2 / 2 + 1
    heights = smoothed(field, 1.5 * spacing_mm)
    surface = closed(heights, reach)
    in_field = move_points(field.T_field_cloud, points)
    rows, columns = (np.floor(in_field[:, k] / field.cell_mm).astype(int) for k in (0, 1))
    level = surface[np.clip(rows, 0, surface.shape[0] - 1), np.clip(columns, 0, surface.shape[1] - 1)]
    on_surface = level - in_field[:, 2] < max(DEEP_SPACINGS * spacing_mm, DEEP_NOISE * noise_mm)
    cell = spacing_mm / 2
    low = in_field[:, :2].min(axis=0)
    margin = int(MAX_SPACINGS) + 2  # half the widest gap, and more: beyond the scan all is outside
    at = ((in_field[on_surface, :2] - low) / cell).astype(int) + margin
    shape = ((in_field[:, :2].max(axis=0) - low) / cell).astype(int) + 2 * margin + 1
    empty = np.ones(shape, dtype=bool)
    empty[at[:, 0], at[:, 1]] = False
    distance = ndimage.distance_transform_edt(empty) * cell
    # Enclosed by surface: what a dilation by half the widest gap reaches, less the same from outside.
    half = MAX_SPACINGS / 2 * spacing_mm
    enclosed = ndimage.distance_transform_edt(distance <= half) * cell > half
    hole = enclosed & (distance > HOLE_SPACINGS * spacing_mm)
    if not hole.any():
        return []
    cells = np.argwhere(hole)
    ridge = distance[hole] >= ndimage.maximum_filter(distance, size=3)[hole] - 1e-9
    cells, widths = cells[ridge], 2 * distance[hole][ridge]
    if len(cells) < 8 or len(cells) > MAX_CELLS:
        return []
    flat = (cells - margin + 0.5) * cell + low
    along = _directions(flat, 3 * spacing_mm)
    places = np.column_stack([flat, np.zeros(len(flat))])
    directions = np.column_stack([along, np.zeros(len(flat))])
    curves = trace_curves(places, directions, 1.5 * spacing_mm, JOIN_SPACINGS * spacing_mm, min_length_mm)
    gaps = []
    for curve in curves:
        width = float(np.median(widths[cKDTree(flat).query(curve[:, :2])[1]]))
        length = float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())
        if length > MIN_ASPECT * width:
            curve[:, 2] = _level(field, surface, curve[:, :2])
            curve = curve[np.isfinite(curve[:, 2])]
        if length > MIN_ASPECT * width and len(curve) > 3:
            gaps.append(GapLine(move_points(inverse(field.T_field_cloud), curve), width))
    lengths = np.array([np.linalg.norm(np.diff(gap.path, axis=0), axis=1).sum() for gap in gaps])
    long_ones = [gap for gap, length in zip(gaps, lengths, strict=True) if length > LONG_FRACTION * lengths.max()]
    return long_ones if len(long_ones) <= MAX_GAPS else []


def _directions(flat: Floats, radius: float) -> Floats:
    """Direction (K, 2) of largest spread of the neighbours of every place (K, 2)."""
    tree = cKDTree(flat)
    result = np.zeros((len(flat), 2))
    for number, near in enumerate(tree.query_ball_point(flat, radius)):
        away = flat[near] - flat[near].mean(axis=0)
        result[number] = np.linalg.eigh(away.T @ away)[1][:, 1]
    return result


def _level(field: HeightField, surface: Floats, flat: Floats) -> Floats:
    """Height (M,) of the surface beside places (M, 2) that may show none themselves; NaN where there is none near."""
    size = 2 * int(MAX_SPACINGS / 2) + 1
    beside = ndimage.median_filter(
        ndimage.maximum_filter(np.where(np.isfinite(surface), surface, -np.inf), size=size), size=3
    )
    rows, columns = (np.clip((flat[:, k] / field.cell_mm).astype(int), 0, surface.shape[k] - 1) for k in (0, 1))
    level = beside[rows, columns]
    return np.where(np.isfinite(level), level, np.nan)
