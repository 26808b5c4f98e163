"""Rims: the points of a scan beyond which a face does not go on, with the direction in which it ends.

A rim is the edge to another face, the border of a hole, the outline of the part, or merely where the scanner saw no
farther: at the border of its picture, or where a round face turns away from it. Those are left out. Planes tell nothing
of where they end; rims do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest, within_radius
from grindvision.kernels import njit
from grindvision.records import by_content
from grindvision.vision.surface.scan import Scan
from grindvision.vision.surface.surfels import surface_area

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

REACH_SPACINGS = 3.0
"""A face goes on where a neighbour lies within so many spacings of the points."""

IN_FACE = 0.3
"""Sine of the angle to a point's own plane up to which a neighbour lies on the same face."""

OPEN_RAD, CORNER_RAD = np.radians(140), np.radians(260)
"""Sector about a point without a neighbour on its face from which on the point is on a rim, and from which on it is at
a tip or alone, where a rim has no direction. A straight rim leaves 180 degrees; a second row of points, behind one rim
a spacing away, 140."""

SMOOTHED, SAME_FACE, SAME_WAY = 1.5, 0.8, 0.3
"""A rim's direction is the mean over so many reaches, of points whose normals and directions make at most the angles of
these cosines."""

COS_TURNED = 0.5
"""A face that a scanner sees at an angle of a smaller cosine than this may end where it turns away, as a shaft does."""

BORDER_SPACINGS = 1.5
"""Rims within so many spacings of the least or the largest coordinate of a scan, or of its picture, may be its
border."""

AT_ONCE = 50_000
"""So many points are asked for their neighbours at once, which bounds the memory."""


@by_content
@dataclass(frozen=True)
class Rims:
    """Rim ``points`` (N, 3) of a scan, the unit ``normals`` (N, 3) of their faces, and the unit directions ``outward``
    (N, 3) within the faces in which these end; ``spacing_mm`` of the scan's points."""

    points: Floats
    normals: Floats
    outward: Floats
    spacing_mm: float

    def __len__(self) -> int:
        return len(self.points)

    def __str__(self) -> str:
        return f"{len(self):,} rim points, {self.spacing_mm:.3g} mm apart"


def point_spacing(scan: Scan) -> float:
    """Spacing in mm of a scan's points: the root of the area for one."""
    return float(np.sqrt(surface_area(scan.points) / len(scan.points)))


def find_rims(scan: Scan, reach_mm: float) -> Rims:
    """The rims of a scan's faces; a gap of less than ``reach_mm`` between points is none.

    Where the scanner's place is not known, nothing tells a rim from a face that turns away, and there are none.
    """
    spacing = point_spacing(scan)
    points = np.ascontiguousarray(scan.points)
    if scan.viewpoint_mm is None:
        return Rims(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), spacing)
    grid = scan.surfels.grid
    at, _ = nearest(grid, points, 3 * grid.size_mm)
    normals = np.where((at >= 0)[:, None], scan.surfels.normals[at], 0.0)
    cells = build_cells(points, reach_mm)
    outward = np.zeros_like(points)
    for first in range(0, len(points), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        near = within_radius(cells, points[part], reach_mm)
        outward[part] = _outward(points, points[part], normals[part], near.starts, near.indices)
    rays = scan.viewpoint_mm - points
    turned = (rays * normals).sum(axis=1) < COS_TURNED * np.linalg.norm(rays, axis=1)
    on = np.flatnonzero(outward.any(axis=1) & ~turned & ~_at_border(scan, spacing))
    places, up, ways = points[on], normals[on], outward[on]
    if len(on):
        near = within_radius(build_cells(places, SMOOTHED * reach_mm), places, SMOOTHED * reach_mm)
        ways = _smoothed(up, ways, near.starts, near.indices)
    return Rims(places, up, ways, spacing)


def _at_border(scan: Scan, spacing: float) -> Flags:
    """Points (N,) at the border of a scan that may have been cut there: by its file's axes, or as its picture is."""
    if scan.sided or scan.viewpoint_mm is None:
        return np.zeros(len(scan.points), dtype=bool)
    rays = scan.points - scan.viewpoint_mm
    depth = np.abs(rays).mean(axis=0).argmax()  # the axis along which the scanner looks
    across = [axis for axis in range(3) if axis != depth]
    far = np.median(np.abs(rays[:, depth]))
    picture = rays[:, across] / np.maximum(np.abs(rays[:, depth]), 1e-9)[:, None] * far
    at = np.zeros(len(rays), dtype=bool)
    for column in (*rays[:, across].T, *picture.T):
        near = BORDER_SPACINGS * spacing
        at |= (column < column.min() + near) | (column > column.max() - near)
    return at


@njit(cache=True, nogil=True)
def _outward(points: Floats, asked: Floats, normals: Floats, starts: Integers, indices: Integers) -> Floats:
    """Where the face of each asked point (N, 3) ends: unit directions (N, 3), zero for points that are on no rim."""
    found = np.zeros((len(asked), 3))
    for p in range(len(asked)):
        x, y, z = normals[p, 0], normals[p, 1], normals[p, 2]
        if x == 0 and y == 0 and z == 0:
            continue
        u = np.array([y, -x, 0.0]) if abs(z) < 0.9 else np.array([0.0, z, -y])
        u /= np.sqrt((u**2).sum())
        v = np.array([y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]])
        angles = np.empty(starts[p + 1] - starts[p])
        count = 0
        for k in range(starts[p], starts[p + 1]):
            d = points[indices[k]] - asked[p]
            away = np.sqrt((d**2).sum())
            if away < 1e-9 or abs(d[0] * x + d[1] * y + d[2] * z) > IN_FACE * away:
                continue
            angles[count] = np.arctan2((v * d).sum(), (u * d).sum())
            count += 1
        if count < 4:
            continue
        angles = np.sort(angles[:count])
        gap, begins = angles[0] + 2 * np.pi - angles[-1], angles[-1]
        for k in range(1, count):
            if angles[k] - angles[k - 1] > gap:
                gap, begins = angles[k] - angles[k - 1], angles[k - 1]
        if OPEN_RAD < gap < CORNER_RAD:
            middle = begins + gap / 2
            for k in range(3):
                found[p, k] = np.cos(middle) * u[k] + np.sin(middle) * v[k]
    return found


@njit(cache=True, nogil=True)
def _smoothed(normals: Floats, outward: Floats, starts: Integers, indices: Integers) -> Floats:
    """Directions (N, 3) of rims, the means over their neighbours on the same rim."""
    found = np.empty_like(outward)
    for p in range(len(outward)):
        mean = np.zeros(3)
        for k in range(starts[p], starts[p + 1]):
            q = indices[k]
            alike = (normals[q] * normals[p]).sum() > SAME_FACE and (outward[q] * outward[p]).sum() > SAME_WAY
            if alike:
                mean += outward[q]
        mean -= (mean * normals[p]).sum() * normals[p]
        found[p] = mean / max(np.sqrt((mean**2).sum()), 1e-300)
    return found
