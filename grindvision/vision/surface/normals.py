"""Surface normals: the direction of least variance of a point's neighbours, turned towards the scanner."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import check_points
from grindvision.geometry.bounds import bounds
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.kernels import njit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

COS_EDGE_ON = float(np.cos(np.radians(75)))
"""Cosine of the angle between normal and ray from which on scanners see next to nothing."""

MAX_HIDDEN = 0.25
"""Seen from its scanner, at most this fraction of a scan's points lies over or under others of it."""

DEEP_HIDDEN = 0.1
"""A scan of which so much is hidden from the best side is deep enough to tell by its rays where its scanner stood."""

GLANCE_POINTS = 2000
"""So many points show well enough from where a cloud is seen at one glance."""

MAX_CELLS = 512
"""Cells from the middle of a cloud to its rim that are told apart; outliers lie farther out."""

MIN_AGREEING = 0.95
"""A scanner's place orients normals as ``seen_along`` does: agreeing less contrary fraction, where each counts by how
much of it is seen. From a place that is not the scanner's some of the surface is seen from behind."""

SHADED = 0.4
"""No surface is hidden from its own scanner; where a part stands high above its table, cells show up to this fraction
twice."""


def estimate_normals(
    points: ArrayLike, radius_mm: float, max_neighbours: int | None = None, viewpoint_mm: ArrayLike | None = None
) -> Floats:
    """Unit normals (N, 3) of points (N, 3) by principal component analysis of the neighbours within ``radius_mm``.

    Args:
        points: cloud in mm.
        radius_mm: neighbourhood radius.
        max_neighbours: take only so many nearest neighbours.
        viewpoint_mm: the scanner (3,), in the cloud's frame; normals are turned towards it. Left out, they are turned
            to the side from which the cloud can be seen at one glance (``seen_along``), or, where there is none, by
            ``orient_by_neighbours``.

    A point with fewer than three neighbours gets the normal (0, 0, 0).
    """
    points = check_points(points, "points")
    around = within_radius(build_cells(points, radius_mm), points, radius_mm, max_neighbours)
    normals = _plane_normals(points, around.starts, around.indices)
    if viewpoint_mm is None:
        direction = seen_along(points, normals, radius_mm)
        if direction is None:
            return orient_by_neighbours(points, normals, radius_mm)
        return np.where((normals @ direction < 0)[:, None], -normals, normals)
    return orient_to_viewpoint(points, normals, viewpoint_mm)


def orient_to_viewpoint(points: ArrayLike, normals: ArrayLike, viewpoint_mm: ArrayLike) -> Floats:
    """Normals (N, 3) with their signs chosen so that they face the viewpoint (3,)."""
    points, normals = np.asarray(points, dtype=float), np.asarray(normals, dtype=float)
    away = ((np.asarray(viewpoint_mm, dtype=float) - points) * normals).sum(axis=1) < 0
    return np.where(away[:, None], -normals, normals)


def orient_by_neighbours(points: ArrayLike, normals: ArrayLike, radius_mm: float) -> Floats:
    """Normals (N, 3) made consistent along the surface, each connected piece bulging towards its normals.

    Signs are handed from point to point along the spanning tree that turns least (Hoppe 1992); the sign of a whole
    piece is the one for which its normals point away from its middle. For a nearly flat piece that sign is a guess.
    """
    points, normals = np.asarray(points, dtype=float), np.asarray(normals, dtype=float)
    around = within_radius(build_cells(points, radius_mm), points, radius_mm, 12)
    return _propagated(points, normals, around.starts, around.indices)


