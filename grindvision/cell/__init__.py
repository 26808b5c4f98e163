"""The virtual cell: arms, scanners and workpieces that make scans and measurements with ground truth."""

from grindvision.cell.arms import GrindingRobot, LaserTracker, nominal_arm, true_arm
from grindvision.cell.calibration_scene import (
    CalibrationExperiment,
    CalibrationPlan,
    calibration_experiment,
    calibration_plan,
    directions_seeing,
    measured,
    misaligned_tracker,
)
from grindvision.cell.rays import Target
from grindvision.cell.scanner_errors import SOURCES, ScannerErrors
from grindvision.cell.scanners import DepthCamera, Scan, Scanner, Sighting, StructuredLightScanner
from grindvision.cell.solids import Solid, assembled
from grindvision.cell.spheres import measure_sphere, scan_sphere, sphere_centre_errors, sphere_on_nest
from grindvision.cell.views import view_from
from grindvision.cell.weld_pieces import KINDS, Groove, WeldPiece, weld_piece
from grindvision.cell.weld_scene import WeldScene, weld_scene

__all__ = [
    "KINDS",
    "SOURCES",
    "CalibrationExperiment",
    "CalibrationPlan",
    "DepthCamera",
    "GrindingRobot",
    "Groove",
    "LaserTracker",
    "Scan",
    "Scanner",
    "ScannerErrors",
    "Sighting",
    "Solid",
    "StructuredLightScanner",
    "Target",
    "WeldPiece",
    "WeldScene",
    "assembled",
    "calibration_experiment",
    "calibration_plan",
    "directions_seeing",
    "measure_sphere",
    "measured",
    "misaligned_tracker",
    "nominal_arm",
    "scan_sphere",
    "sphere_centre_errors",
    "sphere_on_nest",
    "true_arm",
    "view_from",
    "weld_piece",
    "weld_scene",
]
