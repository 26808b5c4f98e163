"""Whether the sample shows its surface where it is asked: behind a point as its scanner sees it, or all around a foot.

What only the test scan shows is no difference: at a rim, behind a shadow, on a wall that the sample's scanner missed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.hash_grid import AXIS_CELLS, CellGrid, build_cells, cell_key, find_slot
from grindvision.geometry.neighbours import within_radius
from grindvision.kernels import njit
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

MAX_OPEN = np.radians(130)
"""Largest sector around a foot that may be empty of sample surface; straight rims leave 180 degrees."""

BEAM_CELLS, MARGIN_CELLS, MAX_EMPTY = 1.25, 0.5, 2
"""What the sample's scanner saw within so many cells of a ray, farther than so many behind the point, tells that the
point stands in free space, where it lies on all sides: of the eighths of the circle about the ray no more than so many
in a row may be empty. Beside an outline half of them are."""

MIN_VISIBLE = 8
"""Of the nine pixels about a doubtful point, so many must show surface behind it: at a rim it may be surface unseen."""


def in_front(surface: Surfels, viewpoint: Floats | None, points: Floats, size: float) -> Flags:
    """Points that the sample's scanner would have seen in front of what it saw: new material, not an unseen wall."""
    if viewpoint is None or len(points) == 0:
        return np.zeros(len(points), dtype=bool)
    middle = surface.points.mean(axis=0) - viewpoint
    distance = float(np.linalg.norm(middle))
    ahead = middle / distance
    across = np.linalg.svd(ahead[None])[2][1:]
    pixel = 1.5 * size / distance

    def project(places: Floats) -> tuple[Integers, Floats]:
        rays = places - viewpoint
        depth = rays @ ahead
        return np.round(rays @ across.T / np.maximum(depth, 1e-9)[:, None] / pixel).astype(np.int64), depth

    pixels, depths = project(surface.points)
    low, high = pixels.min(axis=0) - 2, pixels.max(axis=0) + 3
    nearest_depth = np.full(tuple(high - low), np.inf)
    np.minimum.at(nearest_depth, tuple((pixels - low).T), depths)
    asked, asked_depths = project(points)
    inside = ((asked > low) & (asked < high - 1)).all(axis=1)
    spot = np.where(inside[:, None], asked - low, 1)
    window, shown = np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            depth = nearest_depth[spot[:, 0] + i, spot[:, 1] + j]
            np.minimum(window, depth, out=window)
            shown += np.isfinite(depth)
    return inside & (shown >= MIN_VISIBLE) & (asked_depths < window)


def in_free_space(surface: Surfels, viewpoint: Floats | None, points: Floats) -> Flags:
    """Points (N, 3) that the rays of the sample's scanner passed: all it saw around them lies a cell or more behind.

    Where the good part was measured nothing was there: fins, flash and burrs, whichever way their faces look.
    """
    if viewpoint is None or len(points) == 0:
        return np.zeros(len(points), dtype=bool)
    seen, asked = surface.points - viewpoint, points - viewpoint
    depths, asked_depths = np.linalg.norm(seen, axis=1), np.linalg.norm(asked, axis=1)
    distance = float(np.median(depths))
    reach = BEAM_CELLS * surface.grid.size_mm
    grid = build_cells(seen * (distance / depths)[:, None], reach)
    ahead = asked / np.maximum(asked_depths, 1e-9)[:, None]
    beam = within_radius(grid, distance * ahead, reach)
    padded = np.append(depths[beam.indices], np.inf)
    nearest_depth = np.minimum.reduceat(padded, np.minimum(beam.starts[:-1], len(padded) - 1))
    behind = (np.diff(beam.starts) > 0) & (nearest_depth > asked_depths + MARGIN_CELLS * surface.grid.size_mm)
    behind[behind] = _empty_octants(distance * ahead[behind], ahead[behind], reach, grid) <= MAX_EMPTY
    return behind


def surrounded(surface: Surfels, feet: Floats, normals: Floats) -> Flags:
    """Whether the sample's surface lies all around these feet (N, 3); at a rim there is nothing to compare with."""
    reach = 2.5 * surface.grid.size_mm
    grid = build_cells(surface.points, reach)
    empty = _empty_octants(feet, normals, reach, grid)
    around = empty == 0
    rest = np.flatnonzero((empty == 1) | (empty == 2))  # three are more than MAX_OPEN
    near = within_radius(grid, feet[rest], reach)
    around[rest] = _largest_gaps(surface.points, feet[rest], normals[rest], near.starts, near.indices) < MAX_OPEN
    return around


