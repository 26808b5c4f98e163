"""What stands out of the good part (section 3.5): a signed difference with a level of detection, in clusters.

The paper keeps test points farther than a threshold from their nearest sample point: ``find_change_paper``. Ours
measures along the sample's normal, against its surface and not its points, and asks whether a difference is more than
noise: the level of detection of M3C2 (Lague 2013), 1.96 standard deviations of the two surfaces' noise, of their
roughness where planes fit badly, of the pose, and of what scanner distortion leaves over the whole field. Surface
that one of the two scans does not show (shadows, outline) is not a difference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import check_points, inverse, move_points, rotate_vectors
from grindvision.geometry.hash_grid import CellGrid, build_cells, cell_key, find_slot
from grindvision.geometry.neighbours import nearest, within_radius
from grindvision.kernels import njit
from grindvision.lazy import renamed_property
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.change.visibility import in_front, surrounded
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.clustering import euclidean_clusters
from grindvision.vision.surface.scan import Scan, seen_from, surface_in_frame
from grindvision.vision.surface.signed_distance import signed_distances
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

MAX_CHANGED = 0.4
"""Fraction of the common surface that may differ; above, the test scan shows another part."""

MIN_LEVELS = 4.0
"""A bead is told when it stands twice the firm level out over enough surfels; the mean of a cell is lower than its
ridge."""

MIN_FOOTPRINT = 0.4
"""A piece whose feet cover fewer cells of the good surface than this fraction of its own is a wall seen in one scan."""


@by_content
@dataclass(frozen=True)
class Cluster:
    """One connected piece of difference, in the frame of the test scan.

    ``points`` (N, 3) of the test scan, ``signed_mm`` (N,) above the good surface, whose unit ``normals`` (N, 3) are
    given beside; ``spacing_mm``: the cell size at which it was found; ``area_mm2``, ``volume_mm3``, ``peak_mm``.
    """

    points: Floats
    signed_mm: Floats
    normals: Floats
    spacing_mm: float
    area_mm2: float
    volume_mm3: float
    peak_mm: float

    def __str__(self) -> str:
        size = f"{self.area_mm2:.3g} mm2, {self.peak_mm:.2f} mm high, {self.volume_mm3:.3g} mm3"
        return f"{len(self.points):,} points, {size}"


@by_content
@dataclass(frozen=True)
class Difference:
    """Result of the comparison, frame of the test scan.

    ``clusters``, largest volume first; ``surfels`` (M, 3) of the test scan with ``signed_mm`` (M,) along the normal,
    positive where the test part stands out, NaN where the sample shows nothing to compare with; ``level_mm`` (M,) level
    of detection; ``level_of_detection_mm`` its median; ``firm_level_mm`` (M,) the level without the roughness that only
    the test part has; ``comparable`` (M,) where a bead would be told: the sample shows its surface all around;
    ``cell_mm`` the surfels' size.
    """

    clusters: tuple[Cluster, ...]
    surfels: Floats
    signed_mm: Floats
    level_mm: Floats
    level_of_detection_mm: float
    firm_level_mm: Floats
    comparable: Flags
    cell_mm: float

    least_height_mm = renamed_property("least_height_mm", "min_height_mm")
    least_width_mm = renamed_property("least_width_mm", "min_width_mm")

    @property
    def min_height_mm(self) -> Floats:
        """Height (M,) in mm from which a bead is certain to be told at each surfel; infinite where nothing would be."""
        return np.where(self.comparable, MIN_LEVELS * self.firm_level_mm, np.inf)

    @property
    def min_width_mm(self) -> float:
        """Width in mm from which a bead of the least height is told: narrower ones are averaged with what is beside."""
        return 3 * self.cell_mm

    @property
    def compared(self) -> float:
        """Fraction of the test scan's surfels that the sample shows a surface to compare with."""
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


@one_blas_thread()
def find_change_paper(
    source_in_target: ArrayLike,
    target: ArrayLike,
    threshold_mm: float,
    squared: bool = True,
    search: NearestSearch = kd_tree_distances,
) -> Flags:
    """Source points (N,) that belong to the difference cloud as the paper finds it.

    Args:
        source_in_target: points (N, 3) of the test part, in the frame of the target.
        target: points (M, 3) of the good part, the sample.
        threshold_mm: a length. With ``squared``, as in PCL, it is compared with the squared distance: 0.5 then means
            0.71 mm.
    """
    source, target = check_points(source_in_target, "source points"), check_points(target, "target points")
    if not threshold_mm > 0:
        raise InputError(f"the threshold is {threshold_mm} mm; it must be above zero")
    distances = search(target, source)
    return distances**2 > threshold_mm if squared else distances > threshold_mm


