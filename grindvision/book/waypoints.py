"""Way points against the true root of a weld groove, and against the root as the camera shows it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.cell import WeldScene
from grindvision.geometry import vector_angle
from grindvision.vision.seam_path import SeamPath

Floats = NDArray[np.float64]

#: Points within this distance of a root point tell how far the camera as a whole is off there, mm.
NEAR_MM = 8.0


@dataclass(frozen=True)
class WaypointErrors:
    """How W way points lie to the true root line, mm: ``across`` the seam and ``up`` out of the groove.

    ``off_mm`` (W,) is the distance in 3D from the root line, ``beyond_mm`` (W,) how far a way point lies past the
    line's end (part of ``off_mm``), ``axis_deg`` (W,) the angle between its normal and the true one.
    """

    across_mm: Floats
    up_mm: Floats
    beyond_mm: Floats
    axis_deg: Floats

    @property
    def off_mm(self) -> Floats:
        """Distance (W,) from the root line in 3D."""
        return np.sqrt(self.across_mm**2 + self.up_mm**2 + self.beyond_mm**2)

    def __str__(self) -> str:
        return (
            f"{len(self.up_mm)} way points off by {self.off_mm.mean():.2f} mm on average, {self.off_mm.max():.2f} mm at"
            f" most; axis by {self.axis_deg.mean():.1f} deg"
        )


def waypoint_errors(path: SeamPath, scene: WeldScene, as_shown: bool = False) -> WaypointErrors:
    """Compare a path in the camera frame with the root the camera could see.

    ``as_shown`` first moves each root point by the mean error of the measured points around it: what is left is the
    method's own, without the camera's waviness and scale, which no method can take out of a single cloud.
    """
    root = scene.root_mm + camera_errors(scene) if as_shown else scene.root_mm
    _, nearest = cKDTree(root).query(path.points)
    error, tangents, normals = path.points - root[nearest], scene.tangents[nearest], scene.normals[nearest]
    along = np.einsum("ij,ij->i", error, tangents)
    at_end = (nearest == 0) | (nearest == len(root) - 1)
    return WaypointErrors(
        across_mm=np.einsum("ij,ij->i", error, np.cross(normals, tangents)),
        up_mm=np.einsum("ij,ij->i", error, normals),
        beyond_mm=np.where(at_end, along, 0.0),
        axis_deg=np.degrees(vector_angle(path.normals, normals)),
    )


def camera_errors(scene: WeldScene) -> Floats:
    """Mean error (K, 3) in mm of the points measured within ``NEAR_MM`` of each root point."""
    measured, true = scene.scan.points, scene.scan.true_points
    around = cKDTree(true).query_ball_point(scene.root_mm, NEAR_MM)
    return np.stack([(measured[near] - true[near]).mean(axis=0) if near else np.zeros(3) for near in around])
