"""The arm of an MDH table as a Pinocchio model, and models of URDF files in millimetres."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from grindvision.arm.mdh import MdhArm
from grindvision.arm.urdf import urdf_skeleton
from grindvision.errors import FileError
from grindvision.extras import extra

with extra("robot"):
    import pinocchio as pin


def pinocchio_model(arm: MdhArm) -> pin.Model:
    """Pinocchio model of an MDH arm: one z joint per row, its frame equal to the MDH joint frame, in mm.

    ``Rz(theta + q) Tz(d)`` commutes, so everything but the turn by q goes into the joint's placement.
    """
    model = pin.Model()
    parent = 0
    for name, (alpha, a, d, theta, beta), slides in zip(arm.joints, arm.table, arm.prismatic, strict=True):
        placement = (
            pin.SE3(pin.utils.rotate("x", alpha), np.array([a * 1.0, 0.0, 0.0]))
            * pin.SE3(pin.utils.rotate("y", beta), np.zeros(3))
        ) * pin.SE3(pin.utils.rotate("z", theta), np.array([0.0, 0.0, d]))
        parent = model.addJoint(parent, pin.JointModelPZ() if slides else pin.JointModelRZ(), placement, name)
        model.addJointFrame(parent)
    return model


def urdf_model(path: str | Path) -> pin.Model:
    """Pinocchio model of a URDF file's joints; lengths in metres, as URDF has them, and no masses.

    Raises:
        FileError: the file is missing, is no URDF, or is nested or sized as no robot description is.
    """
    skeleton = urdf_skeleton(path)
    try:
        return pin.buildModelFromXML(skeleton)
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
    raise FileError(f"{path}: not a readable URDF ({reason}); mend it") from None


def in_millimetres(model: pin.Model) -> pin.Model:
    """Copy of a model in metres (a URDF's) with every joint and frame placement in mm; masses are left as they are."""
    scaled = model.copy()
    for placements in (scaled.jointPlacements, (frame.placement for frame in scaled.frames)):
        for placement in placements:
            placement.translation = placement.translation * 1000.0
    return scaled