@one_blas_thread()
def find_change(
    source: Scan,
    target: Scan,
    registration: FineRegistration,
    min_surfels: int = 10,
    settled: Flags | None = None,
) -> Difference:
    """Where the source, the test part, stands out of the target, the good part, by more than the level of detection.

    Args:
        registration: pose T_target_source, with its covariance.
        min_surfels: connected surfels a piece must have.
        settled: the source's surfels (K,) that fix the pose and show how well the scans agree; all when left out.
            Where faces are off as a whole, the others.

    Raises:
        DegenerateError: more than ``MAX_CHANGED`` of the common surface differs.
    """
    back = inverse(registration.T_target_source)
    surface = surface_in_frame(target.surfels, back)
    surfels = source.surfels
    size = surface.grid.size_mm
    signed, normals, variance = signed_distances(surface, surfels.points, 2 * size)
    far = np.isnan(signed)
    if far.any():
        signed[far], normals[far] = _far_distances(target, back, surfels.points[far], size)
    excess = np.sqrt(np.maximum(surfels.roughness_mm**2 - surfels.noise_mm**2, 0))
    noise = variance + surfels.noise_mm**2 / surfels.counts
    variance = noise + (0.5 * excess) ** 2
    shown = ~np.isnan(signed)
    if shown.sum() < 10:
        raise DegenerateError("after registration the scans share no surface; scan the part from nearer views")
    held = shown if settled is None or (shown & settled).sum() < 10 else shown & settled
    sigma = 1.4826 * np.median(np.abs(signed[held] - np.median(signed[held])))
    field = max(sigma**2 - np.median(variance[held]), 0.0)
    pose = _pose_variance(registration, surfels.points, normals)
    # no spot is trusted better than the scans agree over all
    level = 1.96 * np.sqrt(np.maximum(variance + pose + field, sigma**2))
    # a bead is rough itself; only what is rough on both parts, edges and corners, is no sign of one
    shared = np.minimum(excess, _excess_below(surface, surfels.points, signed, normals))
    firm = 1.96 * np.sqrt(np.maximum(noise + (0.5 * shared) ** 2 + pose + field, sigma**2))
    changed = np.abs(np.nan_to_num(signed)) > np.maximum(2 * level, 6 * sigma)
    if changed[held].sum() > MAX_CHANGED * held.sum():
        raise DegenerateError(
            f"{changed[held].sum() / held.sum():.0%} of the common surface differs by more than"
            f" {2 * np.median(level[shown]):.2g} mm; is this another part, or a poor registration?"
        )
    suspicious = far | ((surfels.normals * normals).sum(axis=1) < 0.6)
    comparable = shown & surrounded(surface, surfels.points - np.nan_to_num(signed)[:, None] * normals, normals)
    candidates = comparable & (np.nan_to_num(signed) > level)
    doubtful = np.flatnonzero(candidates & suspicious)
    candidates[doubtful] = in_front(surface, seen_from(target, back), surfels.points[doubtful], size)
    clusters = _clusters(source, surface, candidates, signed, firm, normals, min_surfels)
    # what stands out but may be a wall that the sample's scanner missed was not compared
    comparable[doubtful] = candidates[doubtful]
    middle = float(np.median(level[shown]))
    return Difference(clusters, surfels.points, signed, level, middle, firm, comparable, size)


def _excess_below(surface: Surfels, points: Floats, signed: Floats, normals: Floats) -> Floats:
    """Roughness (N,) beyond the noise in mm of the surface's roughest surfel about the feet of points (N, 3)."""
    size = surface.grid.size_mm
    excess = np.sqrt(np.maximum(surface.roughness_mm**2 - surface.noise_mm**2, 0))
    around = within_radius(surface.grid, points - np.nan_to_num(signed)[:, None] * normals, size)
    padded = np.append(excess[around.indices], 0.0)
    highest = np.maximum.reduceat(padded, np.minimum(around.starts[:-1], len(padded) - 1))
    return np.where(np.diff(around.starts) > 0, highest, np.inf)


