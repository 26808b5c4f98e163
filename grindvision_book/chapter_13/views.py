"""Neighbouring views of things at rest: registered without any pose, judged by what the controller says of the motion.

The camera's motion between two views and the flange's are alike up to the hand-eye matrix, which nobody knows exactly.
Two numbers of a motion do not depend on it: its angle, and its pitch, the part of the shift along the axis.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from grindvision.errors import GrindvisionError, GrindvisionWarning
from grindvision.geometry import fit_plane, inverse, move_points, unit_vectors, vector_angle
from grindvision.geometry.ransac import ransac_plane
from grindvision.vision.registration.scan_registration import RegisterOptions, register
from grindvision_book.chapter_13.sphere import controller_poses, views

Floats = NDArray[np.float64]

#: A registered motion is wrong where its angle or pitch differs by more from the controller's.
WRONG_DEG, WRONG_MM = 1.0, 5.0

#: Points of the plate lie within this of its plane, mm.
PLATE_MM = 1.0


@dataclass(frozen=True)
class Plate:
    """The plate in every view: rms (N,) about its plane, and each normal's angle (N,) from their mean in the base.

    ``heights`` holds, for every view, points (N, 3) as the plane's own two coordinates and the height above it, mm.
    """

    rms_mm: Floats
    off_mean_deg: Floats
    heights: tuple[Floats, ...]


def screw(motion: Floats) -> tuple[float, float]:
    """Angle (deg) and pitch (mm, the shift along the axis) of a rigid motion (4, 4)."""
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(turn))
    return float(np.degrees(angle)), float(motion[:3, 3] @ turn / angle) if angle else 0.0


def register_neighbours(folder: Path, name: str, pairs: int, seed: int) -> pd.DataFrame:
    """Register each view with the next one, ``pairs`` of the eight, and compare angle and pitch with the controller's.

    ``state`` is ``right``, ``wrong`` or ``refused``; ``said`` the first part of the refusal.
    """
    clouds, flanges = views(folder, name), controller_poses(folder, name)
    rows = []
    for first in range(pairs):
        angle, pitch = screw(inverse(flanges[first]) @ flanges[first + 1])
        row = {"set": name, "pair": f"{first + 1}-{first + 2}", "controller_deg": angle, "controller_pitch_mm": pitch}
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GrindvisionWarning)  # stray points, left out
                found = register(clouds[first + 1], clouds[first], RegisterOptions(seed=seed))
        except GrindvisionError as error:
            rows.append({**row, "state": "refused", "said": str(error).split(";")[0]})
            continue
        seen, along = screw(found.T_target_source)
        row |= {"off_deg": seen - angle, "off_pitch_mm": along - pitch, "overlap_percent": 100 * found.overlap}
        right = abs(seen - angle) <= WRONG_DEG and abs(along - pitch) <= WRONG_MM
        rows.append({**row, "state": "right" if right else "wrong", "said": ""})
    columns = ["off_deg", "off_pitch_mm", "overlap_percent"]
    return pd.DataFrame(rows).reindex(columns=[*rows[0], *(name for name in columns if name not in rows[0])])


def meeting_mm(folder: Path, name: str, T_flange_camera: Floats) -> float:
    """Median distance of the points of a view from the nearest of the view before it, through controller and camera."""
    flanges = controller_poses(folder, name)
    clouds = [
        move_points(flange @ T_flange_camera, cloud) for flange, cloud in zip(flanges, views(folder, name), strict=True)
    ]
    gaps = [cKDTree(one).query(other)[0] for one, other in pairwise(clouds)]
    return float(np.median(np.concatenate(gaps)))


def seen_plate(folder: Path, T_flange_camera: Floats, seed: int) -> Plate:
    """The plate of the set Plane in its nine views, and its normals in the base frame."""
    fits, normals, heights = [], [], []
    for cloud, flange, rng in zip(
        views(folder, "Plane"), controller_poses(folder, "Plane"), np.random.default_rng(seed).spawn(9), strict=True
    ):
        found = ransac_plane(cloud, PLATE_MM, rng, iterations=100)
        fit = fit_plane(cloud[found.inliers])
        towards_camera = fit.normal * (-np.sign(fit.normal @ cloud.mean(axis=0)))
        fits.append(fit.rms_mm)
        normals.append((flange @ T_flange_camera)[:3, :3] @ towards_camera)
        along = unit_vectors(np.cross(towards_camera, [0.0, 1.0, 0.0]))
        frame = np.array([along, np.cross(towards_camera, along), towards_camera])
        heights.append((cloud - cloud[found.inliers].mean(axis=0)) @ frame.T)
    mean = unit_vectors(np.mean(normals, axis=0))
    return Plate(np.array(fits), np.degrees(vector_angle(np.array(normals), mean)), tuple(heights))
