"""A camera on an arm that looks at a target at rest: what the controller shows and the camera sees, the truth known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.geometry import inverse, move_points, rigid

Floats = NDArray[np.float64]

#: T_flange_camera, planted.
T_FLANGE_CAMERA = rigid(Rotation.from_euler("xyz", [4.0, -3.0, 40.0], degrees=True).as_matrix(), [60.0, -30.0, 80.0])

#: Where the target rests in the base frame.
T_BASE_TARGET = rigid(Rotation.from_euler("z", 25.0, degrees=True).as_matrix(), [500.0, 100.0, 50.0])


@dataclass(frozen=True)
class Errors:
    """Standard deviations along, or about, every axis: of the flange's pose and of what the camera sees."""

    arm_mm: float = 0.2
    arm_deg: float = 0.04
    camera_mm: float = 0.1
    camera_deg: float = 0.08


def looking_poses(rng: np.random.Generator, count: int, turn_deg: float) -> Floats:
    """T_base_flange (count, 4, 4): the camera looks at the target from 330 to 470 mm, turned by up to ``turn_deg``."""
    down = np.diag([1.0, -1.0, -1.0])
    poses = []
    for _ in range(count):
        turned = down @ Rotation.from_rotvec(np.radians(rng.uniform(-turn_deg, turn_deg, 3))).as_matrix()
        seen_at = np.array([*rng.uniform(-60, 60, 2), rng.uniform(330, 470)])
        T_base_camera = rigid(turned, T_BASE_TARGET[:3, 3] - turned @ seen_at)
        poses.append(T_base_camera @ inverse(T_FLANGE_CAMERA))
    return np.array(poses)


def shown_and_seen(rng: np.random.Generator, poses: Floats, errors: Errors) -> tuple[Floats, Floats]:
    """Poses that the controller shows, and T_camera_target that the camera sees, (N, 4, 4) each, with their errors."""
    T_camera_target = inverse(poses @ T_FLANGE_CAMERA) @ T_BASE_TARGET
    shown = poses @ _small(rng, len(poses), errors.arm_mm, errors.arm_deg)
    seen = T_camera_target @ _small(rng, len(poses), errors.camera_mm, errors.camera_deg)
    return shown, seen


def view_of_part(rng: np.random.Generator, T_base_camera: Floats, points: int = 4000, noise_mm: float = 0.05) -> Floats:
    """Points (N, 3) of a plate of 120 x 80 mm with four bumps, resting at the target's place, in the camera's frame."""
    x, y = rng.uniform(-60, 60, points), rng.uniform(-40, 40, points)
    z = np.zeros(points)
    for a, b, height, width in ((25, -10, 12, 90), (-30, 15, 9, 60), (-10, -20, 7, 40), (40, 25, 8, 50)):
        z += height * np.exp(-((x - a) ** 2 + (y - b) ** 2) / width)
    part = np.column_stack([x, y, z + noise_mm * rng.normal(size=points)])
    return move_points(inverse(T_base_camera) @ T_BASE_TARGET, part)


def off_truth(T_flange_camera: Floats) -> tuple[float, float]:
    """Distance (mm) and angle (deg) of a camera's place (4, 4) from the planted one."""
    apart = T_flange_camera[:3, :3] @ T_FLANGE_CAMERA[:3, :3].T
    shift = float(np.linalg.norm(T_flange_camera[:3, 3] - T_FLANGE_CAMERA[:3, 3]))
    return shift, float(np.degrees(Rotation.from_matrix(apart).magnitude()))


def _small(rng: np.random.Generator, count: int, shift_mm: float, turn_deg: float) -> Floats:
    """Small random motions (count, 4, 4)."""
    turns = Rotation.from_rotvec(np.radians(turn_deg) * rng.normal(size=(count, 3))).as_matrix()
    shifts = shift_mm * rng.normal(size=(count, 3))
    return np.array([rigid(turn, shift) for turn, shift in zip(turns, shifts, strict=True)])
