"""Path points in, robot programme out: tool frames, inverse kinematics, clearances, timing, export.

Names are fetched from their modules when first used, so that tool frames and the sender come without Pinocchio.
"""

from __future__ import annotations

from grindvision.lazy import lazy_names

_HOMES = {
    "clearance": ("Clearance", "Obstacle", "box", "measure_clearance", "mesh", "scanned", "table"),
    "grinding": ("GrindingPass", "GrindingPlan", "Workpiece", "plan_grinding", "preston_depth", "simulate_passes"),
    "grinding_options": ("GrindingOptions",),
    "grinding_path": ("ToolPath", "driven", "grinding_programme", "tool_path"),
    "removal": ("LearntRemoval", "learn_removal"),
    "known": ("KnownRobot", "known_robots"),
    "follow": ("JointPath", "follow_trajectory", "start_angles"),
    "plan": ("Motion", "PlanMotionOptions", "plan_motion"),
    "programme": ("SUFFIXES", "UR_JOINTS", "csv_text", "json_content", "urscript", "write_programme"),
    "robot": ("ER3A_LIMITS", "JointLimits", "Robot", "mdh_robot", "ur3", "urdf_robot"),
    "placement": ("Placement", "placements"),
    "robot_files": ("LoadRobotOptions", "load_robot"),
    "programme_steps": ("ArcOptions", "RobotProgramme", "RobotProgrammeOptions", "robot_programme"),
    "sender": ("UR_PORT", "Delivery", "announcement", "send_urscript"),
    "timing": ("TimeLaw", "time_law"),
    "tool": ("Tool", "grinding_spindle", "read_torch", "welding_torch"),
    "weave": ("Weave",),
    "weld_passes": ("GrooveSection", "WeldFill", "WeldPass", "fill_groove", "shifted_seam"),
    "welding_path": (
        "WeldPath",
        "WeldPathOptions",
        "equal_tacks",
        "stretches_between",
        "tacks_at",
        "weld_path",
        "welding_programme",
    ),
    "writers": ("LANGUAGES", "programme_files"),
    "trajectory": (
        "ToolTrajectoryOptions",
        "Trajectory",
        "angular_speed_rad_s",
        "limit_angular_speed",
        "tool_trajectory",
    ),
}
_RENAMED = {"slowly_turning": "limit_angular_speed", "turning_rad_s": "angular_speed_rad_s"}

__all__, __getattr__ = lazy_names(__name__, _HOMES, _RENAMED)
