"""A sphere that a camera on an arm sees nine times: its radius, the camera's residue, and the hand-eye matrix."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from grindvision.calibration.hand_eye import HandEye, hand_eye
from grindvision.calibration.pose_conventions import convention, poses_from, read_pose_rows
from grindvision.calibration.sphere_centres import find_sphere
from grindvision.clouds import finite_points, read_cloud
from grindvision.geometry import SphereFit

Floats = NDArray[np.float64]

VIEWS = range(1, 10)


@dataclass(frozen=True)
class SeenSphere:
    """The sphere of every view, SciPy's radius (N,) of the same points, and the camera on the flange."""

    clouds: tuple[Floats, ...]
    fits: tuple[SphereFit, ...]
    scipy_radii_mm: Floats
    camera: HandEye

    @property
    def radii_mm(self) -> Floats:
        """Radius (N,) of every view."""
        return np.array([fit.radius_mm for fit in self.fits])


def views(folder: Path, name: str) -> tuple[Floats, ...]:
    """The nine clouds of a RegHEC set, each (N, 3) in mm in the camera's frame."""
    paths = [folder / "reghec" / name / f"view{i}d.pcd" for i in VIEWS]
    return tuple(finite_points(read_cloud(path, "m"), str(path)) for path in paths)


def controller_poses(folder: Path, name: str) -> Floats:
    """T_base_flange (9, 4, 4) in mm of a RegHEC set: fixed-axes xyz angles in rad before the position."""
    path = folder / "reghec" / name / "RobotPoses.dat"
    return poses_from(read_pose_rows(path), convention("xyz", "rad", "mm", rotation_first=True), str(path))


def seen_sphere(folder: Path, seed: int) -> SeenSphere:
    """Fit the sphere in every view, its radius free, and solve for the camera's place from the nine centres."""
    clouds = views(folder, "Sphere")
    streams = np.random.default_rng(seed).spawn(len(clouds))
    fits = tuple(find_sphere(cloud, rng) for cloud, rng in zip(clouds, streams, strict=True))
    radii = np.array([scipy_radius_mm(cloud[fit.inliers]) for cloud, fit in zip(clouds, fits, strict=True)])
    centres = np.array([fit.centre_mm for fit in fits])
    return SeenSphere(clouds, fits, radii, hand_eye(controller_poses(folder, "Sphere"), centres))


def scipy_radius_mm(points: Floats) -> float:
    """Radius of the sphere whose surface lies nearest to the points (N, 3) in the sense of least squares."""
    middle = points.mean(axis=0)
    start = np.array([*middle, np.linalg.norm(points - middle, axis=1).max()])
    fit = least_squares(lambda sphere: np.linalg.norm(points - sphere[:3], axis=1) - sphere[3], start)
    return float(fit.x[3])
