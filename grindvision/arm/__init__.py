"""The arm model: modified DH table or URDF, kinematics, Jacobians by joint and by parameter. No ground truth in it.

Pinocchio is loaded only by ``grindvision.arm.model``.
"""

from grindvision.arm.inverse import InverseSolution, nearest_angles
from grindvision.arm.jacobians import joint_twists, moved_by_twist, parameter_twists
from grindvision.arm.mdh import (
    PARAMETERS,
    MdhArm,
    check_angles,
    forward,
    joint_transforms,
    link_transforms,
    read_arm,
    write_arm,
)

__all__ = [
    "PARAMETERS",
    "InverseSolution",
    "MdhArm",
    "check_angles",
    "forward",
    "joint_transforms",
    "joint_twists",
    "link_transforms",
    "moved_by_twist",
    "nearest_angles",
    "parameter_twists",
    "read_arm",
    "write_arm",
]
