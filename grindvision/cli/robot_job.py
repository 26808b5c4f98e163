"""The part of a command that turns a trajectory into a robot programme: ``--robot``, ``--program`` and their kin."""

from __future__ import annotations

import argparse
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.cli.camera_pose import add_base_argument, add_camera_arguments, of_the_model, scanner_pose
from grindvision.cli.parameters import check_count, number, whole
from grindvision.cli.weld_options import (
    ARC_OPTIONS,
    FRAME_OPTIONS,
    WELD_OPTIONS,
    FrameNames,
    WeldWishes,
    add_arc_arguments,
    add_weld_arguments,
    frame_names,
    hot_run,
    weld_wishes,
)
from grindvision.errors import GrindvisionWarning, InputError, UnreachableError
from grindvision.records import by_content

if TYPE_CHECKING:
    import numpy as np

    from grindvision.cli.weld_job import WeldRun
    from grindvision.motion import (
        ArcOptions,
        Motion,
        PlanMotionOptions,
        Robot,
        RobotProgramme,
        RobotProgrammeOptions,
        Tool,
        Trajectory,
        WeldPath,
    )


PROGRAMS = ("csv", "json", "urscript", "rapid", "krl", "ls", "jbi", "steps-json", "steps-csv")

#: Names of all files that a programme may have; those of another format or another weld are removed.
PROGRAM_FILES = tuple(
    f"{name}.{ending}"
    for name in ("program", "prog_arc", "pass[0-9]*", "arc[0-9]*", "tacks", "tack_arc")
    for ending in ("csv", "json", "script", "mod", "src", "dat", "ls", "jbi")
)


@by_content
@dataclass(frozen=True)
class RobotJob:
    """What was asked for: the robot with its torch, the format of the programme, and where everything stands (mm), in
    the base of the robot's model."""

    robot: Robot
    form: str
    T_base_scanner: np.ndarray
    torch_speed_mm_s: float
    table_top_mm: float
    seed: int
    arc: ArcOptions | None = None
    frames: FrameNames = field(default_factory=FrameNames)
    wishes: WeldWishes | None = None

    def plan(self, trajectory: Trajectory, points: np.ndarray) -> Motion:
        """Motion along a trajectory in the scanner's frame, clear of the table and of the scanned points (N, 3)."""
        fine = trajectory.moved(self.T_base_scanner).refined(step_mm=10.0, step_rad=0.1)
        return self._planned(fine, self._settings(points), trajectory.closed)

    def plan_weld(self, path: WeldPath, points: np.ndarray, closed: bool = False) -> Motion:
        """Motion along a welding path in the scanner's frame, clear of the same; ``closed``: it goes round a seam."""
        there = path.moved(self.T_base_scanner)
        return self._planned(there.trajectory, there.plan_options(self._settings(points)), closed)

    def _planned(self, trajectory: Trajectory, options: PlanMotionOptions, closed: bool) -> Motion:
        """Motion along a trajectory in the base frame.

        Where the last joints cannot make the turn round a closed seam, the torch keeps its axis and spins about it.
        """
        from grindvision.motion import plan_motion

        try:
            return plan_motion(self.robot, trajectory, options)
        except UnreachableError:
            if not closed:
                raise
        motion = plan_motion(self.robot, trajectory, replace(options, spin_free=True))
        warnings.warn(
            "the arm cannot turn the torch all round a closed seam: the wire keeps its angles, but the torch's neck"
            " does not turn with the seam; see that the neck passes beside the work",
            GrindvisionWarning,
            stacklevel=2,
        )
        return motion

    def write(self, motion: Motion, folder: Path) -> str:
        """Write ``program`` with the format's ending into the folder, ``prog_arc`` where asked; returns the name."""
        from grindvision.motion import SUFFIXES, robot_programme, write_programme

        own_form = self.form in SUFFIXES and not self.frames.tool and self.frames.T_base_work is None
        runs = [] if own_form else [("program", None)]
        runs += [] if self.arc is None else [("prog_arc", self.arc)]
        texts = [self._texts(robot_programme(motion, self._named(name, arc))) for name, arc in runs]
        for name, text in (pair for files in texts for pair in files.items()):
            _write_ascii(folder / name, text)
        if not own_form:
            return next(iter(texts[0]))
        name = "program" + SUFFIXES[self.form]
        write_programme(motion, folder / name, self.form)
        return name

    def write_weld(self, motion: Motion, run: WeldRun, folder: Path) -> str:
        """Write a run's dry programme into the folder, its hot one where asked; returns the dry one's text."""
        from grindvision.motion import welding_programme

        names = [(run.name, None)] + ([] if self.arc is None else [(run.hot_name, self.arc)])
        texts = [self._texts(welding_programme(motion, run.path, self._named(name, arc))) for name, arc in names]
        for name, text in (pair for files in texts for pair in files.items()):
            _write_ascii(folder / name, text)
        return next(iter(texts[0].values()))

    def _settings(self, points: np.ndarray) -> PlanMotionOptions:
        from grindvision.geometry import move_points
        from grindvision.motion import PlanMotionOptions, scanned

        return PlanMotionOptions(
            tool_speed_mm_s=self.torch_speed_mm_s,
            obstacles=(scanned("work", move_points(self.T_base_scanner, points)),),
            table_top_mm=self.table_top_mm,
            seed=self.seed,
        )

    def _named(self, name: str, arc: ArcOptions | None) -> RobotProgrammeOptions:
        return self.frames.programme_options(name, self.form, arc)

    def _texts(self, programme: RobotProgramme) -> dict[str, str]:
        from grindvision.motion import programme_files

        return programme_files(programme, self.form)


