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
from grindvision.vision.surface.neighbour_sweep import (
    CellSweep,
    build_sweep,
    copy_runs,
    copy_shifted,
    cursor_before,
    move_to,
    sweep,
)
from grindvision.vision.surface.normals import smallest_eigenpair

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Singles = NDArray[np.float32]
Normal = tuple[float, float, float]
Row = tuple[np.float32, np.float32, np.float32]

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
    around, near, kept = _buffers(4096)
    equations = np.empty((TERMS, TERMS + 1))
    for cell in range(first, last):
        used, count = move_to(cell, cells, cursor)
        if count > around.shape[1]:
            around, near, kept = _buffers(2 * count)
        begin, size = starts[cell], starts[cell + 1] - starts[cell]
        own = np.empty((3, size), np.float32)
        for axis in range(3):
            centre = places[axis, begin]
            copy_runs(places[axis], cursor.runs, used, centre, around[axis])
            copy_shifted(places[axis, begin : begin + size], centre, own[axis])
        block_of = _blocks(own)
        for block in range(8):
            candidates = -1
            for m in range(size):
                if block_of[m] != block:
                    continue
                if candidates < 0:
                    candidates = _near_block(around, count, own, block_of, block, radius, near)
                inside = _keep(near, candidates, own[0, m], own[1, m], own[2, m], radius, kept)
                if inside < 3:
                    continue
                x, y, z, nx, ny, nz = _plane(kept, inside)
                height = x * nx + y * ny + z * nz
                if order == 2 and inside >= TERMS:
                    height += _paraboloid(kept, inside, height, (nx, ny, nz), radius, equations)
                p, at = cells.order[begin + m], begin + m
                moved[p, 0] = places[0, at] + height * nx
                moved[p, 1] = places[1, at] + height * ny
                moved[p, 2] = places[2, at] + height * nz


@njit(cache=True, nogil=True)
def _buffers(size: int) -> tuple[Singles, Singles, Singles]:
    """Room for so many points around a cell, points near a block of it, and neighbours of one point."""
    return np.empty((3, size), np.float32), np.empty((3, size), np.float32), np.empty((8, size), np.float32)


@njit(cache=True, nogil=True)
def _blocks(own: Singles) -> Integers:
    """Octant (N,) of every place (3, N) about the middle of their bounding box."""
    blocks = np.zeros(own.shape[1], np.int64)
    for axis in range(3):
        middle = (own[axis].min() + own[axis].max()) / 2
        for m in range(len(blocks)):
            blocks[m] = 2 * blocks[m] + (own[axis, m] > middle)
    return blocks


@njit(cache=True, nogil=True)
def _near_block(
    around: Singles, count: int, own: Singles, block_of: Integers, block: int, radius: float, near: Singles
) -> int:
    """Those of the first ``count`` points ``around`` that may be neighbours of one of a block, into ``near``: how many.

    They are all within the radius of a ball about the block, and fewer by a third than those around its cell.
    """
    cx, cy, cz, reach = _ball(own, block_of, block)
    limit = np.float32((radius * 1.00001 + reach) ** 2)
    found = 0
    for m in range(count):
        x, y, z = around[0, m], around[1, m], around[2, m]
        dx, dy, dz = x - cx, y - cy, z - cz
        near[0, found], near[1, found], near[2, found] = x, y, z
        found += dx * dx + dy * dy + dz * dz <= limit
    return found


