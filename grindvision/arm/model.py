"""The arm as a Pinocchio model, from an MDH table or from a URDF file; lengths in millimetres for MDH arms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

from grindvision.arm.mdh import MdhArm
from grindvision.errors import FileError


def pinocchio_model(arm: MdhArm) -> pin.Model:
    """Pinocchio model of an MDH arm: one revolute z joint per row, its frame equal to the MDH joint frame, in mm.

    ``Rz(theta + q) Tz(d)`` commutes, so everything but the turn by q goes into the joint's placement.
    """
    model = pin.Model()
    parent = 0
    for name, (alpha, a, d, theta, beta) in zip(arm.joints, arm.table, strict=True):
        placement = (
            pin.SE3(pin.utils.rotate("x", alpha), np.array([a * 1.0, 0.0, 0.0]))
            * pin.SE3(pin.utils.rotate("y", beta), np.zeros(3))
        ) * pin.SE3(pin.utils.rotate("z", theta), np.array([0.0, 0.0, d]))
        parent = model.addJoint(parent, pin.JointModelRZ(), placement, name)
        model.addJointFrame(parent)
    return model


def urdf_model(path: str | Path) -> pin.Model:
    """Pinocchio model of a URDF file; lengths in metres, as URDF has them.

    Raises:
        FileError: the file is missing or is no URDF.
    """
    path = Path(path)
    if not path.is_file():
        raise FileError(f"{path}: no such file; give the path of a URDF robot description")
    try:
        return pin.buildModelFromUrdf(str(path))
    except (ValueError, RuntimeError) as error:
        raise FileError(f"{path}: not a readable URDF ({' '.join(str(error).split())[:200]})") from None


def in_millimetres(model: pin.Model) -> pin.Model:
    """Copy of a model in metres (a URDF's) with every joint and frame placement in mm; masses are left as they are."""
    scaled = model.copy()
    for placements in (scaled.jointPlacements, (frame.placement for frame in scaled.frames)):
        for placement in placements:
            placement.translation = placement.translation * 1000.0
    return scaled