def _pose_variance(registration: FineRegistration, points: Floats, normals: Floats) -> Floats:
    """Variance (N,) of distances that comes from the pose: steep places feel translations across the surface."""
    if not np.isfinite(registration.covariance).all():
        return np.zeros(len(points))
    transform = registration.T_target_source
    up = rotate_vectors(transform, normals)
    jacobian = np.column_stack([up, np.cross(move_points(transform, points) - registration.centre_mm, up)])
    return np.einsum("ij,ij->i", jacobian @ registration.covariance, jacobian)


def _far_distances(target: Scan, T_source_target: Floats, points: Floats, size: float) -> tuple[Floats, Floats]:
    """Signed distances from the target's coarse surfels for points more than some surfels away from it; NaN beside
    it."""
    places = move_points(T_source_target, target.voxels.points)
    normals = target.voxels.normals @ T_source_target[:3, :3].T
    voxel = target.voxels.grid.size_mm
    at, distances = nearest(build_cells(places, 4 * voxel), points, 8 * voxel)
    found = at >= 0
    along = ((points - places[at]) * normals[at]).sum(axis=1)
    beside = np.sqrt(np.maximum(distances**2 - along**2, 0, where=found, out=np.zeros(len(points))))
    shown = found & (beside < 1.2 * voxel) & (np.abs(along) > size)
    return np.where(shown, along, np.nan), normals[at]


def _clusters(
    source: Scan, surface: Surfels, candidates: Flags, signed: Floats, level: Floats, normals: Floats, min_surfels: int
) -> tuple[Cluster, ...]:
    chosen = np.flatnonzero(candidates)
    if len(chosen) < min_surfels:
        return ()
    size = surface.grid.size_mm
    places = source.surfels.points[chosen]
    labels = euclidean_clusters(places, 2 * size)
    number = int(labels.max()) + 1
    strong = np.bincount(labels, signed[chosen] > 2 * level[chosen], number)
    dense = np.bincount(labels, source.surfels.counts[chosen], number) / np.bincount(labels, minlength=number)
    usual = np.median(source.surfels.counts)
    pieces = []
    volumes = np.bincount(labels, signed[chosen], number)
    for label in np.argsort(-volumes, kind="stable"):
        if strong[label] < min_surfels or volumes[label] < 0.05 * volumes.max() or dense[label] < 0.4 * usual:
            continue
        pieces.append(_piece(source, surface, chosen[labels == label], signed, normals))
    return tuple(piece for piece in pieces if piece is not None)


def _piece(source: Scan, surface: Surfels, members: Integers, signed: Floats, normals: Floats) -> Cluster | None:
    """The scan's own points in the cells of a piece, with their signed distances."""
    flags = np.zeros(len(source.surfels), dtype=bool)
    flags[members] = True
    points = source.points[_points_in_cells(source.points, flags, source.surfels.grid)]
    size = surface.grid.size_mm
    distances, up, _ = signed_distances(surface, points, 2 * size)
    high = np.isnan(distances)
    if high.any():
        places = source.surfels.points[members]
        owner = members[nearest(build_cells(places, size), points[high], 4 * size)[0]]
        up[high] = normals[owner]
        distances[high] = signed[owner] + ((points[high] - source.surfels.points[owner]) * normals[owner]).sum(axis=1)
    standing = distances > 0
    feet = points[standing] - distances[standing, None] * up[standing]
    if len(feet) < 3 or len(build_cells(feet, size).starts) - 1 < MIN_FOOTPRINT * len(members):
        return None
    area = len(members) * size**2 / 1.5
    peak = float(np.quantile(distances[standing], 0.98))
    volume = area * float(np.mean(signed[members]))
    return Cluster(points[standing], distances[standing], up[standing], size, area, volume, peak)


@njit(cache=True, nogil=True)
def _points_in_cells(points: Floats, flags: Flags, grid: CellGrid) -> Integers:
    """Indices of the points (N, 3) that lie in the cells with a flag."""
    table_keys, table_cells = grid.table_keys, grid.table_cells
    origin, per_mm = grid.origin_mm, 1.0 / grid.size_mm
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
