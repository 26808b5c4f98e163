"""Where the camera stood, by the controller's pose and hand_eye.json: what hand-eye, merge, detect and groove share."""

from __future__ import annotations

import argparse
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from grindvision.cli.parameters import number
from grindvision.errors import FileError, GrindvisionWarning, InputError, UnitError
from grindvision.records import by_content

if TYPE_CHECKING:
    import numpy as np

    from grindvision.calibration.pose_conventions import PoseConvention
    from grindvision.motion import Robot

#: A flange that is nearer to the robot's base in every pose than this (mm) is given in metres.
NEAREST_FLANGE_MM = 20.0

#: Whose base a scanner's pose counts from: the robot model's root, or the controller's, in which it shows its poses.
BASES = ("model", "controller")

#: Key of hand_eye.json that says, in words, what of the camera is known too poorly.
DOUBT = "poorly_known"


@by_content
@dataclass(frozen=True)
class Camera:
    """A calibrated camera: ``T_parent_camera`` (4, 4), ``mounted`` ``on-arm`` (parent: flange) or ``fixed`` (base), and
    the ``convention`` of the controller's poses in its calibration."""

    T_parent_camera: np.ndarray
    mounted: str
    convention: PoseConvention | None

    def poses(self, T_base_flange: np.ndarray) -> np.ndarray:
        """T_base_camera (N, 4, 4) of a camera on the arm; T_flange_camera of a fixed one, whose part the arm turns."""
        import numpy as np

        from grindvision.geometry import inverse

        carrier = T_base_flange if self.mounted == "on-arm" else inverse(T_base_flange)
        return np.asarray(carrier @ self.T_parent_camera)


def add_convention_arguments(group: argparse._ArgumentGroup, more: str = "") -> None:
    """``--rotation`` and its kin; ``more`` says what happens where it is left out."""
    group.add_argument("--rotation", metavar="NAME", help=f"maker or notation of the rotation, see below{more}")
    group.add_argument("--angles", choices=("deg", "rad"), help="unit of Euler angles (default: the maker's)")
    group.add_argument("--pose-unit", choices=("mm", "m"), help="unit of the positions (default mm)")
    group.add_argument("--rotation-first", action="store_true", help="the rotation stands before the position")
    group.add_argument("--inverse-poses", action="store_true", help="the poses are T_flange_base")


def add_camera_arguments(parser: argparse.ArgumentParser, what: str) -> None:
    """``--hand-eye`` and ``--robot-pose``, in the place of ``--scanner-pose``, and how the pose is written."""
    group = parser.add_argument_group("scanner's pose from the controller's", "in the place of --scanner-pose")
    group.add_argument(
        "--hand-eye",
        metavar="FILE.json",
        help="hand_eye.json of `grindvision hand-eye`: with --robot-pose it tells where the scanner stood for"
        f" {what}; a fixed camera needs no pose",
    )
    group.add_argument(
        "--robot-pose",
        type=number,
        nargs="+",
        metavar="NUMBER",
        help="the controller's pose at the scan: position and rotation, written as --rotation says (default: as in the"
        " calibration)",
    )
    add_convention_arguments(group, " of `grindvision hand-eye --help` (default: as in the calibration)")


def stated_convention(options: argparse.Namespace, known: PoseConvention | None = None) -> PoseConvention | None:
    """The convention that the options state; without ``--rotation`` the one that is ``known``.

    Raises:
        InputError: unknown name, or parts of a convention without ``--rotation`` where one is known.
    """
    from grindvision.calibration.pose_conventions import convention

    if options.rotation is None:
        parts = [options.angles, options.pose_unit, options.rotation_first or None, options.inverse_poses or None]
        if known is not None and any(part is not None for part in parts):
            raise InputError(f"say --rotation too; left out, all is as in the calibration: {known}")
        return known
    flags = {"rotation_first": options.rotation_first, "inverted": options.inverse_poses}
    return convention(options.rotation, options.angles, options.pose_unit or "mm", **flags)


