"""Fast point feature histograms (section 3.2, Eqs 3-5): 33 numbers that describe the surface around a point.

The three angles of Eq 4 fill eleven bins each. Where the paper is silent or two readings are possible, Open3D's choice
is taken so that results can be compared with it: of a pair, the point whose normal lies closer to the connecting line
carries the frame of Eq 3. Eq 5 as printed divides each neighbour's histogram by its distance, and the sum by their
number k. PCL and Open3D divide by the squared distance and scale each third of the sum to 100 instead, which takes k
out; so do we, unless the printed form is asked for.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry import check_points
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.kernels import njit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

BINS = 11

_ANGLES = np.linspace(-np.pi, np.pi, BINS + 1)[1:-1]
_ALONG, _ACROSS = np.cos(_ANGLES), np.sin(_ANGLES)
_TURNS = _ACROSS / (np.abs(_ALONG) + np.abs(_ACROSS))
EDGES = np.where(_ALONG >= 0, _TURNS, np.copysign(2.0, _ACROSS) - _TURNS)
"""Between the bins of theta, in the measure of ``_bin_of_direction``: it grows with the angle, from -2 to 2."""


def compute_fpfh(
    points: ArrayLike,
    normals: ArrayLike,
    radius_mm: float,
    max_neighbours: int | None = None,
    as_printed: bool = False,
) -> Floats:
    """FPFH (N, 33) of points (N, 3) with unit normals (N, 3): bins of theta, then alpha, then phi (Eqs 3-5).

    Args:
        points: cloud in mm, usually after the voxel grid.
        normals: consistently oriented unit normals.
        radius_mm: neighbourhood radius; about five voxels.
        max_neighbours: take only so many nearest neighbours, the point itself included.
        as_printed: weigh the neighbours as Eq 5 is printed; the unit of the distances then counts.

    Raises:
        InputError: points and normals differ in number.
    """
    points = check_points(points, "points")
    normals = np.ascontiguousarray(normals, dtype=float)
    if normals.shape != points.shape:
        raise InputError(f"points {points.shape} and normals {normals.shape} must come in pairs")
    around = within_radius(build_cells(points, radius_mm), points, radius_mm, max_neighbours)
    simple = _simple_histograms(points, normals, around.starts, around.indices, max_neighbours is None)
    if as_printed:
        return _as_printed(simple, around.starts, around.indices, np.sqrt(around.squared_mm2))
    return _weighted_histograms(simple, around.starts, around.indices, around.squared_mm2)


def _as_printed(simple: Floats, starts: Integers, indices: Integers, distances: Floats) -> Floats:
    """Eq 5: each point's own histogram, and the mean of its k neighbours' divided by their distance."""
    from scipy.sparse import csr_array

    n = len(simple)
    others = distances > 0
    rows = np.repeat(np.arange(n), np.diff(starts))[others]
    k = np.maximum(np.bincount(rows, minlength=n), 1)
    weights = csr_array((1 / (distances[others] * k[rows]), (rows, indices[others])), shape=(n, n))
    return np.asarray(simple + weights @ simple)


def mirrored_fpfh(features: ArrayLike) -> Floats:
    """The FPFH (N, 33) the same points would have with all normals reversed: theta and phi change sign."""
    theta, alpha, phi = np.split(np.asarray(features, dtype=float), 3, axis=1)
    return np.concatenate([theta[:, ::-1], alpha, phi[:, ::-1]], axis=1)


@njit(cache=True, nogil=True)
def _simple_histograms(points: Floats, normals: Floats, starts: Integers, indices: Integers, mutual: bool) -> Floats:
    """SPFH: the angles of Eq 4 between each point and its neighbours, as percentages per bin.

    The angles of a pair are the same seen from both its points: where neighbourhood is ``mutual``, one look serves two.
    """
    histograms = np.zeros((len(points), 3 * BINS))
    for p in range(len(points)):
        fraction = 100.0 / max(starts[p + 1] - starts[p] - 1, 1)
        for at in range(starts[p], starts[p + 1]):
            q = indices[at]
            if q == p or (mutual and q < p):
                continue
            x, y, alpha, phi = _pair_angles(points, normals, p, q)
            a = _bin_of_direction(x, y)
            b = BINS + _bin((alpha + 1) / 2)
            c = 2 * BINS + _bin((phi + 1) / 2)
            histograms[p, a] += fraction
            histograms[p, b] += fraction
            histograms[p, c] += fraction
            if mutual:
                other = 100.0 / max(starts[q + 1] - starts[q] - 1, 1)
                histograms[q, a] += other
                histograms[q, b] += other
                histograms[q, c] += other
    return histograms


@njit(cache=True, nogil=True)
def _weighted_histograms(simple: Floats, starts: Integers, indices: Integers, squared: Floats) -> Floats:
    """FPFH (N, 33): each point's own histogram and those of its neighbours, weighted by one over their squared
    distance."""
    features = simple.copy()
    sums = np.empty(3 * BINS)
    for p in range(len(simple)):
        sums[:] = 0.0
        for at in range(starts[p], starts[p + 1]):
            if squared[at] == 0.0:
                continue
            weight = 1.0 / squared[at]
            neighbour = simple[indices[at]]
            for b in range(3 * BINS):
                sums[b] += weight * neighbour[b]
        for third in range(3):
            total = 0.0
            for b in range(third * BINS, (third + 1) * BINS):
                total += sums[b]
            if total == 0.0:
                continue
            for b in range(third * BINS, (third + 1) * BINS):
                features[p, b] += sums[b] * 100.0 / total
    return features


@njit(cache=True, nogil=True)
def _pair_angles(points: Floats, normals: Floats, p: int, q: int) -> tuple[float, float, float, float]:
    """Eqs 3 and 4 for one pair: x and y of which theta is the arctangent, and the cosines alpha and phi.

    All is zero where the frame is undefined.
    """
    dx, dy, dz = points[q, 0] - points[p, 0], points[q, 1] - points[p, 1], points[q, 2] - points[p, 2]
    d = np.sqrt(dx * dx + dy * dy + dz * dz)
    if d == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    ux, uy, uz = normals[p, 0], normals[p, 1], normals[p, 2]
    nx, ny, nz = normals[q, 0], normals[q, 1], normals[q, 2]
    phi = (ux * dx + uy * dy + uz * dz) / d
    other = (nx * dx + ny * dy + nz * dz) / d
    if abs(phi) < abs(other):
        ux, uy, uz, nx, ny, nz = nx, ny, nz, ux, uy, uz
        dx, dy, dz = -dx, -dy, -dz
        phi = -other
    vx, vy, vz = dy * uz - dz * uy, dz * ux - dx * uz, dx * uy - dy * ux
    length = np.sqrt(vx * vx + vy * vy + vz * vz)
    if length == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    vx, vy, vz = vx / length, vy / length, vz / length
    wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    x, y = ux * nx + uy * ny + uz * nz, wx * nx + wy * ny + wz * nz
    return x, y, vx * nx + vy * ny + vz * nz, phi


@njit(cache=True, nogil=True)
def _bin_of_direction(x: float, y: float) -> int:
    """Bin of the angle of (x, y) from -pi to pi; its arctangent would take as long as the rest of the pair."""
    size = abs(x) + abs(y)
    quadrant = y / size if size > 0 else 0.0
    if x < 0:
        quadrant = (2.0 if y >= 0 else -2.0) - quadrant
    found = 0
    for edge in EDGES:
        found += quadrant >= edge
    return found


@njit(cache=True, nogil=True)
def _bin(fraction: float) -> int:
    """Bin of a value between 0 and 1."""
    return min(max(int(np.floor(BINS * fraction)), 0), BINS - 1)
