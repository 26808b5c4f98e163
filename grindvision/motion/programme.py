"""A checked motion as a file a robot or a spreadsheet reads: CSV, JSON, URScript. Written whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.errors import InputError
from grindvision.files import write_json, write_text
from grindvision.geometry import vector_angle
from grindvision.motion.plan import Motion
from grindvision.motion.trajectory import Trajectory

Floats = NDArray[np.float64]

#: File name ending of each format.
SUFFIXES = {"csv": ".csv", "json": ".json", "urscript": ".script"}

#: What Universal Robots call their joints; no other arm runs URScript.
UR_JOINTS = tuple(
    f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
)


def write_programme(motion: Motion, path: str | Path, form: str) -> None:
    """Write a motion as a file that a robot or a spreadsheet reads, whole or not at all.

    Args:
        motion: joint angles in rad, poses in mm in the arm's base frame, times in s.
        path: file.
        form: ``csv``, ``json`` or ``urscript``.

    Raises:
        InputError: an unknown format, or URScript for an arm that is none of Universal Robots'.
        FileError: the file cannot be written.

    Example:
        >>> from grindvision import load_robot, plan_motion, tool_trajectory, write_programme
        >>> seam_mm = [(300, y, 60) for y in (-40, -20, 0, 20, 40)]
        >>> motion = plan_motion(load_robot("ur3"), tool_trajectory(seam_mm, [(0, 0, 1)] * 5))
        >>> write_programme(motion, "weld.script", "urscript")
    """
    if form == "csv":
        write_text(path, csv_text(motion))
    elif form == "json":
        write_json(path, json_content(motion))
    elif form == "urscript":
        write_text(path, urscript(motion))
    else:
        raise InputError(f"unknown programme format {form!r}; choose one of {', '.join(SUFFIXES)}")


def csv_text(motion: Motion) -> str:
    """One row per worked pose: time, joint angles, tool position and ``rpy_rad`` in the base in which the controller
    shows poses, which for UR, FANUC and Yaskawa is not the model's."""
    joints = [f"{joint}_rad" for joint in motion.robot.joints]
    header = ["waypoint", "time_s", *joints, "x_mm", "y_mm", "z_mm", "roll_rad", "pitch_rad", "yaw_rad"]
    rows = [",".join(header)]
    tool = Trajectory(motion.robot.T_controller_base @ motion.path.T_base_tool)
    numbers = np.column_stack([motion.timing.waypoint_time_s, motion.path.q_rad, tool.positions_mm, tool.rpy_rad])
    rows += [",".join([str(number), *map(repr, row)]) for number, row in enumerate(numbers.tolist())]
    return "\n".join(rows) + "\n"


def json_content(motion: Motion) -> dict[str, Any]:
    """Everything about the motion that a controller needs, with its units and frames named."""
    robot = motion.robot
    return {
        "robot": robot.name,
        "joints": robot.joints,
        "units": {"length": "mm", "angle": "rad", "time": "s"},
        "T_flange_tool": robot.tool.T_flange_tool,
        "T_controller_base": robot.T_controller_base,
        "closed": motion.trajectory.closed,
        "tool_speed_mm_s": motion.timing.asked_speed_mm_s,
        "approach": {"q_rad": motion.q_approach_rad, "T_base_tool": robot.forward(motion.q_approach_rad)},
        "waypoints": [
            {"time_s": time, "q_rad": q, "T_base_tool": pose}
            for time, q, pose in zip(
                motion.timing.waypoint_time_s, motion.path.q_rad, motion.path.T_base_tool, strict=True
            )
        ],
        "retreat": {"q_rad": motion.q_retreat_rad, "T_base_tool": robot.forward(motion.q_retreat_rad)},
    }


def urscript(motion: Motion) -> str:
    """URScript: a joint move to the approach, a straight move down, process moves (movep) along the seam, and back off.

    URScript counts in metres and gives orientations as rotation vectors in the controller's base frame, which stands
    half a turn from the URDF's ``base_link``. The joint angles of the approach fix the branch. A move's speed is the
    highest the time law has on it, so the joints' limits hold. Nothing switches the arc on: this is a dry run.

    Raises:
        InputError: the arm is none of Universal Robots'.
    """
    robot, timing = motion.robot, motion.timing
    if robot.joints != UR_JOINTS:
        raise InputError(
            f"{robot.name} is no arm of Universal Robots, it cannot run URScript; write csv or json instead"
        )
    poses = [_ur_pose(robot.T_controller_base @ pose) for pose in motion.path.T_base_tool]
    away = _ur_pose(robot.T_controller_base @ robot.forward(motion.q_retreat_rad))
    arc = motion.trajectory.arc_mm
    blends_mm = blend_radii(motion.path.T_base_tool[:, :3, 3])
    angles = ", ".join(f"{angle:.9f}" for angle in motion.q_approach_rad)
    lines = [
        "def follow_seam():",
        f"  # {len(poses)} poses, {arc[-1]:.1f} mm at {timing.asked_speed_mm_s:g} mm/s; m and rad; dry run, no arc",
        f"  set_tcp({_ur_pose(robot.tool.T_flange_tool)})",
        f"  movej([{angles}], a=0.8, v=0.5)",
        f"  movel({poses[0]}, a=0.3, v=0.02)",
    ]
    for number, pose in enumerate(poses[1:], 1):
        on_move = (timing.arc_mm >= arc[number - 1]) & (timing.arc_mm <= arc[number])
        speed_m_s = 1e-3 * timing.tool_speed_mm_s[on_move].max(initial=0.1)
        lines.append(f"  movep({pose}, a=0.1, v={speed_m_s:.6f}, r={1e-3 * blends_mm[number]:.6f})")
    lines += [f"  movel({away}, a=0.3, v=0.02)", "end", ""]
    return "\n".join(lines)


def blend_radii(points: Floats) -> Floats:
    """Blend radius (N,) in mm at each of N points, at most 1: there the tool rounds the corner, cutting off 0.02 mm."""
    steps = np.diff(points, axis=0)
    turns = vector_angle(steps[1:], steps[:-1])
    lengths = np.linalg.norm(steps, axis=1)
    blends = np.zeros(len(points))
    blends[1:-1] = np.minimum(np.minimum(lengths[1:], lengths[:-1]) / 4, 0.02 / np.tan(np.maximum(turns, 0.08) / 4))
    return blends


def _ur_pose(T_from_to: Floats) -> str:
    """Pose literal of URScript: metres and a rotation vector in rad."""
    numbers = [*(T_from_to[:3, 3] / 1000.0), *Rotation.from_matrix(T_from_to[:3, :3]).as_rotvec()]
    return "p[" + ", ".join(f"{number:.9f}" for number in numbers) + "]"
