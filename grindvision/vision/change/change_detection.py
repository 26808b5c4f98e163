"""What stands out of the good part (section 3.5): a signed difference with a level of detection, in clusters.

The paper keeps test points farther than a threshold from their nearest sample point: ``difference_paper``. Ours
measures along the sample's normal, against its surface and not its points, and asks whether a difference is more than
noise: the level of detection of M3C2 (Lague 2013), 1.96 standard deviations of the two surfaces' noise, of their
roughness where planes fit badly, of the pose, and of what scanner distortion leaves over the whole field. Surface
that one of the two scans does not show (shadows, outline) is not a difference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import check_points, inverse, move_points, rotate_vectors
from grindvision.geometry.hash_grid import build_cells, cell_key, find_slot
from grindvision.geometry.neighbours import nearest
from grindvision.vision.change.visibility import in_front, surrounded
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.clustering import euclidean_clusters
from grindvision.vision.surface.scan import Scan, seen_from, surface_in_frame
from grindvision.vision.surface.signed_distance import signed_distances
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

MOST_CHANGED = 0.4
"""Share of the common surface that may differ; above, the test scan shows another part."""

LEAST_SPREAD = 0.4
"""A piece whose feet cover fewer cells of the good surface than this share of its own is a wall seen in one scan."""


@dataclass(frozen=True)
class Cluster:
    """One connected piece of difference, in the frame of the test scan.

    ``points`` (N, 3) of the test scan, ``heights_mm`` (N,) above the good surface, whose unit ``normals`` (N, 3) are
    given beside; ``spacing_mm``: the cell size at which it was found; ``area_mm2``, ``volume_mm3``, ``peak_mm``.
    """

    points: Floats
    heights_mm: Floats
    normals: Floats
    spacing_mm: float
    area_mm2: float
    volume_mm3: float
    peak_mm: float

    def __str__(self) -> str:
        size = f"{self.area_mm2:.3g} mm2, {self.peak_mm:.2f} mm high, {self.volume_mm3:.3g} mm3"
        return f"{len(self.points):,} points, {size}"


@dataclass(frozen=True)
class Difference:
    """Result of the comparison, frame of the test scan.

    ``clusters``, largest volume first; ``surfels`` (M, 3) of the test scan with ``signed_mm`` (M,) along the normal,
    positive where the test part stands out, NaN where the sample shows nothing to compare with; ``level_mm`` (M,) level
    of detection; ``level_of_detection_mm`` its median.
    """

    clusters: tuple[Cluster, ...]
    surfels: Floats
    signed_mm: Floats
    level_mm: Floats
    level_of_detection_mm: float

    @property
    def compared(self) -> float:
        """Share of the test scan's surfels that the sample shows a surface to compare with."""
        return float(np.mean(~np.isnan(self.signed_mm)))

    @property
    def points(self) -> Floats:
        """Points (N, 3) of all clusters."""
        return np.concatenate([cluster.points for cluster in self.clusters] or [np.empty((0, 3))])

    def __str__(self) -> str:
        return f"{len(self.clusters)} pieces above the level of detection of {self.level_of_detection_mm:.2f} mm"


NearestSearch = Callable[[Floats, Floats], Floats]
"""Distances (M,) of queries (M, 3) from their nearest points of a cloud (N, 3): search(cloud, queries)."""


def kd_tree_distances(cloud: Floats, queries: Floats) -> Floats:
    """SciPy's kd-tree as a ``NearestSearch``."""
    from scipy.spatial import cKDTree

    return cKDTree(cloud).query(queries)[0]


def difference_paper(
    sample: ArrayLike,
    test_in_sample: ArrayLike,
    threshold_mm: float,
    squared: bool = True,
    search: NearestSearch = kd_tree_distances,
) -> Flags:
    """Test points (N,) that belong to the difference cloud as the paper finds it.

    Args:
        test_in_sample: test points (N, 3) in the frame of the sample.
        threshold_mm: a length. With ``squared``, as in PCL, it is compared with the squared distance: 0.5 then means
            0.71 mm.
    """
    sample, test = check_points(sample, "sample"), check_points(test_in_sample, "test points")
    if not threshold_mm > 0:
        raise InputError(f"the threshold is {threshold_mm} mm; it must be above zero")
    distances = search(sample, test)
    return distances**2 > threshold_mm if squared else distances > threshold_mm


def find_difference(sample: Scan, test: Scan, registration: FineRegistration, min_surfels: int = 10) -> Difference:
    """Where the test part stands out of the sample by more than the level of detection.

    Args:
        registration: pose T_sample_test of the test scan, with its covariance.
        min_surfels: connected surfels a piece must have.

    Raises:
        DegenerateError: more than ``MOST_CHANGED`` of the common surface differs.
    """
    back = inverse(registration.T_target_source)
    good = surface_in_frame(sample.surfels, back)
    surfels = test.surfels
    size = good.grid.size_mm
    signed, normals, variance = signed_distances(good, surfels.points, 2 * size)
    far = np.isnan(signed)
    if far.any():
        signed[far], normals[far] = _far_heights(sample, back, surfels.points[far], size)
    excess = np.sqrt(np.maximum(surfels.roughness_mm**2 - surfels.noise_mm**2, 0))
    variance = variance + surfels.noise_mm**2 / surfels.counts + (0.5 * excess) ** 2
    shown = ~np.isnan(signed)
    if shown.sum() < 10:
        raise DegenerateError("after registration the scans share no surface; scan the part from nearer views")
    spread = 1.4826 * np.median(np.abs(signed[shown] - np.median(signed[shown])))
    field = max(spread**2 - np.median(variance[shown]), 0.0)
    variance = variance + _pose_variance(registration, surfels.points, normals)
    # no spot is trusted better than the scans agree over all
    level = 1.96 * np.sqrt(np.maximum(variance + field, spread**2))
    changed = np.abs(np.nan_to_num(signed)) > np.maximum(2 * level, 6 * spread)
    if changed.sum() > MOST_CHANGED * shown.sum():
        raise DegenerateError(
            f"{changed.sum() / shown.sum():.0%} of the common surface differs by more than"
            f" {2 * np.median(level[shown]):.2g} mm; is this another part, or a poor registration?"
        )
    suspicious = far | ((surfels.normals * normals).sum(axis=1) < 0.6)
    candidates = shown & (np.nan_to_num(signed) > level)
    doubtful = np.flatnonzero(candidates & suspicious)
    candidates[doubtful] = in_front(good, seen_from(sample, back), surfels.points[doubtful], size)
    asked = np.flatnonzero(candidates)
    candidates[asked] = surrounded(good, surfels.points[asked] - signed[asked, None] * normals[asked], normals[asked])
    clusters = _clusters(test, good, candidates, signed, level, normals, min_surfels)
    return Difference(clusters, surfels.points, signed, level, float(np.median(level[shown])))