def add_robot_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that ask for a robot's programme."""
    add_camera_arguments(parser, "CLOUD")
    group = parser.add_argument_group("robot programme (all need --robot)")
    group.add_argument(
        "--robot",
        metavar="NAME|FILE.urdf|FILE.csv",
        help="arm that carries the torch; adds DIR/program.*. `grindvision robots` lists the names. A CSV is"
        " a modified DH table (see `grindvision calibrate --help`) with joint limits in further columns"
        " lower_rad, upper_rad, speed_rad_s",
    )
    group.add_argument(
        "--scanner-pose", metavar="FILE.json", help="needed: 4x4 matrix T_base_scanner, mm, bare or under that key"
    )
    add_base_argument(group)
    group.add_argument("--flange", metavar="NAME", help="link of a URDF file that carries the torch (default: tool0)")
    group.add_argument(
        "--send",
        metavar="HOST",
        help="hand the URScript over to this controller once all is written; asks before it does",
    )
    group.add_argument("--yes", action="store_true", default=None, help="send without asking: the arm moves at once")
    group.add_argument(
        "--anywhere", action="store_true", default=None, help="send to an address outside private networks too"
    )
    group.add_argument("--program", choices=PROGRAMS, help="format of the programme (default: csv)")
    group.add_argument(
        "--tool",
        metavar="FILE.json",
        help="the torch: 4x4 matrix T_flange_tcp to the wire's tip, mm, z along the wire (default: straight, 160 mm)",
    )
    group.add_argument("--stick-out", type=number, metavar="MM", help="wire out of the nozzle (default: 15)")
    add_arc_arguments(group)
    group.add_argument("--torch-speed", type=number, metavar="MM_S", help="along the seam, mm/s (default: 8)")
    group.add_argument("--seed", type=whole, metavar="N", help="seed of the random start angles (default: 0)")
    group.add_argument("--table-top", type=number, metavar="MM", help="height of the table in the base (default: 0)")
    add_weld_arguments(parser)


def robot_job(options: argparse.Namespace) -> RobotJob | None:
    """The job of the command's options, or None when no robot is asked for; refuses what cannot work before any work.

    Raises:
        InputError: an option that needs ``--robot`` without it, or a robot without ``--scanner-pose``.
        FileError: the robot's file or the pose cannot be used. NotRigidError: the pose is no rigid transform.
    """
    needs_robot = (
        "flange",
        "program",
        "scanner_pose",
        "base",
        "hand_eye",
        "robot_pose",
        "seed",
        "torch_speed",
        "table_top",
        "send",
        "yes",
        "anywhere",
        "tool",
        "stick_out",
        "arc",
        *ARC_OPTIONS,
        *FRAME_OPTIONS,
        *WELD_OPTIONS,
    )
    if options.robot is None:
        lonely = [name for name in needs_robot if getattr(options, name, None) is not None]
        if lonely:
            raise InputError(f"--{lonely[0].replace('_', '-')} is for a robot's programme; give --robot as well")
        return None
    T_base_scanner = scanner_pose(options)
    if T_base_scanner is None:
        raise InputError(
            "--robot needs --scanner-pose, or --hand-eye with --robot-pose: where the scanner stood in the robot's"
            " base frame"
        )
    from grindvision.motion import LoadRobotOptions, load_robot

    form = options.program or "csv"
    arc = hot_run(options, form)
    robot = load_robot(options.robot, LoadRobotOptions(_torch(options), options.flange))
    frames = frame_names(options, form)
    _check_language(options.robot, robot, form, arc, frames)
    speed = 8.0 if options.torch_speed is None else options.torch_speed
    if not 0 < speed < float("inf"):
        raise InputError(f"--torch-speed is {speed:g} mm/s; give a number above 0")
    check_count("--seed", options.seed or 0, 0, 10**18)
    if options.send is None and (options.yes or options.anywhere):
        raise InputError(f"--{'yes' if options.yes else 'anywhere'} is for sending; give --send HOST as well")
    if options.send is not None and form != "urscript":
        raise InputError(f"--send hands URScript over, not {form}; give --program urscript as well")
    wishes = weld_wishes(options, form, speed)
    T_model_scanner, table_top = of_the_model(options, robot, T_base_scanner)
    return RobotJob(robot, form, T_model_scanner, speed, table_top, options.seed or 0, arc, frames, wishes)


