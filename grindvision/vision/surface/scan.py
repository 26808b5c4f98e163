"""Two scans made ready for comparison: fine surfels for ICP and difference, keypoints for the first alignment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry import inverse, move_points
from grindvision.geometry.hash_grid import build_cells, neighbour_counts
from grindvision.geometry.neighbours import nearest
from grindvision.geometry.point_order import in_order
from grindvision.parallel import parallel_map
from grindvision.records import by_content
from grindvision.vision.surface.fpfh import compute_fpfh, mirrored_fpfh
from grindvision.vision.surface.keypoints import Keypoints
from grindvision.vision.surface.normals import estimate_normals, guess_viewpoint
from grindvision.vision.surface.surfels import Surfels, build_surfels, surface_area

Floats = NDArray[np.float64]

COS_UNSEEN = float(np.cos(np.radians(89)))
"""Cosine of the angle between normal and ray from which on no scanner sees a surface: the plane of such a surfel runs
along one line of pixels, at the scan's rim, and which way it faces would be left to rounding."""

MIN_NEIGHBOURS, LARGER, MAX_STEPS = 7, 1.25, 8
"""Of the 27 cells about one on a surface that is seen all over, nine or more are occupied. Where it is fewer than this
in the median, as between the lines of a profile scanner, planes would be fitted through single lines: the cells grow by
this factor, so many times at most."""

SIZES_PER_OCTAVE = 64
"""Cell sizes are rounded to so many per factor of two, so that a point more or less does not move every cell."""


@dataclass(frozen=True)
class Resolution:
    """Sizes that follow from the data: ``spacing_mm`` of the points, ``surfel_mm`` and ``voxel_mm`` cell edges."""

    spacing_mm: float
    surfel_mm: float
    voxel_mm: float

    def __str__(self) -> str:
        cells = f"surfels of {self.surfel_mm:.3g} mm, voxels of {self.voxel_mm:.3g} mm"
        return f"points {self.spacing_mm:.3g} mm apart, {cells}"


@by_content
@dataclass(frozen=True)
class Scan:
    """A scan (N, 3) in its scanner's frame with what the stages need; its points stand in the order of ``in_order``.

    ``viewpoint_mm`` (3,) is the scanner, None where it is not known; then the side the normals point to is a guess.
    ``surfels`` are fine, ``voxels`` coarse; ``features`` (M, 33) are the voxels' FPFH, (M, 0) where left out;
    ``sided``: the normals are known to point outwards without a viewpoint, as a model's are; ``bent``: surfels were
    moved by a field, and no longer lie in the cells of their points.
    """

    points: Floats
    viewpoint_mm: Floats | None
    surfels: Surfels
    voxels: Surfels
    features: Floats
    sided: bool = False
    bent: bool = False

    @property
    def keypoints(self) -> Keypoints:
        """The voxels' points and normals with their ``features``, for the first alignment."""
        return Keypoints(self.voxels.points, self.voxels.normals, self.features, self.voxels.grid.size_mm)

    def __str__(self) -> str:
        return f"{len(self.points):,} points, {self.surfels}, {len(self.voxels):,} keypoints"


def choose_resolution(points: ArrayLike, voxels: int = 3000) -> Resolution:
    """Cell sizes for a scan (N, 3): about 25,000 surfels where the points allow it, more, as the root of their number,
    above half a million, and about ``voxels`` coarse cells. Cells reach across the gaps between a scan's lines."""
    points = np.asarray(points, dtype=float)
    area = surface_area(points)
    surfels = min(25_000 * max(1.0, np.sqrt(len(points) / 500_000)), len(points) / 2)
    surfel = _rounded(np.sqrt(area / surfels))
    for _ in range(MAX_STEPS):
        if np.median(neighbour_counts(points, surfel)) >= MIN_NEIGHBOURS:
            break
        surfel = _rounded(LARGER * surfel)
    return Resolution(np.sqrt(area / len(points)), surfel, _rounded(max(np.sqrt(area / voxels), surfel)))


