"""Moving least squares: every point moved onto a polynomial fitted to its neighbours, as PCL's MovingLeastSquares does.

PCL's choices, which the paper took over unseen: the plane is the unweighted one of all neighbours, the polynomial's
weights are exp(-d^2 / r^2), and the point is moved straight along the plane's normal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry import check_points
from grindvision.kernels import njit
from grindvision.vision.surface.neighbour_sweep import CellSweep, build_sweep, copy_runs, cursor_before, move_to, sweep
from grindvision.vision.surface.normals import smallest_eigenpair

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Terms of the polynomial of order 2; with fewer neighbours the plane is used.
TERMS = 6


def smooth_mls(points: ArrayLike, radius_mm: float, order: int = 2) -> Floats:
    """Points (N, 3) after moving least squares with neighbours within ``radius_mm``; order of the points kept.

    Args:
        points: finite points, mm.
        radius_mm: neighbourhood; also the width of the weights.
        order: 1 moves points onto the plane of their neighbours, 2 onto a paraboloid.

    A point with fewer than three neighbours stays where it is.

    Raises:
        InputError: bad radius or order.
    """
    points = check_points(points, "points", min_points=3)
    if not radius_mm > 0:
        raise InputError(f"the MLS radius is {radius_mm} mm; it must be above zero")
    if order not in (1, 2):
        raise InputError(f"the MLS order is {order}; use 1 (planes) or 2 (paraboloids)")
    moved = points.copy()
    sweep(_move, build_sweep(points, radius_mm), np.float32(radius_mm), order, moved)
    return moved


@njit(cache=True, nogil=True, fastmath=True)
def _move(
    first: int,
    last: int,
    cells: CellSweep,
    radius: float,
    order: int,
    moved: Floats,
) -> None:
    """Points of cells ``first`` to ``last`` moved onto the polynomial of the given order through their neighbours."""
    places, starts = cells.places, cells.starts
    cursor = cursor_before(first, cells)
    around = np.empty((3, 4096), np.float32)
    kept = np.empty((3, 4096), np.float32)
    limit = radius * radius
    for cell in range(first, last):
        used, count = move_to(cell, cells, cursor)
        if count > around.shape[1]:
            around = np.empty((3, 2 * count), np.float32)
            kept = np.empty((3, 2 * count), np.float32)
        centre = places[:, starts[cell]]
        for axis in range(3):
            copy_runs(places[axis], cursor.runs, used, centre[axis], around[axis])
        for at in range(starts[cell], starts[cell + 1]):
            p = cells.order[at]
            px = np.float32(places[0, at] - centre[0])
            py = np.float32(places[1, at] - centre[1])
            pz = np.float32(places[2, at] - centre[2])
            near = 0
            for m in range(count):
                dx, dy, dz = around[0, m] - px, around[1, m] - py, around[2, m] - pz
                kept[0, near], kept[1, near], kept[2, near] = dx, dy, dz
                near += 1 if dx * dx + dy * dy + dz * dz <= limit else 0
            if near < 3:
                continue
            sx, sy, sz, nx, ny, nz = _plane(kept, near)
            height = sx * nx + sy * ny + sz * nz
            if order == 2 and near >= TERMS:
                height += _paraboloid(kept, near, height, nx, ny, nz, radius)
            moved[p, 0] = places[0, at] + height * nx
            moved[p, 1] = places[1, at] + height * ny
            moved[p, 2] = places[2, at] + height * nz


@njit(cache=True, nogil=True, fastmath=True)
def _plane(kept: NDArray[np.float32], near: int) -> tuple[float, float, float, float, float, float]:
    """Mean (relative to the point) and unit normal of the neighbours."""
    zero: Any = np.float32(0)
    sx, sy, sz, xx, xy, xz, yy, yz, zz = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for m in range(near):
        dx, dy, dz = kept[0, m], kept[1, m], kept[2, m]
        sx += dx
        sy += dy
        sz += dz
        xx += dx * dx
        xy += dx * dy
        xz += dx * dz
        yy += dy * dy
        yz += dy * dz
        zz += dz * dz
    fraction = 1.0 / near
    mx, my, mz = sx * fraction, sy * fraction, sz * fraction
    _, nx, ny, nz = smallest_eigenpair(
        xx * fraction - mx * mx, xy * fraction - mx * my, xz * fraction - mx * mz,
        yy * fraction - my * my, yz * fraction - my * mz, zz * fraction - mz * mz,
    )  # fmt: skip
    return mx, my, mz, nx, ny, nz


@njit(cache=True, nogil=True, fastmath=True)
def _paraboloid(
    kept: NDArray[np.float32], near: int, height: float, nx: float, ny: float, nz: float, radius: float
) -> float:
    """Height at the point of the weighted paraboloid over the plane, whose foot lies ``height`` along the normal."""
    if abs(nx) < 0.6:
        ux, uy, uz = 0.0, -nz, ny
    else:
        ux, uy, uz = nz, 0.0, -nx
    length = np.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
    per = 1.0 / radius
    a0, a1, a2 = np.float32(ux * per), np.float32(uy * per), np.float32(uz * per)
    b0, b1, b2 = np.float32(vx * per), np.float32(vy * per), np.float32(vz * per)
    c0, c1, c2 = np.float32(nx * per), np.float32(ny * per), np.float32(nz * per)
    foot = np.float32(height * per)
    zero, half, sixth = np.float32(0), np.float32(0.5), np.float32(1 / 6)
    m00, m10, m01, m20, m11, m02, m30, m21, m12, m03 = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    m40, m31, m22, m13, m04 = zero, zero, zero, zero, zero
    r00, r10, r01, r20, r11, r02 = zero, zero, zero, zero, zero, zero
    one = np.float32(1)
    f24, f120, f720 = np.float32(1 / 24), np.float32(1 / 120), np.float32(1 / 720)
    for m in range(near):
        dx, dy, dz = kept[0, m], kept[1, m], kept[2, m]
        u = dx * a0 + dy * a1 + dz * a2
        v = dx * b0 + dy * b1 + dz * b2
        f = dx * c0 + dy * c1 + dz * c2 - foot
        # exp(-s) as exp(-s/2)^2 by its series: s is at most about 1, the error below 2e-6
        h = -half * (u * u + v * v + f * f)
        e = one + h * (one + h * (half + h * (sixth + h * (f24 + h * (f120 + h * f720)))))
        w = e * e
        wu, wv = w * u, w * v
        wuu, wuv, wvv = wu * u, wu * v, wv * v
        m00 += w
        m10 += wu
        m01 += wv
        m20 += wuu
        m11 += wuv
        m02 += wvv
        m30 += wuu * u
        m21 += wuu * v
        m12 += wuv * v
        m03 += wvv * v
        m40 += wuu * u * u
        m31 += wuu * u * v
        m22 += wuu * v * v
        m13 += wuv * v * v
        m04 += wvv * v * v
        r00 += w * f
        r10 += wu * f
        r01 += wv * f
        r20 += wuu * f
        r11 += wuv * f
        r02 += wvv * f
    matrix = np.array(
        [
            [m00, m10, m01, m20, m11, m02, r00],
            [m10, m20, m11, m30, m21, m12, r10],
            [m01, m11, m02, m21, m12, m03, r01],
            [m20, m30, m21, m40, m31, m22, r20],
            [m11, m21, m12, m31, m22, m13, r11],
            [m02, m12, m03, m22, m13, m04, r02],
        ],
        dtype=np.float64,
    )
    return radius * _first_unknown(matrix)


@njit(cache=True, nogil=True)
def _first_unknown(matrix: Floats) -> float:
    """First unknown of a symmetric positive system (n, n + 1), eliminated from the last one upwards; 0 if singular."""
    size = len(matrix)
    scale = matrix[0, 0]
    for k in range(size - 1, 0, -1):
        if not matrix[k, k] > 1e-9 * scale:
            return 0.0
        for i in range(k):
            factor = matrix[i, k] / matrix[k, k]
            for j in range(k):
                matrix[i, j] -= factor * matrix[k, j]
            matrix[i, size] -= factor * matrix[k, size]
    return matrix[0, size] / matrix[0, 0] if matrix[0, 0] > 0 else 0.0
