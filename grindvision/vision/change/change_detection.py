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
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest, within_radius
from grindvision.lazy import renamed_property
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.change.pieces import Cluster, Speck, Standing, find_pieces
from grindvision.vision.change.visibility import in_free_space, in_front, surrounded
from grindvision.vision.registration.free_motions import is_hardly_known
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.scan import Scan, seen_from, surface_in_frame
from grindvision.vision.surface.signed_distance import signed_distances
from grindvision.vision.surface.surfels import Surfels
from grindvision.words import counted

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

MAX_CHANGED = 0.4
"""Fraction of the common surface that may differ; above, the test scan shows another part."""

MIN_LEVELS = 4.0
"""A bead is told when it stands twice the firm level out over enough surfels; the mean of a cell is lower than its
ridge."""

FREE_CELLS, REACH_CELLS = 1.0, 20.0
"""Nearer to the sample's surfels than so many cells a point may be of the same surface, and no ray tells; farther than
the second, it belongs to nothing that the sample shows."""


SIDEWAYS_CELLS = 2.0
"""Flash in line with a face, beyond its edge: a plane reaches 1.2 cells past its surfel's mean, which lies half a cell
inside of the edge or less; what is farther out lies in a cell of its own."""


@by_content
@dataclass(frozen=True)
class Difference:
    """Result of the comparison, frame of the test scan.

    ``clusters``, largest volume first; ``surfels`` (M, 3) of the test scan with ``signed_mm`` (M,) along the normal,
    positive where the test part stands out, NaN where the sample shows nothing to compare with; ``level_mm`` (M,) level
    of detection; ``level_of_detection_mm`` its median; ``firm_level_mm`` (M,) the level without the roughness that only
    the test part has; ``comparable`` (M,) where a bead would be told: the sample shows its surface all around;
    ``cell_mm`` the surfels' size; ``specks`` stand out, too, but are too small for a piece.
    """

    clusters: tuple[Cluster, ...]
    surfels: Floats
    signed_mm: Floats
    level_mm: Floats
    level_of_detection_mm: float
    firm_level_mm: Floats
    comparable: Flags
    cell_mm: float
    specks: tuple[Speck, ...] = ()

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
    def min_sideways_mm(self) -> float:
        """How far in mm flash in line with a face must stand out beyond its edge to be told: nearer, it may be the same
        face, whose last surfel lies somewhat inside of the edge."""
        return SIDEWAYS_CELLS * self.cell_mm

    @property
    def compared(self) -> float:
        """Fraction of the test scan's surfels that the sample shows a surface to compare with."""
        return float(np.mean(~np.isnan(self.signed_mm)))

    @property
    def points(self) -> Floats:
        """Points (N, 3) of all clusters."""
        return np.concatenate([cluster.points for cluster in self.clusters] or [np.empty((0, 3))])

    def __str__(self) -> str:
        pieces = counted(len(self.clusters), "piece")
        return f"{pieces} above the level of detection of {self.level_of_detection_mm:.2f} mm"


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
    place_variance: Callable[[Floats, Floats], Floats] | None = None,
) -> Difference:
    """Where the source, the test part, stands out of the target, the good part, by more than the level of detection.

    Args:
        registration: pose T_target_source, with its covariance.
        min_surfels: connected surfels a piece must have.
        settled: the source's surfels (K,) that fix the pose and show how well the scans agree; all when left out.
            Where faces are off as a whole, the others.
        place_variance: variances (K,) in mm2 of where the good surface lies along normals (K, 3) at places (K, 3) of
            the source, beside those of the pose: of a deformed part.

    Raises:
        DegenerateError: more than ``MAX_CHANGED`` of the common surface differs.
    """
    back = inverse(registration.T_target_source)
    surface = surface_in_frame(target.surfels, back)
    surfels, size = source.surfels, surface.grid.size_mm
    signed, normals, variance = signed_distances(surface, surfels.points, 2 * size, trusted=True)
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
    pose = _pose_variance(registration, registration.covariance, surfels.points, normals)
    # no spot is trusted better than the scans agree over all, or than a pose that is hardly known
    floor = np.full(len(signed), sigma**2)
    hidden = _pose_variance(registration, registration.total_covariance, surfels.points, normals)
    if place_variance is not None:
        pose += place_variance(surfels.points, normals)
    elif is_hardly_known(registration, surfels.points):
        floor = np.maximum(floor, hidden)
    level = 1.96 * np.sqrt(np.maximum(variance + pose + field, floor))
    # a bead is rough itself; only what is rough on both parts, edges and corners, is no sign of one
    shared = np.minimum(excess, _excess_below(surface, surfels.points, signed, normals))
    firm = 1.96 * np.sqrt(np.maximum(noise + (0.5 * shared) ** 2 + pose + field, floor))
    changed = np.abs(np.nan_to_num(signed)) > np.maximum(2 * level, 6 * sigma)
    facing = (surfels.normals * normals).sum(axis=1)
    _check_same_part(changed, held & (facing > 0), 2 * float(np.median(level[shown])))
    suspicious = far | (facing < 0.6)
    comparable = shown & surrounded(surface, surfels.points - np.nan_to_num(signed)[:, None] * normals, normals)
    odd = np.flatnonzero(~comparable | suspicious)
    free, aside = _in_the_way(surface, seen_from(target, back), surfels.points, odd, signed, normals)
    candidates = comparable & (np.nan_to_num(signed) > level)
    doubtful = np.flatnonzero(candidates & suspicious)
    candidates[doubtful] = in_front(surface, seen_from(target, back), surfels.points[doubtful], size)
    # what stands out but may be a wall that the sample's scanner missed was not compared
    comparable[doubtful] = candidates[doubtful]
    comparable |= free
    alone = np.hypot(firm, 1.96 * np.sqrt(hidden))
    standing = Standing(np.flatnonzero(candidates | free), free, aside, signed, normals, firm, alone)
    clusters, specks = find_pieces(source, surface, standing, min_surfels)
    middle = float(np.median(level[shown]))
    return Difference(clusters, surfels.points, signed, level, middle, firm, comparable, size, specks)


