"""Rays against meshes: Open3D finds the triangle in float32, its plane is then met again in float64."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from grindvision.cell.solids import Solid
from grindvision.extras import extra
from grindvision.kernels import njit
from grindvision.open3d_import import leave_out_plotly
from grindvision.records import by_content

leave_out_plotly()
with extra("sim"):
    import open3d as o3d

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
Singles = NDArray[np.float32]

#: Rays towards the projector start this far off the surface, so that they do not meet their own triangle.
LIFT_MM = 0.005


@by_content
@dataclass(frozen=True)
class Hits:
    """What rays met: ``ray`` (N,) index of each ray that hit, ``distance`` (N,) in ray lengths, ``triangle`` (N,)."""

    ray: Integers
    distance: Floats
    triangle: Integers


class Target:
    """A solid made ready for many rays. All points and directions are in the solid's frame; so is ``box_mm`` (8, 3),
    the corners of its bounding box."""

    def __init__(self, solid: Solid) -> None:
        self.solid = solid
        a, b, c = (solid.vertices_mm[solid.triangles[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        self.normals = normals / np.where(lengths > 0, lengths, 1)
        self.corners = a
        ends = np.array([solid.vertices_mm.min(axis=0), solid.vertices_mm.max(axis=0)])
        self.box_mm = np.array(list(itertools.product(*ends.T)))
        self.centre = ends.sum(axis=0) / 2
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor((solid.vertices_mm - self.centre).astype(np.float32)),
            o3d.core.Tensor(solid.triangles.astype(np.uint32)),
        )

    def cast(self, origin: Floats, directions: Floats) -> Hits:
        """First hits of rays from ``origin`` (3,) along ``directions`` (N, 3)."""
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = origin - self.centre
        rays[:, 3:] = directions
        found = self._scene.cast_rays(o3d.core.Tensor(rays))
        rough = found["t_hit"].numpy()
        ray = np.flatnonzero(np.isfinite(rough))
        triangle = found["primitive_ids"].numpy()[ray].astype(np.int64)
        distance = _distances(origin, directions, ray, rough, triangle, self.corners, self.normals)
        return Hits(ray, distance, triangle)

    def sees(self, points: Floats, normals: Floats, eye: Floats) -> Flags:
        """Whether the straight way from surface points (N, 3) to ``eye`` (3,) is free."""
        ways = _ways(points, normals, eye, self.centre)
        return ~self._scene.test_occlusions(o3d.core.Tensor(ways), tfar=1.0).numpy()

    def heights(self, points: Floats, normals: Floats, above_mm: float = 20.0) -> Floats:
        """Heights (N,) of the surface over points (N, 3) along unit normals (N, 3), the highest within ``above_mm`` and
        as far below; NaN where there is none."""
        rays = np.hstack([points - self.centre + above_mm * normals, -normals]).astype(np.float32)
        found = self._scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy().astype(float)
        return np.where(found <= 2 * above_mm, above_mm - found, np.nan)


@lru_cache(maxsize=8)
def target_of(solid: Solid) -> Target:
    """The solid as a target; the last few are kept, as a study scans one part many times."""
    return Target(solid)


@njit(cache=True)
def _distances(
    origin: Floats,
    directions: Floats,
    ray: Integers,
    rough: Singles,
    triangle: Integers,
    corners: Floats,
    normals: Floats,
) -> Floats:
    """Distances (K,) along the rays to the planes of their triangles; the rough one where the two disagree."""
    distances = np.empty(len(ray))
    for i in range(len(ray)):
        slope, height = 0.0, 0.0
        for k in range(3):
            normal = normals[triangle[i], k]
            slope += directions[ray[i], k] * normal
            height += (corners[triangle[i], k] - origin[k]) * normal
        near = np.float64(rough[ray[i]])
        distance = height / slope if slope != 0 else near
        distances[i] = distance if abs(distance - near) < 1e-4 * near else near
    return distances


@njit(cache=True)
def _ways(points: Floats, normals: Floats, eye: Floats, centre: Floats) -> Singles:
    """Rays (N, 6) about ``centre`` from just above surface points (N, 3) to the eye, one ray length away."""
    ways = np.empty((len(points), 6), dtype=np.float32)
    for i in range(len(points)):
        for k in range(3):
            start = points[i, k] + LIFT_MM * normals[i, k]
            ways[i, k] = start - centre[k]
            ways[i, 3 + k] = eye[k] - start
    return ways