def seen_along(points: ArrayLike, normals: ArrayLike, cell_mm: float, directions: int = 200) -> Floats | None:
    """Unit direction (3,) towards a far scanner that sees all points (N, 3) at one glance; None where there is none.

    A single scan is one layer, seen from its scanner, and its normals all face it, however deep its folds and gaps are.
    Of many directions the one is taken from which the points cover most cells; None if from there more than
    ``MAX_HIDDEN`` of them lie over or under others: whole models, scans merged from several views. Which of its two
    ends is the outside is told as in ``orient_by_neighbours``.

    Args:
        normals: (N, 3) of any sign.
        cell_mm: cell edge, some point distances.
    """
    points, normals = np.asarray(points, dtype=float), np.asarray(normals, dtype=float)
    direction, hidden = _best_glance(points, normals, cell_mm, directions)
    if hidden > MAX_HIDDEN:
        return None
    away = points - points.mean(axis=0)
    facing_normals = normals * np.where(normals @ direction < 0, -1, 1)[:, None]
    bulge = float((facing_normals * away).sum())
    nearly_flat = abs(bulge) <= 0.1 * np.linalg.norm(away, axis=1).sum()
    return direction if (facing_normals[:, 2].sum() if nearly_flat else bulge) >= 0 else -direction


def _best_glance(points: Floats, normals: Floats, cell_mm: float, directions: int) -> tuple[Floats, float]:
    """Of many directions (3,) the one along which points (N, 3) cover most cells, of either sign, and the fraction of
    points that is hidden there (``_hidden``)."""
    away = points - points.mean(axis=0)
    height = (np.arange(directions) + 0.5) / directions
    azimuth = np.pi * (1 + np.sqrt(5)) * np.arange(directions)
    flat = np.sqrt(1 - height**2)
    half_sphere = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height])
    direction = half_sphere[np.argmax(_covered_cells(away, half_sphere, float(cell_mm)))]
    across = np.linalg.svd(direction[None])[2][1:]
    return direction, _hidden(away @ across.T / cell_mm, away @ direction, np.abs(normals @ direction), cell_mm)


def _hidden(cells: Floats, depth: Floats, facing: Floats, cell_mm: float) -> float:
    """Fraction of points that lie over or under others: in one cell of ``cells`` (N, 2), rounded down, but at another
    ``depth`` (N,) than the surface's steepness, by the cosines ``facing`` (N,) of its normals, explains."""
    _, cell = np.unique(np.floor(cells) @ [1 << 24, 1], return_inverse=True)
    steepness = np.sqrt(1 - np.minimum(facing, 1) ** 2) / np.maximum(facing, 1e-3)
    hidden = np.zeros(len(depth), dtype=bool)
    for order in (np.lexsort((depth, cell)), np.lexsort((-depth, cell))):
        end = order[np.searchsorted(cell[order], np.arange(cell.max() + 1))][cell]
        explained = cell_mm * (0.6 + 1.2 * np.maximum(steepness, steepness[end]))
        hidden |= np.abs(depth - depth[end]) > explained
    return float(hidden.mean())


def _hidden_from_origin(points: Floats, normals: Floats, cell_mm: float) -> float:
    """``_hidden`` of points (N, 3) along their rays from the origin, in cells of that edge at their middle."""
    middle = points.mean(axis=0)
    distance = float(np.linalg.norm(middle))
    across, lengths = np.linalg.svd(middle[None])[2][1:], np.linalg.norm(points, axis=1)
    cells = points @ across.T / (points @ middle / distance)[:, None] * distance / cell_mm
    return _hidden(cells, lengths, np.abs((points * normals).sum(axis=1)) / lengths, cell_mm)


