"""The groove feature histograms of peng2020: how much the normals around a point turn, locally and against the whole.

For a point p with N other points within the radius: local angles ``acos(n_p . n_j)`` (Eq 2), global angles
``acos(n_j . n_base)`` (Eq 4) with the base normal n_base, the unit sum of all normals (Eq 3). The variation of each
set about its mean (Eq 5) multiplied gives the descriptor D (Eq 6; its formula is lost in our copy of the paper). Angles
are in degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import check_points, vector_angle
from grindvision.kernels import njit
from grindvision.records import by_content
from grindvision.vision.surface.neighbour_sweep import CellSweep, build_sweep, copy_runs, cursor_before, move_to, sweep
from grindvision.vision.surface.normals import smallest_eigenpair

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

ACOS = tuple(
    np.float32(k)
    for k in (
        1.5707963050,
        -0.2145988016,
        0.0889789874,
        -0.0501743046,
        0.0308918810,
        -0.0170881256,
        0.0066700901,
        -0.0012624911,
    )
)
"""acos(c) / sqrt(1 - c) as a polynomial of 0 <= c <= 1: Abramowitz and Stegun 4.4.46, error below 2e-8 rad."""


@by_content
@dataclass(frozen=True)
class GrooveFeatures:
    """Variation of the local and of the global angles of every point, degrees squared, and the base normal (3,)."""

    local_deg2: Floats
    global_deg2: Floats
    base_normal: Floats

    @property
    def descriptor(self) -> Floats:
        """D = V_local V_global, degrees to the fourth (N,)."""
        return self.local_deg2 * self.global_deg2

    @property
    def spread_deg(self) -> Floats:
        """Fourth root of D (N,): the geometric mean of both standard deviations, degrees."""
        return np.sqrt(np.sqrt(self.descriptor))

    def __str__(self) -> str:
        return f"groove features of {len(self.local_deg2):,} points, spread median {np.median(self.spread_deg):.2f} deg"


@by_content
@dataclass(frozen=True)
class AngleHistograms:
    """All local and global angles (N,) in degrees of one point's neighbours."""

    local_deg: Floats
    global_deg: Floats

    def __str__(self) -> str:
        local, whole = self.local_deg.std(), self.global_deg.std()
        return f"{len(self.local_deg)} neighbours: local std {local:.2f}, global {whole:.2f} deg"


def plane_normals(points: ArrayLike, radius_mm: float, towards: ArrayLike) -> Floats:
    """Unit normals (N, 3) by principal components of all neighbours within ``radius_mm``, on the side of ``towards``.

    Args:
        points: finite points (N, 3), mm.
        radius_mm: neighbourhood radius.
        towards: direction (3,) or a direction per point (N, 3).

    A point with fewer than three neighbours gets ``towards`` itself.
    """
    points = check_points(points, "points", min_points=3)
    if not radius_mm > 0:
        raise InputError(f"the normal radius is {radius_mm} mm; it must be above zero")
    up = np.broadcast_to(np.asarray(towards, dtype=float), points.shape)
    normals = up / np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-12)
    sweep(_normals, build_sweep(points, radius_mm), np.float32(radius_mm), normals)
    return normals


def base_normal(normals: ArrayLike) -> Floats:
    """Unit sum (3,) of all normals (N, 3) (Eq 3).

    Raises:
        DegenerateError: the normals cancel.
    """
    total = np.asarray(normals, dtype=float).sum(axis=0)
    length = np.linalg.norm(total)
    if not length > 1e-6 * len(np.atleast_2d(normals)):
        raise DegenerateError("the normals cancel each other; orient them to one side first")
    return total / length


def groove_features(points: ArrayLike, normals: ArrayLike, radius_mm: float) -> GrooveFeatures:
    """Variation of local and global angles of points (N, 3) with unit normals (N, 3); 0 with fewer than 2 others."""
    points = check_points(points, "points", min_points=3)
    normals = np.ascontiguousarray(normals, dtype=float)
    base = base_normal(normals)
    turn = np.degrees(vector_angle(normals, base)).astype(np.float32)
    local, whole = np.zeros(len(points)), np.zeros(len(points))
    cells = build_sweep(points, radius_mm)
    sorted_normals = np.ascontiguousarray(normals[cells.order].T)
    sweep(_angles, cells, np.float32(radius_mm), sorted_normals, turn[cells.order], local, whole)
    return GrooveFeatures(local, whole, base)


