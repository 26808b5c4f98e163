"""Lines over a height map that a wheel follows: along a centreline, in straight rows, or around, level lines all three.

Each pattern is a field over the nodes of the map; its level lines, a contact's width less the overlap apart, are the
lines: distance from the bead's centreline, place across the rows, distance from the rim of what is to be ground.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter, gaussian_filter1d

from grindvision.extras import extra
from grindvision.geometry.height_map import HeightMap

with extra("plot"):
    from contourpy import contour_generator

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

TURNED = 0.1
"""A mean direction of two steps that is shorter than so much of a step is none: they run against each other."""

GROWN = 2
"""Lines run on over so many nodes beside the region."""


def grinding_lines(
    heights: HeightMap, region: Flags, pattern: str, width_mm: float, overlap: float, centreline: Floats | None
) -> list[Floats]:
    """Lines (K, 2), x and y in mm on the map, that cover a region (R, C), in the order they are worked.

    Args:
        heights: the map.
        region: nodes that are to be ground.
        pattern: ``bead``, ``raster`` or ``contour``; without a centreline, a bead is worked in rows.
        width_mm: of the contact, across the line.
        overlap: of neighbouring lines, a fraction of the width.
        centreline: the bead's (M, 2), on the map, or None.
    """
    if not region.any():
        return []
    spacing_mm = width_mm * (1 - overlap)
    if pattern == "contour":
        return _around(heights, region, width_mm, spacing_mm)
    if pattern == "bead" and centreline is not None and len(centreline) > 2:
        field = _signed_distance(heights, centreline)
    else:
        field = np.broadcast_to(heights.y_mm, heights.shape).copy()
    rim = heights.spacing_mm / 2
    low, high = float(field[region].min()) - rim, float(field[region].max()) + rim
    count = max(1, int(np.ceil((high - low - width_mm) / spacing_mm - 1e-9)) + 1)
    levels = [(low + high) / 2] if count == 1 else np.linspace(low + width_mm / 2, high - width_mm / 2, count)
    shown = binary_dilation(region, iterations=GROWN) & heights.shown
    lines = []
    for number, level in enumerate(levels):
        reach = np.abs(field - level) < width_mm / 2 + heights.spacing_mm
        found = _level_lines(heights, field, shown & _along(heights, field, region & reach, level), float(level))
        lines += [line[::-1] for line in found[::-1]] if number % 2 else found
    return lines or [_stroke(heights, region)]


def poses_along(heights: HeightMap, line: Floats) -> list[Floats]:
    """Tips on the ground and axes (K, 12) along a line (K, 2) of the map, run by run; where the ground is not shown a
    run ends. Runs of fewer than two places are none."""
    feet = np.column_stack([line, heights.at(heights.ground_mm, line)])
    normals = heights.at(heights.normals, line)
    known = np.asarray(np.isfinite(feet).all(axis=1) & np.isfinite(normals).all(axis=1))
    runs = np.split(np.arange(len(line)), np.flatnonzero(np.diff(known)) + 1)
    return [_posed(feet[run], normals[run]) for run in runs if known[run[0]] and len(run) > 1]


def _posed(feet: Floats, normals: Floats) -> Floats:
    """Tips and axes (K, 12) over feet (K, 3) with normals (K, 3) that need not be unit."""
    normals = gaussian_filter1d(normals, 2.0, axis=0, mode="nearest")
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ahead = np.gradient(feet, axis=0)
    # where a line turns back on itself, as a ring round a speck does, its mean direction vanishes; a step has one
    step = np.diff(feet, axis=0, append=2 * feet[-1:] - feet[-2:-1])
    turned = np.linalg.norm(ahead, axis=1) < TURNED * np.linalg.norm(step, axis=1)
    ahead[turned] = step[turned]
    ahead -= (ahead * normals).sum(axis=1, keepdims=True) * normals
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    return np.ascontiguousarray(np.hstack([feet, ahead, np.cross(normals, ahead), normals]))


def _along(heights: HeightMap, field: Floats, wanted: Flags, level: float) -> Flags:
    """Nodes (R, C) beside the level line next to which something of its strip is wanted."""
    if not wanted.any():
        return np.zeros(heights.shape, dtype=bool)
    line = np.abs(field - level) <= 1.5 * heights.spacing_mm
    away = np.asarray(distance_transform_edt(~wanted)) * heights.spacing_mm
    across = np.abs(field - level)[wanted].max()
    return np.asarray(line & (away <= across + GROWN * heights.spacing_mm))


def _around(heights: HeightMap, region: Flags, width_mm: float, spacing_mm: float) -> list[Floats]:
    """Lines along the rim of the region, from the outside in."""
    inside = np.asarray(distance_transform_edt(np.pad(region, 1)))[1:-1, 1:-1] * heights.spacing_mm
    outside = np.asarray(distance_transform_edt(~region)) * heights.spacing_mm
    field = gaussian_filter(inside - outside, 1.0)
    deepest = float(field[region].max())
    first = max(width_mm - heights.spacing_mm, heights.spacing_mm) / 2
    if deepest <= first:
        return _level_lines(heights, field, heights.shown, 0.5 * deepest) or [_stroke(heights, region)]
    levels = np.arange(first, deepest, spacing_mm)
    lines = [line for level in levels for line in _level_lines(heights, field, heights.shown, float(level))]
    return lines or [_stroke(heights, region)]


def _level_lines(heights: HeightMap, field: Floats, shown: Flags, level: float) -> list[Floats]:
    """Level lines (K, 2) of a field (R, C) over the nodes that are shown, those of smaller x first."""
    masked = np.ma.masked_array(field, ~shown)
    found = contour_generator(heights.y_mm, heights.x_mm, masked).lines(level)
    lines = [np.asarray(line, dtype=float)[:, ::-1] for line in found]
    lines = [line if line[0] @ [1, 0.1] <= line[-1] @ [1, 0.1] else line[::-1] for line in lines]
    lines = [line for line in lines if _length(line) > 1.5 * heights.spacing_mm]
    return sorted(lines, key=lambda line: (round(line[0, 0], 6), round(line[0, 1], 6)))


def _stroke(heights: HeightMap, region: Flags) -> Floats:
    """A short line over the middle of a region that is smaller than two nodes."""
    middle = np.argwhere(region).mean(axis=0) * heights.spacing_mm
    return middle + np.array([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]) * heights.spacing_mm


def _signed_distance(heights: HeightMap, centreline: Floats) -> Floats:
    """Distance (R, C) in mm from a centreline (M, 2), above zero on its left; straight on beyond its ends."""
    from scipy.spatial import cKDTree

    far = 2 * float(np.hypot(*heights.shape)) * heights.spacing_mm
    step = heights.spacing_mm / 4
    ends = [
        centreline[0] - centreline[min(3, len(centreline) - 1)],
        centreline[-1] - centreline[max(-4, -len(centreline))],
    ]
    runs = [
        end + np.arange(step, far, heights.spacing_mm)[:, None] * away / np.linalg.norm(away)
        for end, away in zip((centreline[0], centreline[-1]), ends, strict=True)
    ]
    line = resampled(np.vstack([runs[0][::-1], centreline, runs[1]]), step)
    tangents = np.gradient(line, axis=0)
    x, y = np.meshgrid(heights.x_mm, heights.y_mm, indexing="ij")
    places = np.column_stack([x.ravel(), y.ravel()])
    away, at = cKDTree(line).query(places)
    offset = places - line[at]
    side = tangents[at, 0] * offset[:, 1] - tangents[at, 1] * offset[:, 0]
    return np.asarray(np.copysign(away, side)).reshape(heights.shape)


def resampled(line: Floats, step_mm: float) -> Floats:
    """Places (K, 2) along a line, evenly, at most ``step_mm`` apart; its ends stay."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    kept = np.concatenate([[True], np.diff(arc) > 1e-9])
    at = np.linspace(0.0, arc[-1], max(int(np.ceil(arc[-1] / step_mm)) + 1, 3))
    return np.column_stack([np.interp(at, arc[kept], line[kept, axis]) for axis in (0, 1)])


def _length(line: Floats) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
