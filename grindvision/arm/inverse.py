"""Joint angles that reach a pose, for any number of revolute joints, by damped least squares from many starts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from grindvision.arm.jacobians import joint_twists
from grindvision.arm.mdh import MdhArm, joint_transforms
from grindvision.errors import InputError
from grindvision.geometry import check_rigid
from grindvision.records import by_content

Floats = NDArray[np.float64]


@by_content
@dataclass(frozen=True)
class InverseSolution:
    """Joint angles ``q_rad`` (n,) in -pi..pi that come nearest to a pose, and what is left: mm and rad."""

    q_rad: Floats
    position_error_mm: float
    angle_error_rad: float

    def __str__(self) -> str:
        angles = ", ".join(f"{value:.2f}" for value in np.degrees(self.q_rad))
        return (
            f"joint angles ({angles}) deg leave {self.position_error_mm:.3g} mm"
            f" and {np.degrees(self.angle_error_rad):.3g} deg"
        )


def nearest_angles(
    arm: MdhArm,
    T_base_joint: ArrayLike,
    rng: np.random.Generator,
    mm_per_rad: float = 100.0,
    starts: int = 40,
) -> list[InverseSolution]:
    """Joint angles whose last frame comes nearest to ``T_base_joint`` (4, 4), best first, each distinct to 0.1 mrad.

    With fewer than six joints a pose is in general reached only approximately: the cost is the squared distance in mm
    plus the squared angle in rad times ``mm_per_rad`` squared. Local minima are kept, so a caller can choose a branch.

    Raises:
        NotRigidError: the pose is no rigid transform. InputError: ``starts`` below one.
    """
    pose = check_rigid(T_base_joint, "T_base_joint")
    if starts < 1:
        raise InputError(f"starts is {starts}; at least one is needed")

    @lru_cache(maxsize=1)
    def reached(q_rad: tuple[float, ...]) -> tuple[Floats, Floats]:
        """Joint frames, and the rotation vector that is missing; the solver asks for both functions at one place."""
        frames = joint_transforms(arm, q_rad)
        return frames, Rotation.from_matrix(pose[:3, :3] @ frames[-1, :3, :3].T).as_rotvec()

    def residual(q: Floats) -> Floats:
        frames, rotation = reached(tuple(q))
        return np.concatenate([frames[-1, :3, 3] - pose[:3, 3], -mm_per_rad * rotation])

    def jacobian(q: Floats) -> Floats:
        frames, rotation = reached(tuple(q))
        twists = joint_twists(arm, q, frames)
        position = frames[-1, :3, 3]
        return np.vstack(
            [
                twists[:3] + np.cross(twists[3:], position[:, None], axis=0),
                mm_per_rad * _log_slope(-rotation) @ twists[3:],
            ]
        )

    found: list[InverseSolution] = []
    for start in rng.uniform(-np.pi, np.pi, (starts, arm.n)):
        fit = least_squares(residual, start, jac=jacobian, method="lm", xtol=1e-14, ftol=1e-14)
        q = (fit.x + np.pi) % (2 * np.pi) - np.pi
        left = residual(q)
        if any(np.abs((q - other.q_rad + np.pi) % (2 * np.pi) - np.pi).max() < 1e-4 for other in found):
            continue
        position_error, angle_error = np.linalg.norm(left[:3]), np.linalg.norm(left[3:]) / mm_per_rad
        found.append(InverseSolution(q, float(position_error), float(angle_error)))
    return sorted(found, key=lambda s: s.position_error_mm**2 + (mm_per_rad * s.angle_error_rad) ** 2)


def _log_slope(rotvec: Floats) -> Floats:
    """Left inverse Jacobian of SO(3): how the rotation vector of R changes when R turns in the base frame."""
    angle = np.linalg.norm(rotvec)
    x, y, z = rotvec
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    factor = 1 / 12 if angle < 1e-6 else (1 - angle / 2 / np.tan(angle / 2)) / angle**2
    return np.eye(3) - cross / 2 + factor * cross @ cross