def angle_histograms(points: ArrayLike, normals: ArrayLike, index: int, radius_mm: float) -> AngleHistograms:
    """Every angle behind the features of one point, for looking at (Figures 8 and 10)."""
    points, normals = np.asarray(points, dtype=float), np.asarray(normals, dtype=float)
    near = np.linalg.norm(points - points[index], axis=1) <= radius_mm
    near[index] = False
    return AngleHistograms(
        np.degrees(vector_angle(normals[index], normals[near])),
        np.degrees(vector_angle(normals[near], base_normal(normals))),
    )


def vote(points: ArrayLike, marked: ArrayLike, radius_mm: float) -> Flags:
    """Majority vote: a point is marked when more than half of all points within ``radius_mm``, itself included, are."""
    points = check_points(points, "points")
    result = np.zeros(len(points), dtype=bool)
    cells = build_sweep(points, radius_mm)
    sweep(_vote, cells, np.float32(radius_mm), np.asarray(marked, dtype=np.float32)[cells.order], result)
    return result


@njit(cache=True, nogil=True, fastmath=True)
def _normals(
    first: int,
    last: int,
    cells: CellSweep,
    radius: float,
    normals: Floats,
) -> None:
    """Unit normals (N, 3) of the points in cells ``first`` to ``last``, by the direction of least variance."""
    places, order, starts = cells.places, cells.order, cells.starts
    cursor = cursor_before(first, cells)
    near = np.empty((3, 1024), np.float32)
    limit = radius * radius
    zero: Any = np.float32(0)
    one: Any = np.float32(1)
    for cell in range(first, last):
        used, count = move_to(cell, cells, cursor)
        if count > near.shape[1]:
            near = np.empty((3, 2 * count), np.float32)
        centre = places[:, starts[cell]]
        for axis in range(3):
            copy_runs(places[axis], cursor.runs, used, centre[axis], near[axis])
        for at in range(starts[cell], starts[cell + 1]):
            p = order[at]
            px = np.float32(places[0, at] - centre[0])
            py = np.float32(places[1, at] - centre[1])
            pz = np.float32(places[2, at] - centre[2])
            n, sx, sy, sz, xx, xy, xz, yy, yz, zz = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
            for m in range(count):
                dx, dy, dz = near[0, m] - px, near[1, m] - py, near[2, m] - pz
                w = one if dx * dx + dy * dy + dz * dz <= limit else zero
                n += w
                sx += w * dx
                sy += w * dy
                sz += w * dz
                xx += w * dx * dx
                xy += w * dx * dy
                xz += w * dx * dz
                yy += w * dy * dy
                yz += w * dy * dz
                zz += w * dz * dz
            if n < 3:
                continue
            fraction = 1.0 / n
            mx, my, mz = sx * fraction, sy * fraction, sz * fraction
            _, nx, ny, nz = smallest_eigenpair(
                xx * fraction - mx * mx, xy * fraction - mx * my, xz * fraction - mx * mz,
                yy * fraction - my * my, yz * fraction - my * mz, zz * fraction - mz * mz,
            )  # fmt: skip
            side = 1.0 if nx * normals[p, 0] + ny * normals[p, 1] + nz * normals[p, 2] >= 0 else -1.0
            normals[p, 0], normals[p, 1], normals[p, 2] = side * nx, side * ny, side * nz