def guess_viewpoint(points: ArrayLike, normals: ArrayLike | None = None) -> Floats | None:
    """The origin, when it stands as far off the cloud as a scanner would (half the cloud's diagonal); otherwise None.

    Clouds that come in the scanner's own frame have the scanner at the origin; clouds in another frame do not tell.
    With ``normals`` (N, 3) of any sign, an origin from which half the surface is seen edge-on is no scanner either, nor
    one towards which other normals point than to the side from which the cloud is seen at one glance (``seen_along``).
    """
    points = np.asarray(points, dtype=float)
    if len(points) == 0:
        raise DegenerateError("an empty cloud has no viewpoint")
    low, high = bounds(np.ascontiguousarray(points))
    gap = np.maximum(np.maximum(low, -high), 0)
    if np.linalg.norm(gap) <= 0.5 * np.linalg.norm(high - low):
        return None
    if normals is not None:
        every = -(-len(points) // GLANCE_POINTS)
        places, facing = points[::every], np.asarray(normals, dtype=float)[::every]
        towards = -(places * facing).sum(axis=1)
        if np.median(np.abs(towards) / np.linalg.norm(places, axis=1)) < COS_EDGE_ON:
            return None
        cell_mm = 1.5 * float(np.linalg.norm(high - low)) / np.sqrt(len(places))
        direction, hidden = _best_glance(places, facing, cell_mm, 100)
        # steep walls may well face the scanner and not the direction, and count as little as is seen of them
        sights = towards / np.linalg.norm(places, axis=1) * (facing @ direction)
        one_side = hidden <= MAX_HIDDEN and abs(sights.sum()) >= MIN_AGREEING * np.abs(sights).sum()
        from_origin = _hidden_from_origin(places, facing, cell_mm)
        if one_side and from_origin > max(SHADED, 1.3 * hidden):
            return None
        # of a deep part the rays tell more: nowhere is much less hidden than from its scanner
        if not one_side and (hidden < DEEP_HIDDEN or from_origin > 1.3 * hidden):
            return None
    return np.zeros(3)


@njit(cache=True, nogil=True)
def smallest_eigenpair(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float]:
    """Smallest eigenvalue of a symmetric 3x3 matrix and its unit eigenvector (value, x, y, z)."""
    scale = max(abs(xx), abs(xy), abs(xz), abs(yy), abs(yz), abs(zz))
    if scale == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    xx, xy, xz, yy, yz, zz = xx / scale, xy / scale, xz / scale, yy / scale, yz / scale, zz / scale
    mean = (xx + yy + zz) / 3
    dx, dy, dz = xx - mean, yy - mean, zz - mean
    radius = np.sqrt((dx * dx + dy * dy + dz * dz + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    if radius < 1e-14:
        return mean * scale, 0.0, 0.0, 1.0
    det = dx * (dy * dz - yz * yz) - xy * (xy * dz - yz * xz) + xz * (xy * yz - dy * xz)
    cosine = min(max(det / (2 * radius**3), -1.0), 1.0)
    value = mean + 2 * radius * np.cos(np.arccos(cosine) / 3 + 2 * np.pi / 3)
    ax, ay, az = xx - value, yy - value, zz - value
    # the rows of (matrix - value) span the plane across the eigenvector: take the best of their cross products
    best, x, y, z = 0.0, 0.0, 0.0, 1.0
    for u0, u1, u2, v0, v1, v2 in (
        (ax, xy, xz, xy, ay, yz),
        (ax, xy, xz, xz, yz, az),
        (xy, ay, yz, xz, yz, az),
    ):
        c0, c1, c2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        length = c0 * c0 + c1 * c1 + c2 * c2
        if length > best:
            best, x, y, z = length, c0, c1, c2
    length = np.sqrt(x * x + y * y + z * z)
    return value * scale, x / length, y / length, z / length


@njit(cache=True, nogil=True)
def _covered_cells(away: Floats, directions: Floats, cell: float) -> Integers:
    """How many square cells (D,) of the plane across each direction (D, 3) the points, about their mean, cover.

    Points more than ``MAX_CELLS`` away count in the outermost cells.
    """
    counts = np.zeros(len(directions), dtype=np.int64)
    middle = min(int(np.sqrt((away * away).sum(axis=1).max()) / cell) + 2, MAX_CELLS)
    seen = np.full((2 * middle, 2 * middle), -1, dtype=np.int32)
    for d in range(len(directions)):
        n = directions[d]
        u = np.array([0.0, n[2], -n[1]]) if abs(n[0]) < 0.6 else np.array([-n[2], 0.0, n[0]])
        u /= cell * np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
        v = np.array([n[1] * u[2] - n[2] * u[1], n[2] * u[0] - n[0] * u[2], n[0] * u[1] - n[1] * u[0]])
        for p in range(len(away)):
            x, y, z = away[p, 0], away[p, 1], away[p, 2]
            i = min(max(int(u[0] * x + u[1] * y + u[2] * z + middle), 0), 2 * middle - 1)
            j = min(max(int(v[0] * x + v[1] * y + v[2] * z + middle), 0), 2 * middle - 1)
            if seen[i, j] != d:
                seen[i, j] = d
                counts[d] += 1
    return counts


@njit(cache=True, nogil=True)
def _plane_normals(points: Floats, starts: Integers, indices: Integers) -> Floats:
    """Direction (N, 3) of least variance of each point's neighbours; zero where there are fewer than three."""
    normals = np.zeros((len(points), 3))
    for p in range(len(points)):
        count = starts[p + 1] - starts[p]
        if count < 3:
            continue
        mx = my = mz = 0.0
        for at in range(starts[p], starts[p + 1]):
            q = indices[at]
            mx += points[q, 0]
            my += points[q, 1]
            mz += points[q, 2]
        mx, my, mz = mx / count, my / count, mz / count
        xx = xy = xz = yy = yz = zz = 0.0
        for at in range(starts[p], starts[p + 1]):
            q = indices[at]
            x, y, z = points[q, 0] - mx, points[q, 1] - my, points[q, 2] - mz
            xx += x * x
            xy += x * y
            xz += x * z
            yy += y * y
            yz += y * z
            zz += z * z
        _, normals[p, 0], normals[p, 1], normals[p, 2] = smallest_eigenpair(xx, xy, xz, yy, yz, zz)
    return normals


@njit(cache=True, nogil=True)
def _propagated(points: Floats, normals: Floats, starts: Integers, indices: Integers) -> Floats:
    """Kruskal's tree over the neighbour edges, flattest first, with the sign relation kept in a union-find forest."""
    nearly_flat = 0.1
    edges = len(indices)
    first, second, bending = np.empty(edges, np.int64), np.empty(edges, np.int64), np.empty(edges)
    for p in range(len(points)):
        for at in range(starts[p], starts[p + 1]):
            q = indices[at]
            first[at], second[at] = p, q
            bending[at] = 1 - abs(
                normals[p, 0] * normals[q, 0] + normals[p, 1] * normals[q, 1] + normals[p, 2] * normals[q, 2]
            )
    parent, sign = np.arange(len(points)), np.ones(len(points))
    for at in np.argsort(bending):
        p, q = first[at], second[at]
        dot = normals[p, 0] * normals[q, 0] + normals[p, 1] * normals[q, 1] + normals[p, 2] * normals[q, 2]
        root_p, sign_p = _root(parent, sign, p)
        root_q, sign_q = _root(parent, sign, q)
        if root_p != root_q:
            parent[root_q] = root_p
            sign[root_q] = sign_p * sign_q * (1.0 if dot >= 0 else -1.0)
    signs, roots = np.empty(len(points)), np.empty(len(points), np.int64)
    middle, count = np.zeros((len(points), 3)), np.zeros(len(points))
    bulge, size, up = np.zeros(len(points)), np.zeros(len(points)), np.zeros(len(points))
    for p in range(len(points)):
        roots[p], signs[p] = _root(parent, sign, p)
        middle[roots[p]] += points[p]
        count[roots[p]] += 1
    for p in range(len(points)):
        root = roots[p]
        squared = 0.0
        for k in range(3):
            away = points[p, k] - middle[root, k] / count[root]
            bulge[root] += signs[p] * normals[p, k] * away
            squared += away * away
        size[root] += np.sqrt(squared)
        up[root] += signs[p] * normals[p, 2]
    result = np.empty_like(normals)
    for p in range(len(points)):
        root = roots[p]
        outside = bulge[root] if abs(bulge[root]) > nearly_flat * size[root] else up[root]
        result[p] = normals[p] * (signs[p] if outside >= 0 else -signs[p])
    return result


@njit(cache=True, nogil=True)
def _root(parent: Integers, sign: Floats, p: int) -> tuple[int, float]:
    """Root of p and p's sign relative to it, halving the path on the way."""
    total = 1.0
    while parent[p] != p:
        above = parent[p]
        sign[p] *= sign[above] if parent[above] != above else 1.0
        if parent[above] != above:
            parent[p] = parent[above]
        total *= sign[p]
        p = parent[p]
    return p, total