def camera_content(T_parent_camera: np.ndarray, mounted: str, stated: PoseConvention | None) -> dict[str, Any]:
    """What hand_eye.json says of a camera, as ``read_camera`` reads it."""
    from dataclasses import asdict

    parent = "flange" if mounted == "on-arm" else "base"
    content: dict[str, Any] = {f"T_{parent}_camera": T_parent_camera, "mounted": mounted}
    if stated is not None:
        content |= {"convention": str(stated), "pose_convention": asdict(stated)}
    return content


def read_camera(path: str | Path) -> Camera:
    """The camera of a hand_eye.json; what it says of the camera's being poorly known is a warning.

    Raises:
        FileError: missing, no JSON, no such keys; of another tool. NotRigidError: no rigid transform.
    """
    from grindvision.calibration.pose_conventions import PoseConvention
    from grindvision.files import read_json
    from grindvision.geometry import check_rigid

    content = read_json(path)
    known = content if isinstance(content, dict) else {}
    key = next((name for name in ("T_flange_camera", "T_base_camera") if name in known), None)
    if key is None:
        joint = (
            "; it is one of `calibrate`, whose scanner need not sit on the flange" if "T_joint_scanner" in known else ""
        )
        raise FileError(f"{path}: no T_flange_camera and no T_base_camera{joint}; give hand_eye.json of `hand-eye`")
    pose = check_rigid(known[key], f"{path}: {key}", tolerance=1e-3)
    stated = known.get("pose_convention")
    try:
        convention = None if stated is None else PoseConvention(**stated)
    except TypeError:
        raise FileError(f"{path}: pose_convention is damaged; run `grindvision hand-eye` again") from None
    if known.get(DOUBT):
        warnings.warn(f"{path}: {known[DOUBT]}", GrindvisionWarning, stacklevel=2)
    return Camera(pose, "on-arm" if key == "T_flange_camera" else "fixed", convention)


def flange_poses(rows: np.ndarray, stated: PoseConvention, name: str) -> np.ndarray:
    """T_base_flange (N, 4, 4), mm, of rows of numbers.

    Raises:
        InputError: see ``poses_from``. UnitError: metres, by their size.
    """
    import numpy as np

    from grindvision.calibration.pose_conventions import poses_from

    poses = poses_from(rows, stated, name)
    farthest = float(np.linalg.norm(poses[:, :3, 3], axis=1).max())
    if farthest < NEAREST_FLANGE_MM:
        raise UnitError(
            f"{name}: the flange is {farthest:.3g} mm from the robot's base, where no flange is: metres? Say"
            " --pose-unit m"
        )
    return poses


def scanner_pose(options: argparse.Namespace) -> np.ndarray | None:
    """T_base_scanner (4, 4) of ``--scanner-pose``, or of ``--hand-eye`` with ``--robot-pose``; None: not given.

    Raises:
        InputError: options that exclude or need each other; a pose of other numbers than its convention's.
    """
    from grindvision.cli.scans import read_pose

    file, numbers = getattr(options, "hand_eye", None), getattr(options, "robot_pose", None)
    if file is None:
        if numbers is not None:
            raise InputError("--robot-pose needs --hand-eye: where the camera sits on the flange")
        return None if options.scanner_pose is None else read_pose(options.scanner_pose)
    if options.scanner_pose is not None:
        raise InputError("--scanner-pose and --hand-eye both say where the scanner stood; leave one out")
    import numpy as np

    from grindvision.calibration.pose_conventions import COUNTS

    camera = read_camera(file)
    if camera.mounted == "fixed":
        if numbers is not None:
            raise InputError(
                f"{file}: the camera is fixed beside the arm, and no pose moves it; leave --robot-pose out"
            )
        return camera.T_parent_camera
    if numbers is None:
        raise InputError(f"{file}: the camera sits on the flange; give --robot-pose, the controller's pose at the scan")
    if len(numbers) not in COUNTS:
        raise InputError(f"--robot-pose has {len(numbers)} numbers; give 6, 7 (with a quaternion), 12 or 16 (a matrix)")
    stated = stated_convention(options, camera.convention)
    if stated is None:
        raise InputError("--robot-pose: say --rotation, how its rotation is written")
    return np.asarray(camera.poses(flange_poses(np.array([numbers]), stated, "--robot-pose"))[0])


