"""Point-to-plane ICP of oriented points onto surfels: robust weights, and no pairs beside the target's edge."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import check_points, check_rigid, nearest_rotation, rigid
from grindvision.geometry.neighbours import nearest_one
from grindvision.vision.icp import FineRegistration, registration_result
from grindvision.vision.surfels import Surfels

Floats = NDArray[np.float64]


def icp_planes(
    source: ArrayLike,
    source_normals: ArrayLike,
    target: Surfels,
    T_start: ArrayLike | None = None,
    most_mm: float | None = None,
    least_scale_mm: float = 0.0,
    iterations: int = 30,
) -> FineRegistration:
    """Point-to-plane ICP of points (N, 3) with normals (N, 3) onto surfels.

    Residuals are weighted by Tukey's function of their own spread, so beads, outliers and the part of a scan the other
    one does not show pull nothing. Points beside the target's edge (farther along the plane than a cell and a half),
    or whose normal turns more than 45 degrees away from the target's, are not used.

    Args:
        most_mm: pairs farther apart are not used; three cells when left out.
        least_scale_mm: floor of the residuals' spread.

    Raises:
        DegenerateError: fewer than 12 pairs.
    """
    source = check_points(source, "source points", 12)
    transform = np.eye(4) if T_start is None else check_rigid(T_start, "T_start")
    normals = np.ascontiguousarray(source_normals, dtype=float)
    grid = target.grid
    most = 3 * grid.size_mm if most_mm is None else float(most_mm)
    transform, information, centre, errors, weight, pairs, converged = _plane_icp(
        np.ascontiguousarray(source), normals, transform, most, 1.5 * grid.size_mm, float(least_scale_mm), iterations,
        target.normals, grid.points, grid.order, grid.starts, grid.table_keys, grid.table_cells, grid.origin_mm,
        1.0 / grid.size_mm,
    )  # fmt: skip
    if pairs < 12:
        raise DegenerateError(f"only {pairs} points of the scans meet within {most:.3g} mm; they do not overlap there")
    transform = rigid(nearest_rotation(transform[:3, :3]), transform[:3, 3])
    rms = float(np.sqrt(errors[-1]))
    return registration_result(transform, rms, pairs / len(source), errors, converged, centre, information, weight, rms)


@njit(cache=True, nogil=True)
def solve_definite(matrix, right):
    """Solution (n,) of a small symmetric positive definite system (n, n), by elimination without pivots."""
    rows, solution = matrix.copy(), right.copy()
    count = len(right)
    for a in range(count):
        for b in range(a + 1, count):
            share = rows[b, a] / rows[a, a]
            for c in range(a, count):
                rows[b, c] -= share * rows[a, c]
            solution[b] -= share * solution[a]
    for a in range(count - 1, -1, -1):
        for c in range(a + 1, count):
            solution[a] -= rows[a, c] * solution[c]
        solution[a] /= rows[a, a]
    return solution


@njit(cache=True, nogil=True)
def _plane_icp(
    source, normals, transform, most, beside, least_scale, iterations,
    target_normals, points, order, starts, table_keys, table_cells, origin, per_mm,
):  # fmt: skip
    count = len(source)
    current = transform.copy()
    moved, residual = np.empty((count, 3)), np.empty(count)
    match = np.empty(count, dtype=np.int64)
    errors = np.zeros(iterations)
    done, converged = 0, False
    matrix, right = np.zeros((6, 6)), np.zeros(6)
    centre = np.zeros(3)
    row = np.empty(6)
    pairs, total = 0, 0.0
    for iteration in range(iterations):
        rotation = current[:3, :3]
        pairs = 0
        centre[:] = 0.0
        for p in range(count):
            x = (
                rotation[0, 0] * source[p, 0]
                + rotation[0, 1] * source[p, 1]
                + rotation[0, 2] * source[p, 2]
                + current[0, 3]
            )
            y = (
                rotation[1, 0] * source[p, 0]
                + rotation[1, 1] * source[p, 1]
                + rotation[1, 2] * source[p, 2]
                + current[1, 3]
            )
            z = (
                rotation[2, 0] * source[p, 0]
                + rotation[2, 1] * source[p, 1]
                + rotation[2, 2] * source[p, 2]
                + current[2, 3]
            )
            moved[p, 0], moved[p, 1], moved[p, 2] = x, y, z
            q, squared = nearest_one(x, y, z, most, points, order, starts, table_keys, table_cells, origin, per_mm)
            match[p] = -1
            if q < 0:
                continue
            n = target_normals[q]
            facing = 0.0
            for k in range(3):
                facing += n[k] * (
                    rotation[k, 0] * normals[p, 0] + rotation[k, 1] * normals[p, 1] + rotation[k, 2] * normals[p, 2]
                )
            along = n[0] * (x - points[q, 0]) + n[1] * (y - points[q, 1]) + n[2] * (z - points[q, 2])
            if facing < 0.7 or squared - along * along > beside * beside:
                continue
            match[p], residual[p] = q, along
            centre += moved[p]
            pairs += 1
        if pairs < 12:
            break
        centre /= pairs
        sizes = np.empty(pairs)
        at = 0
        for p in range(count):
            if match[p] >= 0:
                sizes[at] = abs(residual[p])
                at += 1
        scale = max(1.4826 * np.median(sizes), least_scale, 1e-12)
        cut = 4.685 * scale
        matrix[:, :], right[:] = 0.0, 0.0
        total, square = 0.0, 0.0
        for p in range(count):
            if match[p] < 0 or abs(residual[p]) >= cut:
                continue
            weight = (1 - (residual[p] / cut) ** 2) ** 2
            n = target_normals[match[p]]
            x, y, z = moved[p, 0] - centre[0], moved[p, 1] - centre[1], moved[p, 2] - centre[2]
            row[0], row[1], row[2] = n[0], n[1], n[2]
            row[3], row[4], row[5] = y * n[2] - z * n[1], z * n[0] - x * n[2], x * n[1] - y * n[0]
            for a in range(6):
                for b in range(a, 6):
                    matrix[a, b] += weight * row[a] * row[b]
                right[a] -= weight * row[a] * residual[p]
            total += weight
            square += weight * residual[p] ** 2
        for a in range(6):
            for b in range(a):
                matrix[a, b] = matrix[b, a]
        errors[iteration] = square / total
        done = iteration + 1
        damped = matrix.copy()
        extent = (matrix[3, 3] + matrix[4, 4] + matrix[5, 5]) / max(matrix[0, 0] + matrix[1, 1] + matrix[2, 2], 1e-300)
        for a in range(3):
            damped[a, a] += 1e-6 * total
            damped[3 + a, 3 + a] += 1e-6 * total * extent
        step = solve_definite(damped, right)
        turn = np.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
        spin = np.eye(3)
        if turn > 0:
            ax, ay, az = step[3] / turn, step[4] / turn, step[5] / turn
            c, s = np.cos(turn), np.sin(turn)
            spin[0, 0], spin[0, 1], spin[0, 2] = (
                c + ax * ax * (1 - c),
                ax * ay * (1 - c) - az * s,
                ax * az * (1 - c) + ay * s,
            )
            spin[1, 0], spin[1, 1], spin[1, 2] = (
                ay * ax * (1 - c) + az * s,
                c + ay * ay * (1 - c),
                ay * az * (1 - c) - ax * s,
            )
            spin[2, 0], spin[2, 1], spin[2, 2] = (
                az * ax * (1 - c) - ay * s,
                az * ay * (1 - c) + ax * s,
                c + az * az * (1 - c),
            )
        shift = spin @ (current[:3, 3] - centre) + centre + step[:3]
        current[:3, :3] = spin @ np.ascontiguousarray(current[:3, :3])
        current[:3, 3] = shift
        if np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2) + turn * np.sqrt(extent) < 1e-3 * scale:
            converged = True
            break
    return current, matrix, centre, errors[: max(done, 1)].copy(), total, pairs, converged
