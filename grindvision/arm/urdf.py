"""Robot files in URDF: judged before any parser of a library sees them, and turned into a modified DH table.

Only the kinematics are read: no mesh that the file names is opened.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.errors import FileError
from grindvision.geometry import rigid
from grindvision.input_files import read_input
from grindvision.records import by_content

Floats = NDArray[np.float64]
Line = tuple[Floats, Floats]

LARGEST_URDF, DEEPEST = 20_000_000, 200

#: Axes whose directions differ by less (rad) are meant to be parallel, lines nearer than this (mm) meet.
PARALLEL_RAD, MEETING_MM = 0.02, 1e-6

#: Numbers beyond this (m, rad, and their rates) belong to no robot.
LARGEST_NUMBER = 1e6

REVOLUTE = ("revolute", "continuous")
KINDS = (*REVOLUTE, "prismatic", "fixed", "floating", "planar")
ROLES = ("parent", "child")


@by_content
@dataclass(frozen=True)
class UrdfJoint:
    """One joint of a URDF file: ``T_parent_joint`` (4, 4) at angle zero, in m; unit ``axis`` (3,) in its own frame."""

    name: str
    kind: str
    parent: str
    child: str
    T_parent_joint: Floats
    axis: Floats

    def __str__(self) -> str:
        return f"{self.kind} joint {self.name} from {self.parent} to {self.child}"


def mesh_files(path: str | Path) -> list[str]:
    """Names of the meshes that a URDF file mentions, as they stand in it.

    Raises:
        FileError: missing, no XML, or nested or sized as no robot description is.
    """
    return [mesh.attrib["filename"] for mesh in robot_element(Path(path)).iter("mesh") if "filename" in mesh.attrib]


def urdf_joints(path: str | Path) -> list[UrdfJoint]:
    """Every joint of a URDF file, in file order; its links form one tree.

    Raises:
        FileError: missing, no URDF, or nested or sized as no robot description is; a joint names a link that is not
            there; no single root link; a number that is none.
    """
    path = Path(path)
    return _joints(path, robot_element(path))


def urdf_skeleton(path: str | Path) -> str:
    """A URDF file's joints and collision meshes as URDF text, without all that is not needed to move the arm.

    Raises:
        FileError: as ``urdf_joints``; a joint that needs limits has none.
    """
    path = Path(path)
    robot = robot_element(path)
    _joints(path, robot)
    skeleton = ElementTree.Element("robot", name=robot.get("name", path.stem))
    for link in robot.findall("link"):
        kept = ElementTree.SubElement(skeleton, "link", name=link.attrib["name"])
        for collision in link.findall("collision"):
            mesh = collision.find("geometry/mesh")
            if mesh is not None and "filename" in mesh.attrib:
                _numbers(path, mesh, "scale", (1, 1, 1))
                body = ElementTree.SubElement(kept, "collision")
                body.extend(_origin_of(path, collision))
                ElementTree.SubElement(body, "geometry").append(mesh)
    for joint in robot.findall("joint"):
        kept = ElementTree.SubElement(skeleton, "joint", name=joint.attrib["name"], type=joint.attrib["type"])
        kept.extend(_origin_of(path, joint))
        kept.extend(part for part in joint if part.tag in ("parent", "child", "axis"))
        limit = joint.find("limit")
        if joint.attrib["type"] in ("revolute", "prismatic"):
            needed = ("lower", "upper", "effort", "velocity")
            missing = [name for name in needed if limit is None or name not in limit.attrib]
            if missing:
                raise FileError(f"{path}: joint {joint.attrib['name']} has no limit {missing[0]}; add it")
        if limit is not None:
            kept.append(ElementTree.Element("limit", {key: str(_number(path, limit, key)) for key in limit.attrib}))
    return ElementTree.tostring(skeleton, encoding="unicode")


def robot_element(path: Path) -> ElementTree.Element:
    """Root element of a URDF file that is sized and nested as a robot description is, and defines no entities."""
    content = read_input(path, LARGEST_URDF, "URDF")
    depth = 0

    def begin(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise FileError(f"{path}: elements nested {depth} deep; that is no robot description")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def no_entities(*_: object) -> None:
        raise FileError(f"{path}: it defines XML entities; run it through xacro or write them out")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler, parser.EntityDeclHandler = begin, end, no_entities
    try:
        parser.Parse(content, True)
        robot = ElementTree.fromstring(content)
    except (expat.ExpatError, ElementTree.ParseError, ValueError, LookupError) as error:
        raise FileError(f"{path}: not a readable URDF ({error}); export it again") from None
    if robot.tag != "robot":
        raise FileError(f"{path}: not a readable URDF (its root is {robot.tag[:80]!r}, not 'robot'); export it again")
    return robot


def _joints(path: Path, robot: ElementTree.Element) -> list[UrdfJoint]:
    links = _names(path, robot, "link")
    _names(path, robot, "joint")
    joints = []
    for element in robot.findall("joint"):
        name, kind = element.attrib["name"], element.get("type", "")
        places = [element.find(role) for role in ROLES]
        ends = ["" if place is None else place.get("link", "") for place in places]
        unknown = [end for end in ends if end not in links]
        if kind not in KINDS or unknown:
            what = f"type {kind!r}" if kind not in KINDS else f"link {unknown[0]!r}"
            raise FileError(f"{path}: not a readable URDF (joint {name} has an unknown {what}); mend it")
        axis = np.array(_numbers(path, element.find("axis"), "xyz", (1, 0, 0)))
        if not np.linalg.norm(axis) > 1e-6:
            raise FileError(f"{path}: joint {name} has an axis of length zero; mend it")
        origin = element.find("origin")
        rotation = Rotation.from_euler("xyz", _numbers(path, origin, "rpy", (0, 0, 0))).as_matrix()
        T_parent_joint = rigid(rotation, np.array(_numbers(path, origin, "xyz", (0, 0, 0))))
        joints.append(UrdfJoint(name, kind, ends[0], ends[1], T_parent_joint, axis / np.linalg.norm(axis)))
    children = [joint.child for joint in joints]
    twice = next((link for link in links if children.count(link) > 1), None)
    if twice is not None:
        raise FileError(f"{path}: not a readable URDF (link {twice} hangs on two joints); mend it")
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        what = f"Two root links: {roots[0]} and {roots[1]}" if roots else "no root link"
        raise FileError(f"{path}: not a readable URDF ({what}); mend it")
    return joints


def _names(path: Path, robot: ElementTree.Element, kind: str) -> dict[str, None]:
    """Names of all elements of a kind, in file order."""
    names = [element.get("name", "") for element in robot.findall(kind)]
    odd = next((name for i, name in enumerate(names) if not name or name in names[:i]), None)
    if odd is not None:
        raise FileError(
            f"{path}: not a readable URDF (a {kind} has {odd!r} for a name, which is empty or taken); mend it"
        )
    return dict.fromkeys(names)


def _origin_of(path: Path, element: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """The element's origin, where it has one, with numbers that are some."""
    origin = element.find("origin")
    if origin is not None:
        for key in ("xyz", "rpy"):
            _numbers(path, origin, key, (0, 0, 0))
        yield origin


