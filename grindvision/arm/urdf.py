"""Robot files in URDF, judged before a parser sees them, and turned into a modified DH table.

Only the kinematics are read: no mesh that the file names is opened.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.parsers import expat

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.arm.mdh import MdhArm
from grindvision.errors import FileError

Floats = NDArray[np.float64]
Line = tuple[Floats, Floats]

LARGEST_URDF, DEEPEST = 20_000_000, 200

#: Axes whose directions differ by less (rad) are meant to be parallel, lines nearer than this (mm) meet.
PARALLEL_RAD, MEETING_MM = 0.02, 1e-6


def urdf_model(path: str | Path) -> pin.Model:
    """Pinocchio model of a URDF file; lengths in metres, as URDF has them.

    Raises:
        FileError: the file is missing, is no URDF, or is nested or sized as no robot description is.
    """
    path = Path(path)
    mesh_files(path)
    with _parser_silenced() as said:
        try:
            return pin.buildModelFromUrdf(str(path))
        except (ValueError, RuntimeError) as error:
            failure = error
    reason = next((line.split("Error:", 1)[1].strip() for line in said if "Error:" in line), str(failure))
    raise FileError(f"{path}: not a readable URDF ({' '.join(reason.split())[:200]}); mend it") from None


def mesh_files(path: str | Path) -> list[str]:
    """Names of the meshes that a URDF file mentions, as they stand in it.

    Raises:
        FileError: missing, no XML, or nested or sized as no robot description is.
    """
    path = Path(path)
    if not path.is_file():
        raise FileError(f"{path}: no such file; give the path of a URDF robot description")
    if path.stat().st_size > LARGEST_URDF:
        raise FileError(f"{path}: {path.stat().st_size} bytes; a URDF robot description is small, check the path")
    found: list[str] = []
    depth = 0

    def begin(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise FileError(f"{path}: elements nested {depth} deep; that is no robot description")
        if name == "mesh" and "filename" in attributes:
            found.append(attributes["filename"])

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def no_entities(*_: object) -> None:
        raise FileError(f"{path}: it defines XML entities; run it through xacro or write them out")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler, parser.EntityDeclHandler = begin, end, no_entities
    try:
        parser.Parse(path.read_bytes(), True)
    except expat.ExpatError as error:
        raise FileError(f"{path}: not a readable URDF ({error}); export it again") from None
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the file and its rights") from None
    return found


def urdf_arm(path: str | Path, joints: int | None = None) -> MdhArm:
    """The revolute joints of a URDF file, or the first ``joints`` of them, as a modified DH table in mm.

    Joint angles count as in the URDF, from the same zero, and the base is the URDF's root. The last joint's frame keeps
    the joint's axis as z, but not the URDF's choice of x and origin, which a modified DH table cannot hold.

    Raises:
        FileError: no URDF; fewer joints; no single chain of revolute joints; a first axis that no table can place in
            the root's frame.
    """
    model = urdf_model(path)
    count = model.njoints - 1 if joints is None else joints
    if not 0 < count < model.njoints:
        raise FileError(f"{path}: it has {model.njoints - 1} joints, {count} are needed")
    data = model.createData()
    jacobian = pin.computeJointJacobians(model, data, pin.neutral(model)).reshape(6, -1)
    revolute = all(joint.nv == 1 for joint in list(model.joints)[1 : count + 1])
    chain = list(model.parents)[1 : count + 1] == list(range(count))
    if not (revolute and chain and np.allclose(np.linalg.norm(jacobian[3:, :count], axis=0), 1.0)):
        raise FileError(
            f"{path}: not a single chain of {count} revolute joints; remove grippers, wheels and prismatic joints"
        )
    lines = [
        (axis, np.cross(axis, 1000.0 * moment))
        for moment, axis in zip(*np.split(jacobian.T[:count], 2, axis=1), strict=True)
    ]
    table = _table_of_lines(lines)
    if table is None:
        raise FileError(
            f"{path}: the first joint's axis does not cross the root link's x axis; rotate or move the root link, or"
            " give the modified DH table as CSV"
        )
    return MdhArm(table, tuple(list(model.names)[1 : count + 1]))


def _table_of_lines(lines: list[Line]) -> Floats | None:
    """Table (n, 5) of joints that rotate about lines (unit axis, point on it) of the base frame.

    Frame i has its z along line i. Its x leads to line i + 1: along the common normal, or, where both are nearly
    parallel, within the plane across z, and Hayati's tilt makes up the rest. None where line 1 does not cross the
    base's x.
    """
    rotation, origin = np.eye(3), np.zeros(3)
    foot = _crossing(lines[0], rotation[:, 1:])
    if foot is None:
        return None
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
    return np.array(rows)


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


@contextmanager
def _parser_silenced() -> Iterator[list[str]]:
    """What the C++ parser writes to the error stream inside the block, as lines; nothing of it is shown."""
    lines: list[str] = []
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            said.seek(0)
            lines += said.read().decode(errors="replace").splitlines()