@njit(cache=True, nogil=True, fastmath=True)
def _angles(
    first: int,
    last: int,
    cells: CellSweep,
    radius: float,
    normals: Floats,
    turn: Floats,
    local: Floats,
    whole: Floats,
) -> None:
    """Variances (N,) of the two angles of the histogram over the neighbours of the points of some cells."""
    places, order, starts = cells.places, cells.order, cells.starts
    cursor = cursor_before(first, cells)
    near = np.empty((7, 1024), np.float32)
    limit = radius * radius
    zero: Any = np.float32(0)
    one: Any = np.float32(1)
    two, degrees = np.float32(2), np.float32(180 / np.pi)
    k0, k1, k2, k3, k4, k5, k6, k7 = ACOS
    pi = np.float32(np.pi)
    for cell in range(first, last):
        used, count = move_to(cell, cells, cursor)
        if count > near.shape[1]:
            near = np.empty((7, 2 * count), np.float32)
        centre = places[:, starts[cell]]
        for axis in range(3):
            copy_runs(places[axis], cursor.runs, used, centre[axis], near[axis])
            copy_runs(normals[axis], cursor.runs, used, 0.0, near[3 + axis])
        copy_runs(turn, cursor.runs, used, 0.0, near[6])
        for at in range(starts[cell], starts[cell + 1]):
            p = order[at]
            px = np.float32(places[0, at] - centre[0])
            py = np.float32(places[1, at] - centre[1])
            pz = np.float32(places[2, at] - centre[2])
            nx, ny, nz = np.float32(normals[0, at]), np.float32(normals[1, at]), np.float32(normals[2, at])
            here = turn[at]
            n, t1, t2, g1, g2 = -one, zero, zero, zero, zero
            for m in range(count):
                dx, dy, dz = near[0, m] - px, near[1, m] - py, near[2, m] - pz
                w = one if dx * dx + dy * dy + dz * dz <= limit else zero
                bx, by, bz = near[3, m] - nx, near[4, m] - ny, near[5, m] - nz
                # 1 - cosine from the chord: in single precision a cosine near 1 leaves 0.02 deg of an angle of 0
                fall = (bx * bx + by * by + bz * bz) / two
                short = max(min(fall, two - fall), zero)
                c = one - short
                bend = np.sqrt(short) * (k0 + c * (k1 + c * (k2 + c * (k3 + c * (k4 + c * (k5 + c * (k6 + c * k7)))))))
                t = degrees * (bend if fall <= one else pi - bend)
                g = near[6, m] - here
                n += w
                t1 += w * t
                t2 += w * t * t
                g1 += w * g
                g2 += w * g * g
            # the point itself is in the sums, with both angles (relative to its own) zero
            if n >= 2:
                fraction = 1.0 / n
                local[p] = max(t2 * fraction - (t1 * fraction) ** 2, 0.0)
                whole[p] = max(g2 * fraction - (g1 * fraction) ** 2, 0.0)


@njit(cache=True, nogil=True, fastmath=True)
def _vote(
    first: int,
    last: int,
    cells: CellSweep,
    radius: float,
    marked: NDArray[np.float32],
    result: Floats,
) -> None:
    """Whether most neighbours of each point of cells ``first`` to ``last`` are ``marked`` (N,), into ``result``
    (N,)."""
    places, order, starts = cells.places, cells.order, cells.starts
    cursor = cursor_before(first, cells)
    near = np.empty((4, 1024), np.float32)
    limit = radius * radius
    zero: Any = np.float32(0)
    one: Any = np.float32(1)
    for cell in range(first, last):
        used, count = move_to(cell, cells, cursor)
        if count > near.shape[1]:
            near = np.empty((4, 2 * count), np.float32)
        copy_runs(marked, cursor.runs, used, 0.0, near[3])
        if near[3, :count].max() == 0:
            continue
        centre = places[:, starts[cell]]
        for axis in range(3):
            copy_runs(places[axis], cursor.runs, used, centre[axis], near[axis])
        for at in range(starts[cell], starts[cell + 1]):
            p = order[at]
            px = np.float32(places[0, at] - centre[0])
            py = np.float32(places[1, at] - centre[1])
            pz = np.float32(places[2, at] - centre[2])
            n, yes = zero, zero
            for m in range(count):
                dx, dy, dz = near[0, m] - px, near[1, m] - py, near[2, m] - pz
                w = one if dx * dx + dy * dy + dz * dz <= limit else zero
                n += w
                yes += w * near[3, m]
            result[p] = 2 * yes > n
