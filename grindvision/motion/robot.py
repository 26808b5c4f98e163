"""An arm with a tool in its hand, ready to follow a trajectory: Pinocchio model, limits and collision bodies, in mm."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm import MdhArm
from grindvision.arm.model import in_millimetres, pinocchio_model, urdf_model
from grindvision.arm.urdf import mesh_files, urdf_skeleton
from grindvision.data_files import data_folder
from grindvision.errors import FileError, InputError
from grindvision.extras import extra
from grindvision.geometry import check_rigid, rigid
from grindvision.motion.tool import Tool
from grindvision.records import by_content

with extra("robot"):
    import coal
    import pinocchio as pin

Floats = NDArray[np.float64]

#: Name of the frame at the tool's tip, added to every robot.
TOOL_FRAME = "tool"

#: Acceleration every joint is allowed, rad/s^2, where the robot file states none (URDF cannot): a gentle setting.
DEFAULT_ACCELERATION = 2.0


@by_content
@dataclass(frozen=True)
class JointLimits:
    """Limits of n joints: angles in rad, speed in rad/s, acceleration in rad/s^2, each (n,)."""

    lower_rad: Floats
    upper_rad: Floats
    speed_rad_s: Floats
    acceleration_rad_s2: Floats

    def __post_init__(self) -> None:
        for name in ("lower_rad", "upper_rad", "speed_rad_s", "acceleration_rad_s2"):
            object.__setattr__(self, name, np.atleast_1d(np.asarray(getattr(self, name), dtype=float)))
        if not (self.lower_rad < self.upper_rad).all():
            joint = int(np.argmin(self.lower_rad < self.upper_rad)) + 1
            raise InputError(f"joint {joint}: the lower limit is not below the upper one; give angles in rad")
        for name in ("speed_rad_s", "acceleration_rad_s2"):
            values = getattr(self, name)
            if not ((values > 0) & np.isfinite(values)).all():
                joint = int(np.argmin((values > 0) & np.isfinite(values))) + 1
                raise InputError(f"joint {joint}: {name} is {values[joint - 1]:.4g}; a positive number is needed")

    def __str__(self) -> str:
        ranges = ", ".join(f"{a:.0f}..{b:.0f}" for a, b in np.degrees(np.stack([self.lower_rad, self.upper_rad], 1)))
        return f"limits of {len(self.lower_rad)} joints: {ranges} deg"


#: Limits for the ER3A-C60, whose own are not published: angles of its successor ER3-600; 180 deg/s is an assumption.
ER3A_LIMITS = JointLimits(
    np.radians([-170, -135, -65, -190, -130, -360]),
    np.radians([170, 85, 185, 190, 130, 360]),
    np.full(6, np.pi),
    np.full(6, 2 * DEFAULT_ACCELERATION),
)


@by_content
@dataclass(frozen=True)
class Robot:
    """A serial arm of revolute joints that carries a tool.

    ``model`` has lengths in mm and a frame ``TOOL_FRAME`` at the tip; ``bodies`` are the collision shapes, in mm,
    with the pairs of the arm itself that can touch. ``T_controller_base`` leads from the model's base to the one the
    maker's controller counts from.
    """

    name: str
    model: pin.Model
    bodies: pin.GeometryModel
    tool: Tool
    limits: JointLimits
    T_controller_base: Floats

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, from the base."""
        return tuple(self.model.names)[1:]

    def forward(self, q_rad: ArrayLike) -> Floats:
        """Transforms T_base_tool (..., 4, 4) at joint angles (..., n)."""
        q = np.asarray(q_rad, dtype=float)
        if q.ndim == 0 or q.shape[-1] != self.model.nq:
            raise InputError(f"joint angles have shape {q.shape}; this arm needs (..., {self.model.nq})")
        data = self.model.createData()
        frame = self.model.getFrameId(TOOL_FRAME)
        poses = np.empty((*q.shape[:-1], 4, 4))
        for index in np.ndindex(q.shape[:-1]):
            pin.framesForwardKinematics(self.model, data, q[index])
            poses[index] = data.oMf[frame].homogeneous
        return poses

    def __str__(self) -> str:
        return f"{self.name}, {self.model.nq} joints, with {self.tool}"


