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
from grindvision.cell.experiment4 import Experiment4Twin, PrintedPath, experiment4_twin, printed_path, twin_part
from grindvision.cell.grinding_part import Bead, GrindingPart, grinding_part
from grindvision.cell.grinding_scene import GrindingScene, grinding_scene, scanned_pair
from grindvision.cell.height_target import HEIGHT_MM, POSITIONS_MM, flat_plate, height_sighting, height_target
from grindvision.cell.joint_errors import JointErrors, drawn_joint_errors
from grindvision.cell.joint_pieces import JOINTS, JointPiece, JointSize, joint_piece
from grindvision.cell.joint_scene import JointScene, joint_scene
from grindvision.cell.rays import Target
from grindvision.cell.scan import Scan, Sighting
from grindvision.cell.scanner_errors import SOURCES, ScannerErrors
from grindvision.cell.scanners import DepthCamera, Scanner, StructuredLightScanner
from grindvision.cell.simulation import SUBJECTS, SimulateOptions, simulate
from grindvision.cell.solids import Solid, assembled
from grindvision.cell.spheres import measure_sphere, scan_sphere, sphere_centre_errors, sphere_on_nest
from grindvision.cell.views import view_from
from grindvision.cell.weld_pieces import KINDS, Groove, WeldPiece, weld_piece
from grindvision.cell.weld_scene import WeldScene, weld_scene
from grindvision.cell.workpiece_scene import CHANGES, WorkpieceScene, workpiece_scene
from grindvision.cell.workpieces import WORKPIECES, Workpiece, workpiece

__all__ = [
    "CHANGES",
    "HEIGHT_MM",
    "JOINTS",
    "KINDS",
    "POSITIONS_MM",
    "SOURCES",
    "SUBJECTS",
    "WORKPIECES",
    "Bead",
    "CalibrationExperiment",
    "CalibrationPlan",
    "DepthCamera",
    "Experiment4Twin",
    "GrindingPart",
    "GrindingRobot",
    "GrindingScene",
    "Groove",
    "JointErrors",
    "JointPiece",
    "JointScene",
    "JointSize",
    "LaserTracker",
    "PrintedPath",
    "Scan",
    "Scanner",
    "ScannerErrors",
    "Sighting",
    "SimulateOptions",
    "Solid",
    "StructuredLightScanner",
    "Target",
    "WeldPiece",
    "WeldScene",
    "Workpiece",
    "WorkpieceScene",
    "assembled",
    "calibration_experiment",
    "calibration_plan",
    "directions_seeing",
    "drawn_joint_errors",
    "experiment4_twin",
    "flat_plate",
    "grinding_part",
    "grinding_scene",
    "height_sighting",
    "height_target",
    "joint_piece",
    "joint_scene",
    "measure_sphere",
    "measured",
    "misaligned_tracker",
    "nominal_arm",
    "printed_path",
    "scan_sphere",
    "scanned_pair",
    "simulate",
    "sphere_centre_errors",
    "sphere_on_nest",
    "true_arm",
    "twin_part",
    "view_from",
    "weld_piece",
    "weld_scene",
    "workpiece",
    "workpiece_scene",
]