@njit(cache=True, nogil=True)
def _ball(own: Singles, block_of: Integers, block: int) -> tuple[np.float32, np.float32, np.float32, float]:
    """Centre and radius of a ball that holds all places (3, N) of one block."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for m in range(len(block_of)):
        if block_of[m] == block:
            for axis in range(3):
                low[axis], high[axis] = min(low[axis], own[axis, m]), max(high[axis], own[axis, m])
    centre, reach = (low + high) / 2, np.sqrt(((high - low) ** 2).sum()) / 2
    return np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2]), reach


@njit(cache=True, nogil=True, fastmath=True)
def _keep(
    near: Singles, count: int, px: np.float32, py: np.float32, pz: np.float32, radius: float, kept: Singles
) -> int:
    """Those of the first ``count`` points within the radius of a point, relative to it, into ``kept``: how many."""
    limit = radius * radius
    inside = 0
    for m in range(count):
        dx, dy, dz = near[0, m] - px, near[1, m] - py, near[2, m] - pz
        # always written, and overwritten if too far: a quarter are, no processor guesses which
        kept[0, inside], kept[1, inside], kept[2, inside] = dx, dy, dz
        inside += 1 if dx * dx + dy * dy + dz * dz <= limit else 0
    return inside


@njit(cache=True, nogil=True, fastmath=True)
def _plane(kept: Singles, near: int) -> tuple[float, float, float, float, float, float]:
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
def _paraboloid(kept: Singles, near: int, height: float, normal: Normal, radius: float, equations: Floats) -> float:
    """Height at the point of the weighted paraboloid over the plane, whose foot lies ``height`` along the normal."""
    nx, ny, nz = normal
    if abs(nx) < 0.6:
        ux, uy, uz = 0.0, -nz, ny
    else:
        ux, uy, uz = nz, 0.0, -nx
    length = np.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
    per = 1.0 / radius
    to_u = np.float32(ux * per), np.float32(uy * per), np.float32(uz * per)
    to_v = np.float32(vx * per), np.float32(vy * per), np.float32(vz * per)
    to_f = np.float32(nx * per), np.float32(ny * per), np.float32(nz * per)
    _weigh(kept, near, (to_u, to_v, to_f), np.float32(height * per), equations)
    _third_and_fourth_moments(kept, near, equations)
    return radius * _first_unknown(equations)


@njit(cache=True, nogil=True, fastmath=True)
def _weigh(kept: Singles, near: int, frame: tuple[Row, Row, Row], foot: np.float32, equations: Floats) -> None:
    """Weights of the neighbours and all sums of the normal equations but those of third and fourth powers.

    A neighbour's u and v, and its weight by their products of second order, are left in rows 3 to 7 of ``kept``: one
    loop over all 21 sums would have more of them than the processor has registers, and be slower than two.
    """
    (a0, a1, a2), (b0, b1, b2), (c0, c1, c2) = frame
    zero: Any = np.float32(0)
    one: Any = np.float32(1)
    half, sixth = np.float32(0.5), np.float32(1 / 6)
    f24, f120, f720 = np.float32(1 / 24), np.float32(1 / 120), np.float32(1 / 720)
    m00, m10, m01, m20, m11, m02 = zero, zero, zero, zero, zero, zero
    r00, r10, r01, r20, r11, r02 = zero, zero, zero, zero, zero, zero
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
        kept[3, m], kept[4, m], kept[5, m], kept[6, m], kept[7, m] = u, v, wuu, wuv, wvv
        m00 += w
        m10 += wu
        m01 += wv
        m20 += wuu
        m11 += wuv
        m02 += wvv
        r00 += w * f
        r10 += wu * f
        r01 += wv * f
        r20 += wuu * f
        r11 += wuv * f
        r02 += wvv * f
    row, last = equations, TERMS
    row[0, 0], row[0, 1], row[0, 2], row[0, 3], row[0, 4], row[0, 5] = m00, m10, m01, m20, m11, m02
    row[1, 1], row[1, 2], row[2, 2] = m20, m11, m02
    row[0, last], row[1, last], row[2, last] = r00, r10, r01
    row[3, last], row[4, last], row[5, last] = r20, r11, r02


@njit(cache=True, nogil=True, fastmath=True)
def _third_and_fourth_moments(kept: Singles, near: int, equations: Floats) -> None:
    """The sums that ``_weigh`` leaves out, from what it leaves behind."""
    zero: Any = np.float32(0)
    m30, m21, m12, m03, m40, m31, m22, m13, m04 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for m in range(near):
        u, v, wuu, wuv, wvv = kept[3, m], kept[4, m], kept[5, m], kept[6, m], kept[7, m]
        m30 += wuu * u
        m21 += wuu * v
        m12 += wuv * v
        m03 += wvv * v
        m40 += wuu * u * u
        m31 += wuu * u * v
        m22 += wuu * v * v
        m13 += wuv * v * v
        m04 += wvv * v * v
    row = equations
    row[1, 3], row[1, 4], row[1, 5] = m30, m21, m12
    row[2, 3], row[2, 4], row[2, 5] = m21, m12, m03
    row[3, 3], row[3, 4], row[3, 5] = m40, m31, m22
    row[4, 4], row[4, 5], row[5, 5] = m22, m13, m04


@njit(cache=True, nogil=True)
def _first_unknown(equations: Floats) -> float:
    """First unknown of a symmetric positive system (n, n + 1), eliminated from the last one upwards; 0 if singular.

    Only the upper triangle is read, and overwritten.
    """
    size = len(equations)
    scale = equations[0, 0]
    for k in range(size - 1, 0, -1):
        if not equations[k, k] > 1e-9 * scale:
            return 0.0
        for i in range(k):
            factor = equations[i, k] / equations[k, k]
            for j in range(i, k):
                equations[i, j] -= factor * equations[j, k]
            equations[i, size] -= factor * equations[k, size]
    return equations[0, size] / equations[0, 0] if equations[0, 0] > 0 else 0.0
