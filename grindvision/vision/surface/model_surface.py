"""A model as scans are compared with it: its whole surface to find the pose, then what the scanner could see of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry.hash_grid import assign_cells, build_cells, cell_origin, grid_of_means
from grindvision.triangles import spread_points
from grindvision.vision.surface.facets import Facets, sound_facets
from grindvision.vision.surface.fpfh import compute_fpfh
from grindvision.vision.surface.ray_casting import RayTree, blocked
from grindvision.vision.surface.scan import Resolution, Scan, prepare_scan
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

POINTS_PER_SURFEL = 2.5
"""Points along the edge of a surfel's cell."""

MAX_POINTS = 2_000_000
"""A model so much larger than the scan that more points would be needed is spread more thinly."""

VIEWS = np.vstack([np.eye(3), -np.eye(3), [[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)] / np.sqrt(3)])
"""Directions (14, 3) from which keypoints are looked at: their histograms must hold what one scanner sees, not the back
of a sheet."""

COS_SEEN = float(np.cos(np.radians(80)))
"""Cosine of the angle between normal and ray up to which a scanner is taken to see a surface."""

LIFT = 0.05
"""Ways to the scanner begin so many cells above the surface."""


@dataclass(frozen=True, eq=False)
class ModelSurface:
    """The ``facets`` of a model and the ``tree`` that casts rays at them. A surface equals itself only."""

    facets: Facets
    tree: RayTree

    def __str__(self) -> str:
        return str(self.facets)


def model_surface(vertices: Floats, triangles: Integers) -> ModelSurface:
    """A model of vertices (V, 3) in mm and triangles (T, 3) made ready.

    Raises:
        DegenerateError: no triangle has an area.
    """
    return ModelSurface(*sound_facets(vertices, triangles))


def spread(surface: ModelSurface, step_mm: float) -> tuple[Floats, Floats]:
    """Points (N, 3) about ``step_mm`` apart, evenly over the whole surface, and their facets' normals (N, 3)."""
    facets = surface.facets
    points, owner = spread_points(facets.corners, int(min(facets.area_mm2 / step_mm**2, MAX_POINTS)))
    return points, facets.normals[owner]


def seen(surface: ModelSurface, points: Floats, normals: Floats, eye: Floats, lift_mm: float) -> Flags:
    """Which points (N, 3) with normals (N, 3) on the surface are turned to an eye (3,) and not hidden from it."""
    ways = eye - points
    facing = (ways * normals).sum(axis=1) > COS_SEEN * np.linalg.norm(ways, axis=1)
    starts = points[facing] + lift_mm * normals[facing]
    facing[facing] = ~blocked(surface.tree, starts, eye - starts)
    return facing


def whole_scan(surface: ModelSurface, resolution: Resolution) -> Scan:
    """The whole model as a scan without a viewpoint, whose keypoints are those that can be seen from anywhere."""
    points, normals = spread(surface, resolution.surfel_mm / POINTS_PER_SURFEL)
    surfels, _ = _facet_surfels(points, normals, resolution.surfel_mm, one_side=True)
    voxel = resolution.voxel_mm
    every = max(int((voxel / resolution.surfel_mm) ** 2 / 4), 1)
    voxels, spots = _facet_surfels(points[::every], normals[::every], voxel, one_side=False)
    places, facing = points[::every][spots], normals[::every][spots]
    features, weights = np.zeros((len(voxels), 33)), np.zeros(len(voxels))
    far = 10 * surface.facets.diagonal_mm + float(np.abs(surface.facets.corners).max())
    for view in VIEWS:
        shown = seen(surface, places, facing, far * view, LIFT * voxel)
        if shown.sum() < 20:
            continue
        weight = np.maximum(voxels.normals[shown] @ view, 0.05)
        features[shown] += weight[:, None] * compute_fpfh(voxels.points[shown], voxels.normals[shown], 5 * voxel)
        weights[shown] += weight
    shown = weights > 0
    if not shown.any():
        raise DegenerateError("nothing of the model can be seen from outside; export the mesh again")
    kept = Surfels(
        build_cells(voxels.points[shown], voxel), voxels.normals[shown], voxels.counts[shown],
        voxels.noise_mm[shown], voxels.roughness_mm[shown],
    )  # fmt: skip
    return Scan(points, None, surfels, kept, features[shown] / weights[shown, None], surface.facets.sided)


def scan_seen_from(surface: ModelSurface, resolution: Resolution, eye: Floats) -> Scan:
    """What a scanner at ``eye`` (3,), in the model's frame, would see of it, as a scan without noise.

    Its fine surfels lie in the facets' planes, also beside an edge, where a plane fitted to points cuts the corner: a
    scan that shows one face alone of the two would stand out of that plane. Their roughness is that of fitted planes.

    Raises:
        DegenerateError: next to nothing.
    """
    points, normals = spread(surface, resolution.surfel_mm / POINTS_PER_SURFEL)
    shown = seen(surface, points, normals, eye, LIFT * resolution.surfel_mm)
    if shown.sum() < 100:
        raise DegenerateError("the scanner of the test scan would see nothing of the model at the best pose")
    points, normals = points[shown], normals[shown]
    scan = prepare_scan(points, resolution, eye, feature_voxels=None)
    flat, _ = _facet_surfels(points, normals, resolution.surfel_mm, one_side=True)
    return replace(scan, surfels=replace(flat, roughness_mm=scan.surfels.roughness_mm))  # cells in the same order


def _facet_surfels(points: Floats, normals: Floats, size_mm: float, one_side: bool) -> tuple[Surfels, Integers]:
    """Surfels of points (N, 3) with their facets' normals (N, 3), and for each the point (M,) nearest to its mean.

    The points of a cell whose normals differ most in another axis, or in its sign, are apart: the two faces of a sheet,
    the faces about an edge. Each gives a surfel, or, with ``one_side``, that of most points alone.
    """
    origin = cell_origin(points, size_mm)
    cell, keys, table_keys, table_cells = assign_cells(np.ascontiguousarray(points), origin, 1.0 / size_mm)
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (normals[np.arange(len(points)), axis] > 0)
    groups, group = np.unique(6 * cell.astype(np.int64) + side, return_inverse=True)
    counts = np.bincount(group)
    means = np.stack([np.bincount(group, points[:, k]) / counts for k in range(3)], axis=1)
    facing: Floats = np.stack([np.bincount(group, normals[:, k]) for k in range(3)], axis=1).astype(float)
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    height = ((points - means[group]) * facing[group]).sum(axis=1)
    rough = np.sqrt(np.bincount(group, height**2) / counts)
    away = ((points - means[group]) ** 2).sum(axis=1)
    order = np.lexsort((away, group))
    nearest = order[np.searchsorted(group[order], np.arange(len(groups)))]
    if not one_side:
        return Surfels(build_cells(means, size_mm), facing, counts, rough, rough), nearest
    owner = groups // 6
    best = np.lexsort((-counts, owner))
    best = best[np.searchsorted(owner[best], np.arange(len(keys)))]
    grid = grid_of_means(means[best], size_mm, origin, keys, (table_keys, table_cells))
    return Surfels(grid, facing[best], counts[best], rough[best], rough[best]), nearest[best]
