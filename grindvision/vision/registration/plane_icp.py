"""Point-to-plane ICP of oriented points onto surfels: robust weights, and no pairs beside the target's edge."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import check_points, check_rigid, nearest_rotation, rigid
from grindvision.geometry.hash_grid import CellGrid, build_cells
from grindvision.geometry.neighbours import nearest_one
from grindvision.kernels import njit
from grindvision.parallel import one_blas_thread
from grindvision.vision.registration.icp import FineRegistration, pose_covariance
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MAX_LATERAL_OFFSET = 1.5
"""Points farther along a surfel's plane than so many cells lie beside the surface."""

MIN_FACING = 0.7
"""Smallest cosine of the angle between the normals of two surfaces that may be the same."""

REMATCH_TOLERANCE = 0.005
"""A point that has moved by a smaller part of a cell keeps the surfel that was found for it."""

NORMAL_NOISE = 0.01
"""Error in radians of the surfels' normals: steps are damped as if so much were all that holds a motion, or the pose
would wander along motions that nothing but this error resists."""

FAR_CELLS = 5
"""A search that goes farther than so many of the target's cells, most of them empty, goes through larger ones."""

SLACK = 0.25
"""Planes are sought farther than they count by this share of the reach: a point that has none is then not sought anew
until it has moved so far that it may have one."""

EVERY, MANY = 16, 10_000
"""Every sixteenth point alone comes near first, where there are more than ten thousand: far searches are long."""


@one_blas_thread()
def icp_planes(
    source: ArrayLike,
    source_normals: ArrayLike,
    target: Surfels,
    T_start: ArrayLike | None = None,
    max_mm: float | None = None,
    min_scale_mm: float = 0.0,
    iterations: int = 30,
) -> FineRegistration:
    """Point-to-plane ICP of points (N, 3) with normals (N, 3) onto surfels.

    Residuals are weighted by Tukey's function of their own spread, so beads, outliers and the part of a scan the other
    one does not show pull nothing. Points beside the target's edge (farther along the plane than a cell and a half),
    or whose normal turns more than 45 degrees away from the target's, are not used. The nearest surfel is sought anew
    only for points that have moved by 1/200 of a cell since, and of many points a few come near first: the search is
    nearly all the work.

    Args:
        max_mm: pairs farther apart are not used; three cells when left out.
        min_scale_mm: floor of the residuals' spread.

    Raises:
        DegenerateError: fewer than 12 pairs.
    """
    source = check_points(source, "source points", 12)
    transform = np.eye(4) if T_start is None else check_rigid(T_start, "T_start")
    normals = np.ascontiguousarray(source_normals, dtype=float)
    size = target.grid.size_mm
    max_mm = 3 * size if max_mm is None else float(max_mm)
    limits, grid = _limits(target, max_mm, REMATCH_TOLERANCE, SLACK), _grid_to_search(target, max_mm)

    def icp(source: Floats, normals: Floats, start: Floats) -> tuple[Floats, Floats, Floats, Floats, float, int, bool]:
        return _plane_icp(source, normals, start, target.normals, grid, limits, float(min_scale_mm), iterations)

    if len(source) > MANY:
        near, *_, pairs, _ = icp(source[::EVERY].copy(), normals[::EVERY].copy(), transform)
        transform = near if pairs >= 12 else transform
    transform, information, centre, errors, weight, pairs, converged = icp(
        np.ascontiguousarray(source), normals, transform
    )
    if pairs < 12:
        raise DegenerateError(
            f"only {pairs} points of the scans meet within {max_mm:.3g} mm; they do not overlap there"
        )
    transform = rigid(nearest_rotation(transform[:3, :3]), transform[:3, 3])
    rms = float(np.sqrt(errors[-1]))
    return FineRegistration(
        transform, rms, pairs / len(source), len(errors), converged, centre, information,
        pose_covariance(information, weight, rms), errors,
    )  # fmt: skip