def _torch(options: argparse.Namespace) -> Tool:
    from grindvision.motion import read_torch, welding_torch

    wire_mm = 15.0 if options.stick_out is None else options.stick_out
    if not 5 <= wire_mm <= 50:
        raise InputError(f"--stick-out is {wire_mm:g} mm; give 5 to 50")
    return welding_torch(145.0 + wire_mm, wire_mm) if options.tool is None else read_torch(options.tool, wire_mm)


def _check_language(source: str, robot: Robot, form: str, arc: ArcOptions | None, frames: FrameNames) -> None:
    """Refuse a language that the arm does not speak, or names that the language does not take, before any work."""
    if form in ("csv", "json", "steps-csv", "steps-json"):
        return
    import numpy as np

    from grindvision.motion import UR_JOINTS, RobotProgramme, known_robots, programme_files
    from grindvision.motion.placement import check_spherical_wrist
    from grindvision.motion.programme_steps import Output

    known = known_robots().get(source)
    if known is not None and known.language != form:
        raise InputError(f"{known.name} is an arm of {known.maker}; it takes --program {known.language}, not {form}")
    if form != "urscript":
        check_spherical_wrist(robot)
    elif robot.joints != UR_JOINTS:
        raise InputError(f"{robot.name} is no arm of Universal Robots, it cannot run URScript; choose csv or json")
    named = [] if arc is None or arc.data is not None else [(arc.output, True), *arc.setpoints]
    named += [] if arc is None or not arc.gas else [(arc.gas, True)]
    steps = tuple(Output(name, value) for name, value in named)
    words = frames.programme_options("prog_arc", form, arc)
    trial = RobotProgramme(
        "prog_arc",
        robot.name,
        robot.joints,
        np.eye(4),
        np.eye(4),
        steps,
        arc,
        words.tool_number,
        words.work_number,
        words.kept_tool,
        words.kept_work,
    )
    programme_files(trial, form)


def _write_ascii(path: Path, text: str) -> None:
    from grindvision.files import write_whole

    with write_whole(path) as temporary:
        temporary.write_bytes(text.encode("ascii"))


def send_if_agreed(script: str, options: argparse.Namespace) -> None:
    """Say what ``--send`` will do with a URScript, ask unless ``--yes``, and hand it over.

    Raises:
        InputError: nobody is there to be asked. SendError: the controller cannot be reached or is not a private one.
    """
    import sys

    from grindvision.motion import announcement, send_urscript

    print(announcement(script, options.send))
    if not options.yes:
        if not sys.stdin.isatty():
            raise InputError(
                "--send asks before an arm moves, and nobody is there to answer; give --yes; nothing was sent"
            )
        if input("Is everybody out of the cell? Send it? [y/N] ").strip().lower() not in ("y", "yes"):
            print("nothing was sent")
            return
    print(send_urscript(script, options.send, anywhere=bool(options.anywhere)))


def motion_facts(motion: Motion) -> dict[str, Any]:
    """What report.json says about the motion."""
    import numpy as np

    first, second = motion.clearance.nearest[motion.clearance.tightest]
    return {
        "robot": motion.robot.name,
        "position_error_mm": motion.path.position_error_mm.max(),
        "angle_error_deg": np.degrees(motion.path.angle_error_rad.max()),
        "clearance_mm": motion.clearance.min_mm,
        "clearance_between": [first, second],
        "duration_s": motion.timing.time_s[-1],
        "torch_speed_mm_s": motion.timing.asked_speed_mm_s,
        "steady_fraction": motion.timing.steady_fraction,
        "steady_share": motion.timing.steady_fraction,  # the key of 0.1, for one version
    }
