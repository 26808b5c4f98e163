"""Rays against meshes: Open3D finds the triangle in float32, its plane is then met again in float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from grindvision.cell.solids import Solid

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: Rays towards the projector start this far off the surface, so that they do not meet their own triangle.
LIFT_MM = 0.005


@dataclass(frozen=True)
class Hits:
    """What rays met: ``ray`` (N,) index of each ray that hit, ``distance`` (N,) in ray lengths, ``triangle`` (N,)."""

    ray: Integers
    distance: Floats
    triangle: Integers


class Target:
    """A solid made ready for many rays. All points and directions are in the solid's frame."""

    def __init__(self, solid: Solid) -> None:
        self.solid = solid
        a, b, c = (solid.vertices_mm[solid.triangles[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        self.normals = normals / np.where(lengths > 0, lengths, 1)
        self.corners = a
        self.centre = (solid.vertices_mm.min(axis=0) + solid.vertices_mm.max(axis=0)) / 2
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
        rough = rough[ray].astype(float)
        triangle = found["primitive_ids"].numpy()[ray].astype(np.int64)
        normals = self.normals[triangle]
        slope = np.einsum("ij,ij->i", directions[ray], normals)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.einsum("ij,ij->i", self.corners[triangle] - origin, normals) / slope
            distance = np.where(np.abs(distance - rough) < 1e-4 * rough, distance, rough)
        return Hits(ray, distance, triangle)

    def sees(self, points: Floats, normals: Floats, eye: Floats) -> Flags:
        """Whether the straight way from surface points (N, 3) to ``eye`` (3,) is free."""
        starts = points + LIFT_MM * normals
        rays = np.concatenate([starts - self.centre, eye - starts], axis=1).astype(np.float32)
        return ~self._scene.test_occlusions(o3d.core.Tensor(rays), tfar=1.0).numpy()
