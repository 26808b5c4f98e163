"""Sphere centres in, calibrated cell out: coarse, accurate, identifiability, uncertainty, pose choice.

This room sees measurements and the nominal arm; it never sees the truth.
"""

from grindvision.calibration.accurate import (
    Calibration,
    calibrate,
    unknowns_of,
)
from grindvision.calibration.beyond_geometry import BeyondGeometry
from grindvision.calibration.coarse import CoarseCalibration, best_fit, coarse_start, three_point
from grindvision.calibration.estimate import Sigmas, noise_covariances, residuals_of, unit_sizes, whitened_jacobian
from grindvision.calibration.held_out import HeldOut, cross_validated, evaluate, on_test_rows
from grindvision.calibration.holding import Verification, VerifyOptions, read_cell, verify
from grindvision.calibration.identifiability import Identifiability, analyse, correlations
from grindvision.calibration.joint_terms import JointCorrections, JointTerm
from grindvision.calibration.left_out import track_left_out
from grindvision.calibration.measurement_files import read_measurements, unused_columns
from grindvision.calibration.measurements import COVARIANCE_COLUMNS, Measurements
from grindvision.calibration.model import ScannerOnArm, design_matrix, joint_jacobian, moved_cell
from grindvision.calibration.options import Options
from grindvision.calibration.poses import PoseChoice, choose_poses
from grindvision.calibration.robust import consistent_rows
from grindvision.calibration.sphere_centres import find_sphere, noise_clumping
from grindvision.calibration.statistics import ErrorStatistics, error_statistics
from grindvision.calibration.structure import Finding
from grindvision.calibration.trust import PredictedErrors, Suggestion, diagnose_trust, predict_errors, suggest_poses
from grindvision.calibration.unknowns import Unknowns, entry_name, table_entries
from grindvision.lazy import lazy_names

__all__ = [
    "COVARIANCE_COLUMNS",
    "BeyondGeometry",
    "Calibration",
    "CoarseCalibration",
    "ErrorStatistics",
    "Finding",
    "HeldOut",
    "Identifiability",
    "JointCorrections",
    "JointTerm",
    "Measurements",
    "Options",
    "PoseChoice",
    "PredictedErrors",
    "ScannerOnArm",
    "Sigmas",
    "Suggestion",
    "Unknowns",
    "Verification",
    "VerifyOptions",
    "analyse",
    "best_fit",
    "calibrate",
    "choose_poses",
    "coarse_start",
    "consistent_rows",
    "correlations",
    "cross_validated",
    "design_matrix",
    "diagnose_trust",
    "entry_name",
    "error_statistics",
    "evaluate",
    "find_sphere",
    "joint_jacobian",
    "moved_cell",
    "noise_clumping",
    "noise_covariances",
    "on_test_rows",
    "predict_errors",
    "read_cell",
    "read_measurements",
    "residuals_of",
    "suggest_poses",
    "table_entries",
    "three_point",
    "track_left_out",
    "unit_sizes",
    "unknowns_of",
    "unused_columns",
    "verify",
    "whitened_jacobian",
]

_RENAMED = {
    "doubt_about": "diagnose_trust",
    "Foreseen": "PredictedErrors",
    "foreseen_errors": "predict_errors",
}
_, __getattr__ = lazy_names(__name__, {}, _RENAMED)