@njit(cache=True, nogil=True)
def _empty_octants(feet: Floats, normals: Floats, radius: float, grid: CellGrid) -> Integers:
    """Of the eighths of the circle about each foot's normal, how many in a row (N,) hold no grid point within
    ``radius``, which is the grid's cell size.

    Most feet have none, which shows among a few points, long before all neighbours are listed and sorted by angle.
    """
    points, order, starts, origin, per_mm = grid.points, grid.order, grid.starts, grid.origin_mm, 1.0 / grid.size_mm
    runs = np.zeros(len(feet), dtype=np.int64)
    for f in range(len(feet)):
        x, y, z = feet[f, 0], feet[f, 1], feet[f, 2]
        i0, j0 = int(np.floor((x - origin[0]) * per_mm)), int(np.floor((y - origin[1]) * per_mm))
        k0 = int(np.floor((z - origin[2]) * per_mm))
        ux, uy, uz, vx, vy, vz = _across(normals[f, 0], normals[f, 1], normals[f, 2])
        octants = 0
        for step in range(27):
            # the foot's own cell first
            i, j, k = i0 + (step + 1) % 3 - 1, j0 + (step // 3 + 1) % 3 - 1, k0 + (step // 9 + 1) % 3 - 1
            if min(i, j, k) < 0 or max(i, j, k) >= AXIS_CELLS:
                continue
            slot = find_slot(grid.table_keys, cell_key(i, j, k))
            if grid.table_keys[slot] < 0:
                continue
            cell = grid.table_cells[slot]
            for at in range(starts[cell], starts[cell + 1]):
                dx, dy, dz = points[order[at], 0] - x, points[order[at], 1] - y, points[order[at], 2] - z
                if dx * dx + dy * dy + dz * dz <= radius * radius:
                    octants |= 1 << _octant(ux * dx + uy * dy + uz * dz, vx * dx + vy * dy + vz * dz)
            if octants == 255:
                break
        run = 0
        for octant in range(16):  # once round, and on to where the first run ends
            run = 0 if octants >> (octant % 8) & 1 else run + 1
            runs[f] = max(runs[f], run)
    return runs


@njit(cache=True, nogil=True, inline="always")
def _octant(a: float, b: float) -> int:
    """Which eighth of the circle the direction (a, b) lies in, 0 to 7, one after another."""
    half = 0 if b >= 0 else 4
    if b < 0:
        a, b = -a, -b
    if a >= 0:
        return half + (0 if b < a else 1)
    return half + (2 if b > -a else 3)


@njit(cache=True, nogil=True)
def _across(x: float, y: float, z: float) -> tuple[float, float, float, float, float, float]:
    """Two unit vectors square to a unit normal (x, y, z) and to each other, one behind the other."""
    ux, uy, uz = (y, -x, 0.0) if abs(z) < 0.9 else (0.0, z, -y)
    length = max(np.sqrt(ux * ux + uy * uy + uz * uz), 1e-300)  # none where there is no surface
    ux, uy, uz = ux / length, uy / length, uz / length
    return ux, uy, uz, y * uz - z * uy, z * ux - x * uz, x * uy - y * ux


@njit(cache=True, nogil=True)
def _largest_gaps(points: Floats, feet: Floats, normals: Floats, starts: Integers, indices: Integers) -> Floats:
    """Largest angle (N,) about each foot's normal between successive neighbours."""
    gaps = np.full(len(feet), 2 * np.pi)
    for f in range(len(feet)):
        count = starts[f + 1] - starts[f]
        if count < 4:
            continue
        ux, uy, uz, vx, vy, vz = _across(normals[f, 0], normals[f, 1], normals[f, 2])
        angles = np.empty(count)
        for k in range(count):
            d = points[indices[starts[f] + k]] - feet[f]
            angles[k] = np.arctan2(vx * d[0] + vy * d[1] + vz * d[2], ux * d[0] + uy * d[1] + uz * d[2])
        angles.sort()
        gap = angles[0] + 2 * np.pi - angles[-1]
        for k in range(1, count):
            gap = max(gap, angles[k] - angles[k - 1])
        gaps[f] = gap
    return gaps