def ur3(tool: Tool) -> Robot:
    """The UR3 of ``data/robots/ur3``, its base the URDF's ``base_link``."""
    return urdf_robot(data_folder() / "robots" / "ur3" / "ur3.urdf", tool, flange="tool0", controller="base")


def urdf_robot(
    path: str | Path,
    tool: Tool,
    *,
    flange: str,
    controller: str | None = None,
    package_folder: str | Path | None = None,
) -> Robot:
    """Robot from a URDF file with its collision meshes, each replaced by its convex hull.

    ``flange`` names the joint or link that carries the tool, ``controller`` the one the maker's controller counts from;
    ``package_folder`` is where ``package://`` paths start, by default the file's folder.

    Raises:
        FileError: the file or one of its meshes is missing; it is no URDF; it has no such joint or link; it is no
            single chain of revolute joints with limits.
    """
    metres = urdf_model(path)
    for role, frame in (("flange", flange), ("controller", controller)):
        if frame is not None and not metres.existFrame(frame):
            known = ", ".join(f.name for f in metres.frames if f.name != "universe")
            raise FileError(f"{path}: no joint or link named {frame} for the {role}; it has {known}")
    if metres.nq == 0 or metres.nq != metres.njoints - 1 or list(metres.parents)[1:] != list(range(metres.nq)):
        raise FileError(f"{path}: not a single chain of revolute joints with limits; remove grippers, wheels and loops")
    try:
        limits = JointLimits(
            metres.lowerPositionLimit,
            metres.upperPositionLimit,
            metres.velocityLimit,
            np.full(metres.nq, DEFAULT_ACCELERATION),
        )
    except InputError as error:
        raise FileError(f"{path}: {error}") from None
    folder = Path(path).parent if package_folder is None else Path(package_folder)
    for name in mesh_files(path):
        place = folder / name.removeprefix("package://").removeprefix("file://")
        if not place.resolve().is_relative_to(folder.resolve()):
            raise FileError(f"{path}: mesh {name} is not looked for outside {folder}; put the meshes beside the file")
    try:
        meshes = pin.buildGeomFromUrdfString(
            metres, urdf_skeleton(path), pin.GeometryType.COLLISION, package_dirs=str(folder)
        )
    except (ValueError, RuntimeError) as error:
        raise FileError(
            f"{path}: collision meshes not found under {folder} ({_line(error)}); put them there or give package_folder"
        ) from None
    model = in_millimetres(metres)
    bodies = pin.GeometryModel()
    for mesh in meshes.geometryObjects:
        if isinstance(mesh.geometry, coal.BVHModelBase):
            body = mesh.copy()
            body.name = mesh.name.removesuffix("_0")
            body.geometry = _hull_mm(mesh.geometry)
            body.placement = pin.SE3(mesh.placement.rotation, mesh.placement.translation * 1000.0)
            bodies.addGeometryObject(body)
    T_controller_base = np.eye(4)
    if controller is not None:
        data = model.createData()
        pin.framesForwardKinematics(model, data, pin.neutral(model))
        T_controller_base = data.oMf[model.getFrameId(controller)].inverse().homogeneous
    return _with_tool(metres.name, model, bodies, tool, limits, flange, T_controller_base)