def _pose_variance(registration: FineRegistration, points: Floats, normals: Floats) -> Floats:
    """Variance (N,) of heights that comes from the pose: steep places feel shifts across the surface."""
    if not np.isfinite(registration.covariance).all():
        return np.zeros(len(points))
    transform = registration.T_target_source
    up = rotate_vectors(transform, normals)
    jacobian = np.column_stack([up, np.cross(move_points(transform, points) - registration.centre_mm, up)])
    return np.einsum("ij,ij->i", jacobian @ registration.covariance, jacobian)


def _far_heights(sample: Scan, T_test_sample: Floats, points: Floats, size: float) -> tuple[Floats, Floats]:
    """Heights over the sample's coarse surfels for points more than some surfels away from it; NaN beside it."""
    places = move_points(T_test_sample, sample.voxels.points)
    normals = sample.voxels.normals @ T_test_sample[:3, :3].T
    voxel = sample.voxels.grid.size_mm
    at, distances = nearest(build_cells(places, 4 * voxel), points, 8 * voxel)
    found = at >= 0
    along = ((points - places[at]) * normals[at]).sum(axis=1)
    beside = np.sqrt(np.maximum(distances**2 - along**2, 0, where=found, out=np.zeros(len(points))))
    seen = found & (beside < 1.2 * voxel) & (np.abs(along) > size)
    return np.where(seen, along, np.nan), normals[at]


def _clusters(
    test: Scan, good: Surfels, candidates: Flags, signed: Floats, level: Floats, normals: Floats, least: int
) -> tuple[Cluster, ...]:
    chosen = np.flatnonzero(candidates)
    if len(chosen) < least:
        return ()
    size = good.grid.size_mm
    places = test.surfels.points[chosen]
    labels = euclidean_clusters(places, 2 * size)
    number = int(labels.max()) + 1
    strong = np.bincount(labels, signed[chosen] > 2 * level[chosen], number)
    dense = np.bincount(labels, test.surfels.counts[chosen], number) / np.bincount(labels, minlength=number)
    usual = np.median(test.surfels.counts)
    pieces = []
    volumes = np.bincount(labels, signed[chosen], number)
    for label in np.argsort(-volumes, kind="stable"):
        if strong[label] < least or volumes[label] < 0.05 * volumes.max() or dense[label] < 0.4 * usual:
            continue
        pieces.append(_piece(test, good, chosen[labels == label], signed, normals))
    return tuple(piece for piece in pieces if piece is not None)


def _piece(test: Scan, good: Surfels, members: Integers, signed: Floats, normals: Floats) -> Cluster | None:
    """The scan's own points in the cells of a piece, with their heights."""
    grid = test.surfels.grid
    flags = np.zeros(len(test.surfels), dtype=bool)
    flags[members] = True
    points = test.points[
        _points_in_cells(test.points, flags, grid.table_keys, grid.table_cells, grid.origin_mm, 1.0 / grid.size_mm)
    ]
    size = good.grid.size_mm
    heights, up, _ = signed_distances(good, points, 2 * size)
    high = np.isnan(heights)
    if high.any():
        places = test.surfels.points[members]
        owner = members[nearest(build_cells(places, size), points[high], 4 * size)[0]]
        up[high] = normals[owner]
        heights[high] = signed[owner] + ((points[high] - test.surfels.points[owner]) * normals[owner]).sum(axis=1)
    standing = heights > 0
    feet = points[standing] - heights[standing, None] * up[standing]
    if len(feet) < 3 or len(build_cells(feet, size).starts) - 1 < LEAST_SPREAD * len(members):
        return None
    area = len(members) * size**2 / 1.5
    peak = float(np.quantile(heights[standing], 0.98))
    volume = area * float(np.mean(signed[members]))
    return Cluster(points[standing], heights[standing], up[standing], size, area, volume, peak)


@njit(cache=True, nogil=True)
def _points_in_cells(
    points: Floats, flags: Flags, table_keys: Integers, table_cells: NDArray[np.int32], origin: Floats, per_mm: float
) -> Integers:
    found = np.empty(len(points), dtype=np.int64)
    count = 0
    last, wanted = np.int64(-1), np.bool_(False)
    for p in range(len(points)):
        i = int((points[p, 0] - origin[0]) * per_mm)
        j = int((points[p, 1] - origin[1]) * per_mm)
        k = int((points[p, 2] - origin[2]) * per_mm)
        key = cell_key(i, j, k)
        if key != last:  # neighbours in a scan's row share a cell
            last, wanted = key, flags[table_cells[find_slot(table_keys, key)]]
        if wanted:
            found[count] = p
            count += 1
    return found[:count].copy()
