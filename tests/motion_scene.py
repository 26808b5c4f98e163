"""What the tests of the motion room share: a curved seam, both arms, and the UR3 as its maker's DH table prints it."""

from pathlib import Path

import numpy as np

from grindvision.arm import read_arm
from grindvision.geometry import rigid
from grindvision.motion import (
    ER3A_LIMITS,
    ToolTrajectoryOptions,
    grinding_spindle,
    mdh_robot,
    tool_trajectory,
    ur3,
    welding_torch,
)

ER3A_TABLE = Path(__file__).resolve().parent.parent / "data" / "robots" / "er3a_c60.csv"


def seam(points=30, centre=(310.0, 0.0, 60.0)):
    """Way points and normals (N, 3) of a gentle S on a rounded top, in the base frame."""
    y = np.linspace(-70.0, 70.0, points)
    slope = 0.003 * y
    positions = np.column_stack([8 * np.sin(y / 25), y, -0.0015 * y**2]) + np.asarray(centre)
    normals = np.column_stack([np.zeros(points), slope, np.ones(points)])
    return positions, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def s_trajectory(points=30, centre=(310.0, 0.0, 60.0)):
    return tool_trajectory(*seam(points, centre))


def ring(points=40, radius_mm=50.0, centre=(290.0, 20.0, 50.0)):
    """A closed seam round a circle on a flat top."""
    angle = np.linspace(0.0, 2 * np.pi, points, endpoint=False)
    positions = np.column_stack([radius_mm * np.cos(angle), radius_mm * np.sin(angle), 0 * angle]) + np.asarray(centre)
    return tool_trajectory(positions, np.tile([0.0, 0.0, 1.0], (points, 1)), ToolTrajectoryOptions(closed=True))


def welder():
    return ur3(welding_torch())


def grinder():
    return mdh_robot("ER3A-C60", read_arm(ER3A_TABLE), grinding_spindle(), ER3A_LIMITS)


def ur3_flange_mm(q):
    """T_controller_flange of a UR3 by the maker's (standard) DH table: the oracle, sharing nothing with the URDF."""
    d = (151.9, 0, 0, 112.35, 85.35, 81.9)
    a = (0, -243.65, -213.25, 0, 0, 0)
    alpha = (np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0)
    pose = np.eye(4)
    for q_i, d_i, a_i, alpha_i in zip(q, d, a, alpha, strict=True):
        c, s, ca, sa = np.cos(q_i), np.sin(q_i), np.cos(alpha_i), np.sin(alpha_i)
        pose = pose @ np.array(
            [[c, -s * ca, s * sa, a_i * c], [s, c * ca, -c * sa, a_i * s], [0, sa, ca, d_i], [0, 0, 0, 1]]
        )
    return pose


def distance(T_a, T_b):
    """Distance in mm and angle in deg between two poses."""
    turn = T_a[:3, :3].T @ T_b[:3, :3]
    sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]), np.degrees(np.arctan2(sine, (np.trace(turn) - 1) / 2))


def shifted(x_mm, y_mm, z_mm):
    return rigid(translation_mm=[x_mm, y_mm, z_mm])
