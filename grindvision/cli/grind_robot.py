"""The part of ``grindvision grind`` that turns passes into a robot's programme."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.cli.camera_pose import add_base_argument, of_the_model
from grindvision.cli.parameters import number
from grindvision.errors import InputError
from grindvision.records import by_content

if TYPE_CHECKING:
    import numpy as np

    from grindvision.motion import Robot, ToolPath

LANGUAGES = ("rapid", "krl", "ls", "jbi", "urscript")

#: Names of all files that a programme may have; those of another language are removed.
PROGRAM_FILES = tuple(f"grind*.{ending}" for ending in ("script", "mod", "src", "dat", "ls", "jbi"))

#: Places of a programme along a cut are so far apart at least where it is straight, mm.
STEP_MM = 5.0


@by_content
@dataclass(frozen=True)
class GrindRobot:
    """The arm with its spindle, the language of its programme, and where everything stands (mm), in the base of
    the robot's model."""

    robot: Robot
    language: str
    T_base_scanner: np.ndarray
    lead_angle_rad: float
    table_top_mm: float
    spin_free: bool

    def write(self, ways: list[ToolPath | None], points: np.ndarray, folder: Path) -> list[dict[str, Any]]:
        """Write a programme for each piece that has a way, ``grind1`` and so on; returns what report.json says."""
        from grindvision.geometry import move_points
        from grindvision.motion import (
            PlanMotionOptions,
            RobotProgrammeOptions,
            driven,
            grinding_programme,
            plan_motion,
            programme_files,
            scanned,
        )

        work = scanned("work", move_points(self.T_base_scanner, points))
        facts = []
        for piece, way in enumerate(ways, start=1):
            if way is None:
                continue
            path = driven(way.thinned(STEP_MM).moved(self.T_base_scanner))
            settings = PlanMotionOptions(
                tool_speed_mm_s=float(path.feeds_mm_s.max()),
                obstacles=(work,),
                table_top_mm=self.table_top_mm,
                spin_free=self.spin_free,
            )
            motion = plan_motion(self.robot, path.trajectory(self.lead_angle_rad), settings)
            named = RobotProgrammeOptions(f"grind{piece}", placed=self.language != "urscript")
            texts = programme_files(grinding_programme(motion, path, named), self.language)
            for name, text in texts.items():
                (folder / name).write_bytes(text.encode("ascii"))
            facts.append(
                {
                    "piece": piece,
                    "robot": self.robot.name,
                    "files": sorted(texts),
                    "poses": len(path),
                    "position_error_mm": motion.path.position_error_mm.max(),
                    "clearance_mm": motion.clearance.min_mm,
                }
            )
        return facts


def add_robot_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that ask for a robot's programme."""
    group = parser.add_argument_group("robot programme (needs --robot, and --scanner-pose or --hand-eye)")
    group.add_argument("--robot", metavar="NAME|FILE", help="arm, see `grindvision robots`; adds DIR/grind1.*")
    group.add_argument("--program", choices=LANGUAGES, help="language of the programme (needed with --robot)")
    group.add_argument(
        "--tool",
        metavar="FILE.json",
        help="4x4 matrix T_flange_tcp to the wheel's lowest point, mm, z into the work, x along the line (default: a"
        " spindle in line with the flange, 230 mm)",
    )
    add_base_argument(group)
    group.add_argument("--flange", metavar="NAME", help="link of a URDF file that carries the spindle (default: tool0)")
    group.add_argument("--table-top", type=number, metavar="MM", help="height of the table in the base (default: 0)")


def grind_robot(options: argparse.Namespace, T_base_scanner: np.ndarray | None) -> GrindRobot | None:
    """The arm of the command's options, or None when none is asked for; refuses what cannot work before any work.

    Raises:
        InputError: an option that needs ``--robot`` without it, or a robot without pose or language.
    """
    if options.robot is None:
        lonely = [
            name for name in ("program", "tool", "flange", "table_top", "base") if getattr(options, name) is not None
        ]
        if lonely:
            raise InputError(f"--{lonely[0].replace('_', '-')} is for a robot's programme; give --robot as well")
        return None
    if T_base_scanner is None:
        raise InputError(
            "--robot needs --scanner-pose, or --hand-eye with --robot-pose: where the scanner stood in the robot's base"
            " frame"
        )
    if options.program is None:
        raise InputError(f"--robot needs --program: {', '.join(LANGUAGES)}")
    from grindvision.motion import UR_JOINTS, LoadRobotOptions, grinding_spindle, known_robots, load_robot
    from grindvision.motion.placement import check_spherical_wrist
    from grindvision.motion.tool import read_spindle

    tool = grinding_spindle() if options.tool is None else read_spindle(options.tool)
    robot = load_robot(options.robot, LoadRobotOptions(tool, options.flange))
    known = known_robots().get(options.robot)
    if known is not None and known.language != options.program:
        raise InputError(f"{known.name} is an arm of {known.maker}; it takes --program {known.language}")
    if options.program != "urscript":
        check_spherical_wrist(robot)
    elif robot.joints != UR_JOINTS:
        raise InputError(f"{robot.name} is no arm of Universal Robots, it cannot run URScript")
    angle = 0.0 if options.lead_angle is None else options.lead_angle * 3.141592653589793 / 180
    # a disc looks alike from all sides; a wheel has to run along its line
    T_model_scanner, table_top = of_the_model(options, robot, T_base_scanner)
    return GrindRobot(robot, options.program, T_model_scanner, angle, table_top, options.disc is not None)