def mdh_robot(
    name: str,
    arm: MdhArm,
    tool: Tool,
    limits: JointLimits,
    link_radius_mm: float = 50.0,
    *,
    T_last_flange: ArrayLike | None = None,
    T_controller_base: ArrayLike | None = None,
) -> Robot:
    """Robot from an MDH table, every link a capsule from joint to joint.

    The flange is the last joint's frame, or stands ``T_last_flange`` (4, 4) from it, where an axis points back into the
    arm; ``T_controller_base`` (4, 4) where the controller counts from another base.

    Raises:
        InputError: the limits are for another number of joints.
    """
    if len(limits.lower_rad) != arm.n:
        raise InputError(f"limits of {len(limits.lower_rad)} joints given; the arm has {arm.n}")
    model = pinocchio_model(arm)
    model.lowerPositionLimit, model.upperPositionLimit = limits.lower_rad, limits.upper_rad
    model.velocityLimit = limits.speed_rad_s
    bodies = pin.GeometryModel()
    for joint in range(1, model.njoints):
        link = model.jointPlacements[joint].translation
        if np.linalg.norm(link) > 1.0:
            body = f"link {joint - 1}" if joint > 1 else "base"
            bodies.addGeometryObject(_capsule(body, joint - 1, np.zeros(3), link, link_radius_mm))
    flange = arm.joints[-1]
    if T_last_flange is not None:
        flange, placement = "flange", pin.SE3(check_rigid(T_last_flange, "T_last_flange"))
        model.addFrame(pin.Frame(flange, arm.n, placement, pin.FrameType.OP_FRAME))
        if np.linalg.norm(placement.translation) > 1.0:
            bodies.addGeometryObject(_capsule("wrist", arm.n, np.zeros(3), placement.translation, link_radius_mm / 2))
    T_controller = np.eye(4) if T_controller_base is None else check_rigid(T_controller_base, "T_controller_base")
    return _with_tool(name, model, bodies, tool, limits, flange, T_controller)


def _with_tool(
    name: str,
    model: pin.Model,
    bodies: pin.GeometryModel,
    tool: Tool,
    limits: JointLimits,
    flange: str,
    T_controller_base: Floats,
) -> Robot:
    """Add the tool's frame and capsules, and the pairs of bodies that could touch."""
    frame = model.frames[model.getFrameId(flange)]
    hand = frame.parentJoint
    model.addFrame(pin.Frame(TOOL_FRAME, hand, frame.placement * pin.SE3(tool.T_flange_tool), pin.FrameType.OP_FRAME))
    for number, (start, end, radius_mm) in enumerate(tool.capsules, 1):
        start, end = (frame.placement.act(np.asarray(point, dtype=float)) for point in (start, end))
        bodies.addGeometryObject(_capsule(f"{tool.name} {number}", hand, start, end, radius_mm))
    for pair in _pairs_that_can_part(model, bodies):
        bodies.addCollisionPair(pair)
    return Robot(name, model, bodies, tool, limits, check_rigid(T_controller_base, "T_controller_base"))


def _pairs_that_can_part(model: pin.Model, bodies: pin.GeometryModel) -> list[pin.CollisionPair]:
    """Pairs two or more joints apart that do not overlap with all joints at zero; the others meet by design."""
    trial = bodies.copy()
    for i, first in enumerate(bodies.geometryObjects):
        for j, second in enumerate(bodies.geometryObjects):
            if second.parentJoint - first.parentJoint >= 2:
                trial.addCollisionPair(pin.CollisionPair(i, j))
    at_zero = trial.createData()
    pin.computeDistances(model, model.createData(), trial, at_zero, pin.neutral(model))
    return [
        pair
        for pair, result in zip(trial.collisionPairs, at_zero.distanceResults, strict=True)
        if result.min_distance > 0
    ]


def _capsule(name: str, joint: int, start: Floats, end: Floats, radius_mm: float) -> pin.GeometryObject:
    axis = end - start
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).matrix()
    placement = pin.SE3(rigid(turn, (start + end) / 2))
    return pin.GeometryObject(name, joint, placement, coal.Capsule(radius_mm, float(np.linalg.norm(axis))))


def _hull_mm(mesh: coal.BVHModelBase) -> coal.ConvexBase:
    corners = coal.StdVec_Vec3s()
    for corner in mesh.vertices() * 1000.0:
        corners.append(corner)
    return coal.Convex.convexHull(corners, False, "Qt")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
