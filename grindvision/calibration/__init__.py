"""Sphere centres in, calibrated cell out: coarse, accurate, identifiability, uncertainty, pose choice.

This room sees measurements and the nominal arm; it never sees the truth.
"""

from grindvision.calibration.accurate import (
    Calibration,
    Options,
    calibrate,
)
from grindvision.calibration.coarse import CoarseCalibration, best_fit, coarse_start, three_point
from grindvision.calibration.estimate import Spreads, noise_covariances, residuals_of, unit_sizes, whitened_design
from grindvision.calibration.held_out import HeldOut, cross_validated, on_test_rows
from grindvision.calibration.identifiability import Identifiability, analyse, correlations
from grindvision.calibration.measurements import COVARIANCE_COLUMNS, Measurements, read_measurements
from grindvision.calibration.model import (
    ScannerOnArm,
    Unknowns,
    design_matrix,
    entry_name,
    joint_slopes,
    moved_cell,
    table_entries,
)
from grindvision.calibration.poses import PoseChoice, choose_poses
from grindvision.calibration.robust import consistent_rows
from grindvision.calibration.sphere_centres import find_sphere, noise_clumping
from grindvision.calibration.statistics import ErrorStatistics, error_statistics

__all__ = [
    "COVARIANCE_COLUMNS",
    "Calibration",
    "CoarseCalibration",
    "ErrorStatistics",
    "HeldOut",
    "Identifiability",
    "Measurements",
    "Options",
    "PoseChoice",
    "ScannerOnArm",
    "Spreads",
    "Unknowns",
    "analyse",
    "best_fit",
    "calibrate",
    "choose_poses",
    "coarse_start",
    "consistent_rows",
    "correlations",
    "cross_validated",
    "design_matrix",
    "entry_name",
    "error_statistics",
    "find_sphere",
    "joint_slopes",
    "moved_cell",
    "noise_clumping",
    "noise_covariances",
    "on_test_rows",
    "read_measurements",
    "residuals_of",
    "table_entries",
    "three_point",
    "unit_sizes",
    "whitened_design",
]