def plane_residuals(
    source: Floats, source_normals: Floats, target: Surfels, T_target_source: Floats, max_mm: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Distances (N,) of moved points (N, 3) along the target's normals, NaN where the target shows nothing within
    ``max_mm``, and whether the normals (N, 3) are less than 45 degrees apart."""
    found, grid = _no_matches(len(source)), _grid_to_search(target, max_mm)
    _match(source, source_normals, T_target_source, target.normals, grid, _limits(target, max_mm, 0.0, 0.0), found)
    shown = found.planes >= 0
    return np.where(shown, found.residuals, np.nan), shown & (found.facing > MIN_FACING)


def _grid_to_search(target: Surfels, max_mm: float) -> CellGrid:
    """The target's points in cells in which the nearest one within ``max_mm`` is soon found; it is the same in all."""
    return target.grid if max_mm <= FAR_CELLS * target.grid.size_mm else build_cells(target.points, max_mm / 2)


def _limits(target: Surfels, max_mm: float, rematch_tolerance: float, slack: float) -> _Limits:
    """Limits of the search on a target, whose cells are the unit of the constants; ``slack``: a share of the reach."""
    size = target.grid.size_mm
    return _Limits(float(max_mm), MAX_LATERAL_OFFSET * size, rematch_tolerance * size, slack * float(max_mm))


@njit(cache=True, nogil=True)
def solve_definite(matrix: Floats, right: Floats) -> Floats:
    """Solution (n,) of a small symmetric positive definite system (n, n), by elimination without pivots."""
    rows, solution = matrix.copy(), right.copy()
    count = len(right)
    for a in range(count):
        for b in range(a + 1, count):
            factor = rows[b, a] / rows[a, a]
            for c in range(a, count):
                rows[b, c] -= factor * rows[a, c]
            solution[b] -= factor * solution[a]
    for a in range(count - 1, -1, -1):
        for c in range(a + 1, count):
            solution[a] -= rows[a, c] * solution[c]
        solution[a] /= rows[a, a]
    return solution


class _Limits(NamedTuple):
    """How far a plane may lie from its point, and how far along itself; a point that has moved less keeps its plane.
    Points are sought ``slack_mm`` beyond, which tells how far one that has none may move before it can have one."""

    max_mm: float
    max_lateral_mm: float
    rematch_mm: float
    slack_mm: float


class _Matches(NamedTuple):
    """The planes found for points (N, 3): where the points have ``moved`` to, where their planes were last ``sought``
    from, the ``planes``' indices (N,), -1 where none is shown, ``residuals`` (N,) along their normals, and the cosines
    ``facing`` (N,) between the normals. Nothing is near a point that is nearer than ``clear`` (N,) to ``lost`` (N, 3).
    """

    moved: Floats
    sought: Floats
    lost: Floats
    clear: Floats
    planes: Integers
    residuals: Floats
    facing: Floats


@njit(cache=True, nogil=True)
def _no_matches(count: int) -> _Matches:
    """Room for the planes of so many points, none sought yet."""
    return _Matches(
        np.empty((count, 3)),
        np.full((count, 3), np.inf),
        np.empty((count, 3)),
        np.zeros(count),
        np.empty(count, dtype=np.int64),
        np.empty(count),
        np.empty(count),
    )


@njit(cache=True, nogil=True)
def _match(
    source: Floats,
    normals: Floats,
    transform: Floats,
    target_normals: Floats,
    grid: CellGrid,
    limits: _Limits,
    found: _Matches,
) -> None:
    """Move points (N, 3) with normals (N, 3) and find the plane of each, as ``_Matches`` describes, in place.

    A point keeps its plane while it is nearer than ``rematch_mm`` to the place from which the plane was sought.
    """
    max_lateral_mm, rematch_mm = limits.max_lateral_mm, limits.rematch_mm
    moved, sought, matches, residuals, facing = found.moved, found.sought, found.planes, found.residuals, found.facing
    points = grid.points
    m = transform
    for p in range(len(source)):
        s, n = source[p], normals[p]
        x = m[0, 0] * s[0] + m[0, 1] * s[1] + m[0, 2] * s[2] + m[0, 3]
        y = m[1, 0] * s[0] + m[1, 1] * s[1] + m[1, 2] * s[2] + m[1, 3]
        z = m[2, 0] * s[0] + m[2, 1] * s[1] + m[2, 2] * s[2] + m[2, 3]
        moved[p, 0], moved[p, 1], moved[p, 2] = x, y, z
        ax, ay, az = x - sought[p, 0], y - sought[p, 1], z - sought[p, 2]
        if not ax * ax + ay * ay + az * az < rematch_mm * rematch_mm:
            matches[p] = _sought(p, x, y, z, grid, limits, found)
            sought[p, 0], sought[p, 1], sought[p, 2] = x, y, z
        q = matches[p]
        if q < 0:
            continue
        t = target_normals[q]
        dx, dy, dz = x - points[q, 0], y - points[q, 1], z - points[q, 2]
        residuals[p] = t[0] * dx + t[1] * dy + t[2] * dz
        if dx * dx + dy * dy + dz * dz - residuals[p] * residuals[p] >= max_lateral_mm * max_lateral_mm:
            matches[p] = -1
            continue
        facing[p] = 0.0
        for k in range(3):
            facing[p] += t[k] * (m[k, 0] * n[0] + m[k, 1] * n[1] + m[k, 2] * n[2])


@njit(cache=True, nogil=True)
def _sought(p: int, x: float, y: float, z: float, grid: CellGrid, limits: _Limits, found: _Matches) -> int:
    """Index of the plane nearest to point p at (x, y, z), -1 where there is none within the limit: without a search
    where the last one found none and the point has moved less since than the nearest plane was beyond the limit, and
    not beyond the plane that it has."""
    lost, clear, points, had = found.lost, found.clear, grid.points, found.planes[p]
    if clear[p] > 0.0:
        dx, dy, dz = x - lost[p, 0], y - lost[p, 1], z - lost[p, 2]
        if dx * dx + dy * dy + dz * dz < clear[p] * clear[p]:
            return -1
    max_mm, slack_mm = limits.max_mm, limits.slack_mm
    reach = max_mm + slack_mm
    if had >= 0 and found.sought[p, 0] < np.inf:
        dx, dy, dz = x - points[had, 0], y - points[had, 1], z - points[had, 2]
        reach = min(reach, (1 + 1e-9) * np.sqrt(dx * dx + dy * dy + dz * dz))
    q, squared = nearest_one(x, y, z, reach, grid)
    if q >= 0 and squared <= max_mm * max_mm:
        clear[p] = 0.0
        return q
    beyond = np.sqrt(squared) - max_mm if q >= 0 else slack_mm
    clear[p] = (1 - 1e-6) * beyond
    lost[p, 0], lost[p, 1], lost[p, 2] = x, y, z
    return -1


@njit(cache=True, nogil=True)
def _rotate_and_translate(transform: Floats, centre: Floats, step: Floats) -> float:
    """Add a translation ``step[:3]`` and a rotation vector ``step[3:]`` about ``centre``, in place, and return its
    angle."""
    angle = np.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    axis = step[3:] / max(angle, 1e-300)
    cosine, sine = np.cos(angle), np.sin(angle)
    for column in range(4):
        x, y, z = transform[0, column], transform[1, column], transform[2, column]
        if column == 3:
            x, y, z = x - centre[0], y - centre[1], z - centre[2]
        along = (1 - cosine) * (axis[0] * x + axis[1] * y + axis[2] * z)
        transform[0, column] = cosine * x + along * axis[0] + sine * (axis[1] * z - axis[2] * y)
        transform[1, column] = cosine * y + along * axis[1] + sine * (axis[2] * x - axis[0] * z)
        transform[2, column] = cosine * z + along * axis[2] + sine * (axis[0] * y - axis[1] * x)
    for k in range(3):
        transform[k, 3] += centre[k] + step[k]
    return angle


@njit(cache=True, nogil=True)
def _normal_equations(
    found: _Matches, target_normals: Floats, centre: Floats, cut: float, matrix: Floats, right: Floats
) -> tuple[float, float]:
    """Fill the ``matrix`` (6, 6) and ``right`` side (6,) of the step about a centre (3,), residuals weighted by Tukey's
    function with this ``cut``; the sums of the weights and of the weighted squares."""
    moved, match, residual = found.moved, found.planes, found.residuals
    matrix[:, :], right[:] = 0.0, 0.0
    total, square = 0.0, 0.0
    row = np.empty(6)
    for p in range(len(match)):
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
    return total, square


@njit(cache=True, nogil=True)
def _plane_icp(
    source: Floats,
    normals: Floats,
    transform: Floats,
    target_normals: Floats,
    grid: CellGrid,
    limits: _Limits,
    min_scale: float,
    iterations: int,
) -> tuple[Floats, Floats, Floats, Floats, float, int, bool]:
    """The iterations of ``icp_planes``: pose, information about the pairs' centre, that centre, mean squares per
    iteration, sum of the weights, number of pairs, and whether it came to rest."""
    count = len(source)
    current = transform.copy()
    found = _no_matches(count)
    moved, match, residual, facing = found.moved, found.planes, found.residuals, found.facing
    sizes = np.empty(count)
    errors = np.zeros(iterations)
    done, converged = 0, False
    matrix, right = np.zeros((6, 6)), np.zeros(6)
    centre = np.zeros(3)
    pairs, total = 0, 0.0
    for iteration in range(iterations):
        _match(source, normals, current, target_normals, grid, limits, found)
        pairs = 0
        centre[:] = 0.0
        for p in range(count):
            if match[p] >= 0 and facing[p] < MIN_FACING:
                match[p] = -1
            if match[p] >= 0:
                sizes[pairs] = abs(residual[p])
                for k in range(3):
                    centre[k] += moved[p, k]
                pairs += 1
        if pairs < 12:
            break
        for k in range(3):
            centre[k] /= pairs
        scale = max(1.4826 * np.median(sizes[:pairs]), min_scale, 1e-12)
        cut = 4.685 * scale
        total, square = _normal_equations(found, target_normals, centre, cut, matrix, right)
        errors[iteration] = square / total
        done = iteration + 1
        damped = matrix.copy()
        extent = (matrix[3, 3] + matrix[4, 4] + matrix[5, 5]) / max(matrix[0, 0] + matrix[1, 1] + matrix[2, 2], 1e-300)
        for a in range(3):
            damped[a, a] += NORMAL_NOISE**2 * total
            damped[3 + a, 3 + a] += NORMAL_NOISE**2 * total * extent
        step = solve_definite(damped, right)
        rotation = _rotate_and_translate(current, centre, step)
        if np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2) + rotation * np.sqrt(extent) < 1e-3 * scale:
            converged = True
            break
    return current, matrix, centre, errors[: max(done, 1)].copy(), total, pairs, converged
