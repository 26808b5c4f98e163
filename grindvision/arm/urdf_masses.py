"""Masses of a URDF's links, as point masses on the joints of a chain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from grindvision.arm.mdh import joint_transforms
from grindvision.arm.urdf import LARGEST_NUMBER, robot_element, urdf_joints
from grindvision.arm.urdf_chain import UrdfChain
from grindvision.geometry import inverse, move_points

Floats = NDArray[np.float64]


def link_masses(path: str | Path, chain: UrdfChain) -> tuple[Floats, Floats] | None:
    """Masses (n,) in kg that move with each joint of a chain, and their centres (n, 3) in mm in the table's frames.

    What hangs on a link by fixed joints, and by moving joints beside or behind the chain at zero, counts with it. None
    where a joint of the chain carries no mass, as in descriptions of the kinematics alone.

    Raises:
        FileError: no URDF.
    """
    joints = urdf_joints(path)
    by_child = {joint.child: joint for joint in joints}
    number = {joint.name: index for index, joint in enumerate(chain.joints)}
    places = dict(zip(number, chain.T_base_joint, strict=True))
    masses, moments = np.zeros(len(number)), np.zeros((len(number), 3))
    for link in robot_element(Path(path)).findall("link"):
        inertial = link.find("inertial")
        mass_element = None if inertial is None else inertial.find("mass")
        if inertial is None or mass_element is None:
            continue
        origin = inertial.find("origin")
        try:
            mass = float(mass_element.get("value", "0"))
            centre = np.array((origin.get("xyz", "0 0 0") if origin is not None else "0 0 0").split(), dtype=float)
        except ValueError:
            return None
        if centre.shape != (3,) or not 0 <= mass < LARGEST_NUMBER or not (np.abs(centre) < LARGEST_NUMBER).all():
            return None
        centre, name = 1000.0 * centre, link.get("name", "")
        while name in by_child and by_child[name].name not in number:
            placement = by_child[name].T_parent_joint.copy()
            placement[:3, 3] *= 1000.0
            centre, name = move_points(placement, centre[None])[0], by_child[name].parent
        if name in by_child:
            joint = by_child[name].name
            masses[number[joint]] += mass
            moments[number[joint]] += mass * move_points(places[joint], centre[None])[0]
    if not (masses > 0).all():
        return None
    frames = chain.T_base_table @ joint_transforms(chain.arm, np.zeros(chain.arm.n))[1:]
    centres = [
        move_points(inverse(frame), at[None])[0] for frame, at in zip(frames, moments / masses[:, None], strict=True)
    ]
    return masses, np.array(centres)
