"""Robot vision for grinding and welding: the package behind the reproducible experiment book.

Rooms, in the order data flows through them: ``geometry``, ``arm``, ``paper``, ``cell``, ``vision``,
``calibration``, ``motion``. The names listed here are the front door, fetched when first used; everything else is
imported from its room: ``from grindvision import vision``.
"""

from grindvision.lazy import lazy_names

__version__ = "0.1.0"

_HOMES = {
    "clouds": ("Cloud", "read_cloud", "write_ply"),
    "vision.registration.scan_registration": ("RegisterOptions", "Registration", "register"),
    "vision.change.detection": ("DetectOptions", "Detection", "detect"),
    "vision.seam.groove": ("GrooveDetection", "find_grooves"),
    "vision.seam.weld": ("Weld", "trace_weld"),
    "vision.depth_calibration.field_correction": ("FieldCorrection", "calibrate_field", "read_field", "write_field"),
    "arm.mdh": ("MdhArm", "read_arm", "write_arm"),
    "calibration.measurement_files": ("read_measurements",),
    "calibration.measurements": ("Measurements",),
    "calibration.accurate": ("Options as CalibrateOptions", "Calibration", "calibrate"),
    "motion.tool": ("grinding_spindle", "welding_torch"),
    "motion.trajectory": ("Trajectory", "tool_trajectory"),
    "motion.plan": ("Motion", "plan_motion"),
    "motion.programme": ("write_programme",),
}

__all__, __getattr__ = lazy_names(__name__, _HOMES)
