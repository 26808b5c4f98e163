"""One chain of joints out of a URDF file, as a modified DH table, and back into the file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.arm.mdh import MdhArm, joint_transforms
from grindvision.arm.urdf import REVOLUTE, UrdfJoint, robot_element, table_of_lines, urdf_joints
from grindvision.errors import FileError
from grindvision.files import write_text
from grindvision.geometry import inverse, rigid
from grindvision.records import by_content

Floats = NDArray[np.float64]

PRISMATIC = "prismatic"


@by_content
@dataclass(frozen=True)
class UrdfChain:
    """Moving joints of a URDF file from a base link to a tip, as an ``arm`` in mm.

    ``T_base_table`` (4, 4) leads from the table's base to the base link: a translation, none where the first axis
    crosses the link's x. ``joints`` are the file's, ``T_base_joint`` (n, 4, 4) their frames at zero in mm,
    ``T_link_joint`` (n, 4, 4) those against the moving part before them, in mm, of the link that they hang on.
    """

    arm: MdhArm
    T_base_table: Floats
    joints: tuple[UrdfJoint, ...]
    T_base_joint: Floats
    T_before_parent: Floats

    def __str__(self) -> str:
        return f"{self.joints[0].parent} to {self.joints[-1].child}: {self.arm}"


def urdf_chain(
    path: str | Path, joints: int | None = None, base_link: str | None = None, tip_link: str | None = None
) -> UrdfChain:
    """The moving joints of a URDF file from ``base_link`` to ``tip_link``, or the first ``joints`` of them.

    Left out, the base is the root, and the tip the only end that so many joints lead to. Joints beside the chain stand
    at zero. Joint angles count as in the URDF, from the same zero. The last joint's frame keeps the joint's axis as z,
    but not the URDF's choice of x and origin, which a modified DH table cannot hold.

    Raises:
        FileError: no URDF; no such link; fewer joints; several chains of so many joints; a joint of another kind.
    """
    path = Path(path)
    found = urdf_joints(path)
    by_child = {joint.child: joint for joint in found}
    if not found:
        raise FileError(f"{path}: it has 0 joints; give the robot description of an arm")
    links = {joint.parent for joint in found} | set(by_child)
    for role, link in (("base", base_link), ("tip", tip_link)):
        if link is not None and link not in links:
            known = ", ".join(sorted(links)[:24])
            raise FileError(f"{path}: no link {link!r} for the {role}; it has {known}")
    base = base_link or next(joint.parent for joint in found if joint.parent not in by_child)
    chain = _chain_to(path, found, by_child, base, tip_link, joints)
    moving = [joint for joint in chain if joint.kind != "fixed"]
    count = len(moving) if joints is None else joints
    if not 0 < count <= len(moving):
        raise FileError(f"{path}: it has {len(moving)} joints, {count} are needed")
    odd = next((joint for joint in moving[:count] if joint.kind not in (*REVOLUTE, PRISMATIC)), None)
    if odd is not None:
        raise FileError(f"{path}: {odd}; only revolute and prismatic joints can be calibrated")
    T, before, frames, parents = np.eye(4), np.eye(4), [], []
    taken: list[UrdfJoint] = []
    for joint in chain:
        placement = joint.T_parent_joint.copy()
        placement[:3, 3] *= 1000.0
        if joint.kind != "fixed":
            if len(taken) == count:
                break
            taken.append(joint)
            frames.append(T @ placement)
            parents.append(before)
            before = np.eye(4)
        else:
            before = before @ placement
        T = T @ placement
    lines = [(frame[:3, :3] @ joint.axis, frame[:3, 3]) for joint, frame in zip(taken, frames, strict=True)]
    table, base_mm = table_of_lines(lines)
    arm = MdhArm(
        table,
        tuple(joint.name for joint in taken),
        tuple(joint.kind == PRISMATIC for joint in taken),
        _limits(path, taken),
    )
    return UrdfChain(arm, rigid(translation_mm=base_mm), tuple(taken), np.array(frames), np.array(parents))


def urdf_arm(path: str | Path, joints: int | None = None) -> MdhArm:
    """The arm of ``urdf_chain`` alone, for a file whose first axis crosses the root link's x.

    Raises:
        FileError: see ``urdf_chain``; a first axis that no table can place in the root's frame.
    """
    chain = urdf_chain(path, joints)
    if not np.allclose(chain.T_base_table, np.eye(4)):
        raise FileError(
            f"{path}: the first joint's axis does not cross the root link's x axis; rotate or move the root link, or"
            " give the modified DH table as CSV"
        )
    return chain.arm


def write_corrected_urdf(source: str | Path, chain: UrdfChain, arm: MdhArm, path: str | Path) -> None:
    """Write the URDF ``source`` with the origins of the chain's joints moved as ``arm`` says, all else as it was.

    Every joint keeps its axis and its place on the part behind it, so that limits, meshes and zero angles hold.
    """
    nominal = chain.T_base_table @ joint_transforms(chain.arm, np.zeros(arm.n))[1:]
    corrected = chain.T_base_table @ joint_transforms(arm, np.zeros(arm.n))[1:]
    robot = robot_element(Path(source))
    elements = {element.get("name"): element for element in robot.findall("joint")}
    before = np.eye(4)
    for number, joint in enumerate(chain.joints):
        frame = corrected[number] @ inverse(nominal[number]) @ chain.T_base_joint[number]
        placement = inverse(before @ chain.T_before_parent[number]) @ frame
        element = elements[joint.name]
        origin = element.find("origin")
        if origin is None:
            origin = ElementTree.Element("origin")
            element.insert(0, origin)
        origin.set("xyz", " ".join(repr(float(value)) for value in placement[:3, 3] / 1000.0))
        angles = Rotation.from_matrix(placement[:3, :3]).as_euler("xyz")
        origin.set("rpy", " ".join(repr(float(value)) for value in angles))
        before = frame
    text = ElementTree.tostring(robot, encoding="unicode")
    write_text(path, f'<?xml version="1.0"?>\n{text}\n')


def _chain_to(
    path: Path,
    found: list[UrdfJoint],
    by_child: dict[str, UrdfJoint],
    base: str,
    tip: str | None,
    count: int | None,
) -> list[UrdfJoint]:
    """Joints from the base link to the tip, fixed ones too."""

    def way(link: str) -> list[UrdfJoint] | None:
        joints: list[UrdfJoint] = []
        while link != base:
            if link not in by_child:
                return None
            joints.append(by_child[link])
            link = by_child[link].parent
        return joints[::-1]

    if tip is not None:
        chosen = way(tip)
        if chosen is None:
            raise FileError(f"{path}: link {tip!r} does not hang on {base!r}; name --base-link and --tip-link in order")
        return chosen
    parents = {joint.parent for joint in found}
    ends = [way(link) for link in by_child if link not in parents]
    chains = [chain for chain in ends if chain]
    moving = {id(chain): [joint for joint in chain if joint.kind != "fixed"] for chain in chains}
    wanted = max((len(joints) for joints in moving.values()), default=0) if count is None else count
    long_enough = [chain for chain in chains if len(moving[id(chain)]) >= wanted]
    if not long_enough:
        most = max((len(joints) for joints in moving.values()), default=0)
        raise FileError(f"{path}: it has {most} joints in a chain from {base}, {wanted} are needed")
    different = {tuple(joint.name for joint in moving[id(chain)][:wanted]): chain for chain in long_enough}
    exact = {names: chain for names, chain in different.items() if len(moving[id(chain)]) == wanted}
    if len(different) > 1 and len(exact) != 1:
        tips = ", ".join(sorted(chain[-1].child for chain in different.values())[:12])
        raise FileError(
            f"{path}: not a single chain of {wanted} joints: it branches to {tips}; say which with --tip-link (and"
            " --base-link)"
        )
    return next(iter((exact if len(different) > 1 else different).values()))


def _limits(path: Path, joints: list[UrdfJoint]) -> Floats | None:
    """Limits and speeds (n, 3) where every joint has them; a continuous joint turns once either way."""
    elements = {element.get("name"): element.find("limit") for element in robot_element(path).findall("joint")}
    rows = []
    for joint in joints:
        limit = elements[joint.name]
        values = {} if limit is None else limit.attrib
        try:
            speed = float(values.get("velocity", "nan"))
            low, high = float(values.get("lower", "nan")), float(values.get("upper", "nan"))
        except ValueError:
            return None
        if joint.kind == "continuous":
            low, high = -np.pi, np.pi
        if not (np.isfinite([low, high, speed]).all() and low < high and speed > 0):
            return None
        factor = 1000.0 if joint.kind == PRISMATIC else 1.0
        rows.append([factor * low, factor * high, factor * speed])
    return np.array(rows)
