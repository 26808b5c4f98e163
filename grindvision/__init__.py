"""Robot vision for grinding and welding: the package behind the reproducible experiment book.

Rooms, in the order data flows through them: ``geometry``, ``arm``, ``paper``, ``cell``, ``vision``,
``calibration``, ``motion``. The names listed here are the front door, fetched when first used: functions, the frozen
options that each takes, and what it returns. Everything else is imported from its room: ``from grindvision import
vision``.
"""

from grindvision.lazy import lazy_names

__version__ = "0.2.0"

_HOMES = {
    "clouds": ("Cloud", "read_cloud", "write_ply"),
    "models": ("Model", "read_model"),
    "vision.registration.scan_registration": ("RegisterOptions", "Registration", "register"),
    "vision.registration.meeting": ("Meeting", "merge"),
    "vision.change.detection": ("DetectOptions", "Detection", "detect"),
    "vision.seam.groove": ("FindGroovesOptions", "GrooveDetection", "find_grooves"),
    "vision.seam.weld": ("TraceWeldOptions", "Weld", "trace_weld"),
    "vision.depth_calibration.field_correction": ("CalibrateFieldOptions", "FieldCorrection", "calibrate_field"),
    "arm.mdh": ("MdhArm", "read_arm"),
    "calibration.measurement_files": ("read_measurements",),
    "calibration.measurements": ("Measurements",),
    "calibration.accurate": ("Calibration", "calibrate"),
    "calibration.options": ("Options as CalibrateOptions",),
    "calibration.holding": ("Verification", "VerifyOptions", "verify"),
    "calibration.hand_eye": ("HandEye", "HandEyeOptions", "hand_eye"),
    "motion.robot": ("Robot",),
    "motion.robot_files": ("LoadRobotOptions", "load_robot"),
    "motion.trajectory": ("ToolTrajectoryOptions", "Trajectory", "tool_trajectory"),
    "motion.plan": ("Motion", "PlanMotionOptions", "plan_motion"),
    "motion.programme": ("write_programme",),
    "grinding": ("GrindOptions", "Grinding", "grind"),
    "cell.simulation": ("SimulateOptions", "simulate"),
}
_RENAMED = {
    name: f"{room}.{name}={home}:{name}"
    for room, home, names in (
        ("vision", "vision.depth_calibration.field_correction", ("read_field", "write_field")),
        ("arm", "arm.mdh", ("write_arm",)),
        ("motion", "motion.tool", ("grinding_spindle", "welding_torch")),
    )
    for name in names
}

__all__, __getattr__ = lazy_names(__name__, _HOMES, _RENAMED)
