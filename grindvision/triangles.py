"""Triangle meshes as arrays: areas, points spread evenly over them, and whether the vertices stand for the surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

LONG_EDGE, MAX_LONG = 0.02, 0.05
"""Vertices stand for the surface where edges longer than this fraction of the diagonal bound little of its area."""

MIN_AREA = 1e-14
"""A triangle with less than this fraction of the squared diagonal is degenerate: its normal is rounding."""

MIN_HEIGHT = 1e-7
"""... and so is one whose least height is a smaller fraction of its longest edge."""


def double_areas(corners: Floats) -> Floats:
    """Vectors (T, 3) normal to triangles (T, 3, 3), counter-clockwise seen from their tips, of twice the area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def sound(corners: Floats) -> Flags:
    """Which triangles (T, 3, 3) are finite and have an area."""
    finite: Flags = np.asarray(np.isfinite(corners).all(axis=(1, 2)))
    if not finite.any():
        return finite
    places = corners[finite]
    diagonal = float(np.linalg.norm(np.ptp(places.reshape(-1, 3), axis=0)))
    longest = np.linalg.norm(np.roll(places, -1, axis=1) - places, axis=2).max(axis=1)
    areas = np.linalg.norm(double_areas(places), axis=1)
    good = finite.copy()
    good[finite] = (areas > 2 * MIN_AREA * diagonal**2) & (areas > MIN_HEIGHT * longest**2)
    return good


def vertices_suffice(corners: Floats) -> bool:
    """Whether the corners of triangles (T, 3, 3) stand closely enough for their surface."""
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    areas = np.linalg.norm(double_areas(corners), axis=1)
    return bool(areas[edges > LONG_EDGE * diagonal].sum() <= MAX_LONG * areas.sum())


def spread_points(corners: Floats, count: int) -> tuple[Floats, Integers]:
    """About ``count`` points (N, 3) spread evenly over triangles (T, 3, 3) by area, and the triangle (N,) of each.

    No draws: the same triangles give the same points.
    """
    areas = np.linalg.norm(double_areas(corners), axis=1)
    ends = np.round(np.cumsum(areas) / areas.sum() * count).astype(np.int64)
    owner = np.repeat(np.arange(len(corners)), np.diff(ends, prepend=0))
    return _spread(corners[owner]), owner


def _spread(corners: Floats) -> Floats:
    """One point in each of (N, 3, 3) triangles, by the additive sequence that fills a square most evenly."""
    golden = 1.324717957244746
    first, second = (np.arange(len(corners))[:, None] * [1 / golden, 1 / golden**2] % 1.0).T
    over = first + second > 1
    first, second = np.where(over, 1 - first, first), np.where(over, 1 - second, second)
    corner, one, other = corners[:, 0], corners[:, 1], corners[:, 2]
    return corner + first[:, None] * (one - corner) + second[:, None] * (other - corner)