def add_base_argument(group: argparse._ArgumentGroup) -> None:
    """``--base``: whose base the scanner's pose counts from."""
    group.add_argument(
        "--base",
        choices=BASES,
        help="base that --scanner-pose and --table-top count from: model, the root of the robot's model in the arm's"
        " foot, or controller, in which the controller shows its poses: half a turn about z from it for UR, 330 or 450"
        ' mm higher for FANUC and Yaskawa; the pose\'s file may say it, "base": "model". --hand-eye is in the'
        " controller's",
    )


def of_the_model(options: argparse.Namespace, robot: Robot, T_base_scanner: np.ndarray) -> tuple[np.ndarray, float]:
    """The scanner's pose (4, 4) and the height of the table, mm, in the base of the robot's model.

    Raises:
        InputError: nothing says whose base the pose counts from, where they differ; ``--base model`` with the
            controller's own poses.
    """
    import numpy as np

    from grindvision.geometry import inverse

    height = options.table_top or 0.0
    if np.array_equal(robot.T_controller_base, np.eye(4)):
        return T_base_scanner, height
    by_hand_eye = getattr(options, "hand_eye", None) is not None
    if by_hand_eye and options.base == "model":
        raise InputError("--hand-eye is in the base in which the controller shows its poses; leave --base out")
    base = "controller" if by_hand_eye else options.base or _stated_base(options.scanner_pose)
    if base is None:
        raise InputError(
            f"{robot.name}: its controller shows poses in another base than that of its model; say which of the two"
            " --scanner-pose counts from: --base controller, or --base model"
        )
    if base == "model":
        return T_base_scanner, height
    T_model_controller = inverse(robot.T_controller_base)
    if options.table_top is not None:
        height += float(T_model_controller[2, 3])
    return np.asarray(T_model_controller @ T_base_scanner), height


def _stated_base(path: str) -> str | None:
    """Whose base the file of a scanner's pose says it counts from.

    Raises:
        FileError: it says a base that is none of ``BASES``.
    """
    from grindvision.files import read_json

    content = read_json(path)
    stated = content.get("base") if isinstance(content, dict) else None
    if stated is not None and stated not in BASES:
        raise FileError(f"{path}: base {str(stated)[:40]!r} is unknown; give one of {', '.join(BASES)}")
    return stated


class Job(Protocol):
    """A robot, and the scanner's pose (4, 4) in the base of its model."""

    @property
    def robot(self) -> Robot:
        """The arm."""

    @property
    def T_base_scanner(self) -> np.ndarray:
        """The scanner's pose."""


def where_it_stood(T_base_scanner: np.ndarray | None, job: Job | None = None) -> list[str]:
    """The question where the scanner stood, so that an inverse or another base given by mistake can be seen: its pose
    (4, 4) in words, of a ``job`` whose controller counts from another base than its robot's model in both; none
    without a pose."""
    import numpy as np

    pose = T_base_scanner if job is None else job.T_base_scanner
    if pose is None:
        return []
    x, y, z, a, b, c = *pose[:3, 3], *pose[:3, 2]
    shown = ""
    if job is not None and not np.array_equal(job.robot.T_controller_base, np.eye(4)):
        u, v, w = (job.robot.T_controller_base @ pose)[:3, 3]
        shown = (
            f" of the robot's model, at ({u:.0f}, {v:.0f}, {w:.0f}) mm in the one in which its controller shows poses"
        )
    return [
        f"scanner at ({x:.0f}, {y:.0f}, {z:.0f}) mm in the base frame{shown}, its z axis along ({a:.2f}, {b:.2f},"
        f" {c:.2f}): is that where it stood?"
    ]