def _numbers(
    path: Path, element: ElementTree.Element | None, key: str, default: tuple[float, float, float]
) -> tuple[float, ...]:
    """Three numbers of an attribute, or the default where it is not there."""
    text = None if element is None else element.get(key)
    if element is None or text is None:
        return default
    words = text.split()
    if len(words) != 3:
        raise FileError(f"{path}: {element.tag} {key} is {text[:80]!r}; three numbers are needed")
    return tuple(_finite(path, element, key, word) for word in words)


def _number(path: Path, element: ElementTree.Element, key: str) -> float:
    return _finite(path, element, key, element.attrib[key])


def _finite(path: Path, element: ElementTree.Element, key: str, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST_NUMBER:
        raise FileError(f"{path}: {element.tag} {key} holds {word[:80]!r}; a number within 1e6 is needed")
    return value


def table_of_lines(lines: list[Line]) -> tuple[Floats, Floats]:
    """Table (n, 5) of joints that rotate about lines (unit axis, point on it) of a frame, and where its base stands.

    Frame i has its z along line i. Its x leads to line i + 1: along the common normal, or, where both are nearly
    parallel, within the plane across z, and Hayati's tilt makes up the rest. The base is moved, without rotation, as
    little as line 1 needs to cross its x: the translation (3,), zero where line 1 crosses it already.
    """
    rotation, base = np.eye(3), np.zeros(3)
    first_axis, first_point = lines[0]
    foot = _crossing(lines[0], rotation[:, 1:])
    if foot is None:
        upright = abs(first_axis[2]) > PARALLEL_RAD
        along = first_point[2] / first_axis[2] if upright else first_point @ first_axis
        base = first_point - along * first_axis
        foot = base
    origin = base
    rows = []
    for (axis, _), following in zip(lines, [*lines[1:], None], strict=True):
        across, up, forward = rotation.T @ axis
        alpha, beta = np.arctan2(-up, forward), np.arcsin(np.clip(across, -1, 1))
        a = (foot - origin) @ rotation[:, 0]
        tilted = rotation @ Rotation.from_euler("XY", [alpha, beta]).as_matrix()
        leaving, x, next_foot = foot, tilted[:, 0], foot
        if following is not None:
            leaving, x, next_foot = _way_to((axis, foot), following, x)
        theta = np.arctan2(np.cross(tilted[:, 0], x) @ axis, tilted[:, 0] @ x)
        rows.append([alpha, a, (leaving - foot) @ axis, theta, beta])
        rotation, origin, foot = np.column_stack([x, np.cross(axis, x), axis]), leaving, next_foot
    return np.array(rows), base


def _way_to(line: Line, other: Line, x: Floats) -> tuple[Floats, Floats, Floats]:
    """Where x leaves a line for another, its direction, and where it arrives; ``x`` itself where they meet there."""
    (axis, point), (other_axis, other_point) = line, other
    cross = np.cross(axis, other_axis)
    if np.linalg.norm(cross) > PARALLEL_RAD:
        sides = np.column_stack([axis, -other_axis, cross])
        along, other_along, _ = np.linalg.solve(sides, other_point - point)
        return point + along * axis, cross / np.linalg.norm(cross), other_point + other_along * other_axis
    arrival = other_point + other_axis * ((point - other_point) @ axis) / (other_axis @ axis)
    length = float(np.linalg.norm(arrival - point))
    return point, (arrival - point) / length if length > MEETING_MM else x, arrival


def _crossing(line: Line, sides: Floats) -> Floats | None:
    """Point of a line where its coordinates along both ``sides`` (3, 2) are zero; None where there is none."""
    axis, point = line
    slope, offset = sides.T @ axis, sides.T @ point
    if np.linalg.norm(slope) < PARALLEL_RAD:
        return None
    crossing = point - axis * (offset @ slope) / (slope @ slope)
    return crossing if np.linalg.norm(sides.T @ crossing) < MEETING_MM else None
