"""Robots by name or from their files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from grindvision.arm import read_arm
from grindvision.arm.mdh import LIMITS
from grindvision.data_files import data_folder
from grindvision.errors import InputError
from grindvision.files import read_table
from grindvision.motion.known import KnownRobot, known_robots
from grindvision.motion.robot import DEFAULT_ACCELERATION, JointLimits, Robot, mdh_robot, ur3, urdf_robot
from grindvision.motion.tool import Tool, welding_torch

#: The link of a URDF that carries the tool, where nothing else is said: ROS-Industrial's name for it.
FLANGE = "tool0"

#: Arms that come with the package.
ROBOTS = {"ur3": ur3}


@dataclass(frozen=True)
class LoadRobotOptions:
    """Settings of ``load_robot``.

    ``tool`` on the flange. ``flange`` names the link of a URDF that carries it (left out: ``tool0``).
    ``link_radius_mm``: thickness of the capsules that stand for the links of an arm from a table.
    """

    tool: Tool = field(default_factory=welding_torch)
    flange: str | None = None
    link_radius_mm: float = 60.0


def load_robot(source: str | Path, options: LoadRobotOptions | None = None) -> Robot:
    """An arm with its tool, ready for ``plan_motion``.

    Args:
        source: a name that ``grindvision robots`` lists; a URDF file with its collision meshes beside it; or a modified
            DH table (CSV, see ``read_arm``) with joint limits in further columns ``lower_rad``, ``upper_rad``,
            ``speed_rad_s``.
        options: the tool, the flange of a URDF, the thickness of a table's links.

    Returns:
        The arm of n joints; lengths in mm, angles in rad, ``forward`` gives ``T_base_tool`` (4, 4).

    Raises:
        FileError: the file cannot be used. InputError: a flange for an arm that is no URDF; limits that are none.

    Example:
        >>> from grindvision import load_robot
        >>> robot = load_robot("ur3")
        >>> robot.forward([0, -1.2, 1.5, -1.9, -1.57, 0]).shape
        (4, 4)
    """
    options = LoadRobotOptions() if options is None else options
    known = None if str(source) in ROBOTS else known_robots().get(str(source))
    if str(source) in ROBOTS or known is not None:
        if options.flange is not None:
            raise InputError(f"--flange is for a URDF file; the flange of {source} is known")
        return ROBOTS[str(source)](options.tool) if known is None else _from_table(known, options)
    if Path(source).suffix.lower() != ".csv":
        return urdf_robot(source, options.tool, flange=options.flange or FLANGE)
    if options.flange is not None:
        raise InputError("--flange is for a URDF file; a table ends at its last joint")
    arm = read_arm(source)
    return mdh_robot(Path(source).stem, arm, options.tool, _limits(source), options.link_radius_mm)


def _from_table(known: KnownRobot, options: LoadRobotOptions) -> Robot:
    return mdh_robot(
        known.name,
        known.arm,
        options.tool,
        _limits(data_folder() / "robots" / known.table),
        options.link_radius_mm,
        T_last_flange=known.T_last_flange,
        T_controller_base=known.T_controller_base,
    )


def _limits(source: str | Path) -> JointLimits:
    table = read_table(source, LIMITS)
    lower, upper, speed = (table[name].to_numpy() for name in LIMITS)
    try:
        return JointLimits(lower, upper, speed, 0 * speed + DEFAULT_ACCELERATION)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