def coarser(one: Resolution, other: Resolution) -> Resolution:
    """The resolution both scans can be brought to."""
    surfel = max(one.surfel_mm, other.surfel_mm)
    return Resolution(max(one.spacing_mm, other.spacing_mm), surfel, max(one.voxel_mm, other.voxel_mm, 1.5 * surfel))


def _rounded(size_mm: float) -> float:
    """The nearest of ``SIZES_PER_OCTAVE`` evenly spaced sizes between two powers of two."""
    fraction, exponent = np.frexp(size_mm)
    return float(np.ldexp(np.round(2 * SIZES_PER_OCTAVE * fraction) / (2 * SIZES_PER_OCTAVE), exponent))


def prepare_scan(
    points: ArrayLike, resolution: Resolution, viewpoint_mm: ArrayLike | None = None, feature_voxels: float | None = 5.0
) -> Scan:
    """Surfels, normals and FPFH of a scan (N, 3).

    Args:
        viewpoint_mm: the scanner (3,) in the frame of the points; guessed when left out (``guess_viewpoint``).
        feature_voxels: FPFH radius in voxels; None leaves the histograms out, for a scan whose pose is known.
    """
    points = in_order(np.asarray(points, dtype=float))
    fine = build_surfels(points, resolution.surfel_mm)
    viewpoint = guess_viewpoint(fine.points, fine.normals) if viewpoint_mm is None else np.asarray(viewpoint_mm, float)
    coarse = build_surfels(fine.points, resolution.voxel_mm)
    voxel = resolution.voxel_mm
    normals = estimate_normals(coarse.points, 2.5 * voxel, 40, viewpoint)
    if viewpoint is None:
        near, _ = nearest(build_cells(coarse.points, 2 * voxel), fine.points, 4 * voxel)
        facing_away = (normals[near] * fine.normals).sum(axis=1) < 0
        fine = replace(fine, normals=np.where(facing_away[:, None], -fine.normals, fine.normals))
    else:
        fine = replace(fine, normals=_facing(fine.points, fine.normals, viewpoint))
    if feature_voxels is None:
        features = np.empty((len(coarse), 0))
    else:
        features = compute_fpfh(coarse.points, normals, feature_voxels * voxel)
    return Scan(points, viewpoint, fine, replace(coarse, normals=normals), features)


def _facing(points: Floats, normals: Floats, viewpoint_mm: Floats) -> Floats:
    """Normals (N, 3) turned towards the viewpoint; zero where they are square to the ray (``COS_UNSEEN``)."""
    rays = viewpoint_mm - points
    cosines = (rays * normals).sum(axis=1) / np.linalg.norm(rays, axis=1)
    return np.sign(np.where(np.abs(cosines) < COS_UNSEEN, 0.0, cosines))[:, None] * normals


def prepare_pair(
    source: ArrayLike, target: ArrayLike, viewpoints_mm: tuple[ArrayLike | None, ArrayLike | None] = (None, None)
) -> tuple[Scan, Scan]:
    """Both scans at one resolution, one in each of two threads."""
    resolution = coarser(*parallel_map(choose_resolution, (source, target)))
    first, second = parallel_map(prepare_scan, (source, target), (resolution, resolution), viewpoints_mm)
    return first, second


def reversed_scan(scan: Scan) -> Scan:
    """The same scan with its normals pointing to the other side."""
    return replace(
        scan,
        surfels=replace(scan.surfels, normals=-scan.surfels.normals),
        voxels=replace(scan.voxels, normals=-scan.voxels.normals),
        features=mirrored_fpfh(scan.features),
    )


def seen_from(scan: Scan, T_other_scan: ArrayLike) -> Floats | None:
    """The scan's viewpoint (3,) in another frame; None where it is not known."""
    return None if scan.viewpoint_mm is None else move_points(T_other_scan, scan.viewpoint_mm)


def surface_in_frame(surfels: Surfels, T_other_scan: ArrayLike) -> Surfels:
    """Surfels expressed in another frame (T_other_scan @ p_scan), in a grid of that frame with the same cell size."""
    transform = np.asarray(T_other_scan, dtype=float)
    grid = build_cells(move_points(transform, surfels.points), surfels.grid.size_mm)
    return replace(surfels, grid=grid, normals=surfels.normals @ inverse(transform)[:3, :3])