def _check_same_part(changed: Flags, common: Flags, within_mm: float) -> None:
    """Refuse scans most of whose common surface is changed; what faces the other way is none: of a thin wall one scan
    may show the front, the other the back.

    Raises:
        DegenerateError: more than ``MAX_CHANGED`` of it is.
    """
    if changed[common].sum() > MAX_CHANGED * common.sum():
        raise DegenerateError(
            f"{changed[common].sum() / common.sum():.0%} of the common surface differs by more than {within_mm:.2g} mm;"
            " is this another part, or a poor registration?"
        )


def _excess_below(surface: Surfels, points: Floats, signed: Floats, normals: Floats) -> Floats:
    """Roughness (N,) beyond the noise in mm of the surface's roughest surfel about the feet of points (N, 3)."""
    size = surface.grid.size_mm
    excess = np.sqrt(np.maximum(surface.roughness_mm**2 - surface.noise_mm**2, 0))
    around = within_radius(surface.grid, points - np.nan_to_num(signed)[:, None] * normals, size)
    padded = np.append(excess[around.indices], 0.0)
    highest = np.maximum.reduceat(padded, np.minimum(around.starts[:-1], len(padded) - 1))
    return np.where(np.diff(around.starts) > 0, highest, np.inf)


def _pose_variance(registration: FineRegistration, covariance: Floats, points: Floats, normals: Floats) -> Floats:
    """Variance (N,) of distances that comes from the pose's covariance: steep places feel translations across the
    surface."""
    if not np.isfinite(covariance).all():
        return np.zeros(len(points))
    transform = registration.T_target_source
    up = rotate_vectors(transform, normals)
    jacobian = np.column_stack([up, np.cross(move_points(transform, points) - registration.centre_mm, up)])
    return np.einsum("ij,ij->i", jacobian @ covariance, jacobian)


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


def _in_the_way(
    surface: Surfels, viewpoint: Floats | None, points: Floats, asked: Integers, signed: Floats, normals: Floats
) -> tuple[Flags, Flags]:
    """Of the ``asked`` points (N, 3) those off the surface that the sample's scanner saw through, and those of them
    that stand aside: the surface's normals do not lead to them, and their ``signed`` and ``normals`` become the way
    from its nearest surfel."""
    size = surface.grid.size_mm
    free, aside = np.zeros((2, len(points)), dtype=bool)
    lone = asked[nearest(surface.grid, points[asked], FREE_CELLS * size)[0] < 0]
    lone = lone[in_free_space(surface, viewpoint, points[lone])]
    at, away = nearest(surface.grid, points[lone], REACH_CELLS * size)
    lone, at, away = lone[at >= 0], at[at >= 0], away[at >= 0]
    free[lone] = True
    astray = ~(signed[lone] > FREE_CELLS * size)
    lone, at, away = lone[astray], at[astray], away[astray]
    aside[lone] = True
    signed[lone] = away
    normals[lone] = (points[lone] - surface.points[at]) / away[:, None]
    return free, aside
