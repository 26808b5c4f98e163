"""Robots by name or from their files."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from grindvision.arm import MdhArm, read_arm
from grindvision.arm.mdh import LIMITS
from grindvision.data_files import data_folder
from grindvision.errors import InputError
from grindvision.files import read_table
from grindvision.motion.robot import DEFAULT_ACCELERATION, JointLimits, Robot, mdh_robot, ur3, urdf_robot
from grindvision.motion.tool import Tool, welding_torch

#: The link of a URDF that carries the tool, where nothing else is said: ROS-Industrial's name for it.
FLANGE = "tool0"

#: Arms that come with the package.
ROBOTS = {"ur3": ur3}


@dataclass(frozen=True)
class KnownRobot:
    """An arm whose table comes with the package: its maker's ``language``, and where its numbers are from.

    ``T_last_flange`` and ``T_controller_base`` are rows of 4x4 matrices, mm.
    """

    name: str
    maker: str
    model: str
    table: str
    language: str
    T_last_flange: tuple[tuple[float, ...], ...]
    T_controller_base: tuple[tuple[float, ...], ...]
    source: str

    @property
    def reach_mm(self) -> float:
        """Lengths of all links from axis 2 to the flange, mm: a bound of the reach, not the maker's figure."""
        table = self.arm.table
        links = float(np.hypot(table[2:, 1], table[2:, 2]).sum())
        return links + float(np.linalg.norm(np.array(self.T_last_flange)[:3, 3]))

    @property
    def arm(self) -> MdhArm:
        """The arm of its table."""
        return read_arm(data_folder() / "robots" / self.table)

    def __str__(self) -> str:
        return f"{self.name}: {self.maker} {self.model}, --program {self.language}"


@cache
def known_robots() -> dict[str, KnownRobot]:
    """The arms of ``data/robots/robots.json`` by name, beside ``ur3``, which has a URDF with meshes."""
    rows = json.loads((data_folder() / "robots" / "robots.json").read_text(encoding="utf-8"))
    matrices = ("T_last_flange", "T_controller_base")
    return {
        row["name"]: KnownRobot(**{**row, **{key: tuple(map(tuple, row[key])) for key in matrices}}) for row in rows
    }


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
