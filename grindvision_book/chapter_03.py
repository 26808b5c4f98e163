"""What chapter 03 computes: experiments of the virtual cell as measurements, and what only the truth can tell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from grindvision.calibration import (
    Calibration,
    CoarseCalibration,
    Measurements,
    Options,
    ScannerOnArm,
    calibrate,
    error_statistics,
    residuals_of,
    three_point,
)
from grindvision.cell import (
    CalibrationExperiment,
    CalibrationPlan,
    GrindingRobot,
    LaserTracker,
    StructuredLightScanner,
    calibration_plan,
    measured,
    sphere_centre_errors,
)
from grindvision.cell.arms import JOINT_LIMITS_RAD
from grindvision.cell.calibration_scene import LAYER_POSITIONS, LAYERS_MM
from grindvision.cell.spheres import nest_directions
from grindvision.geometry import fit_rigid, inverse, move_points

Floats = NDArray[np.float64]

#: Three spheres of the coarse calibration, seen in one pose: places in the scanner's frame, mm.
COARSE_SPHERES_MM = np.array([[-60.0, -35.0, 390.0], [60.0, -35.0, 410.0], [0.0, 45.0, 400.0]])


def measurements_of(experiment: CalibrationExperiment) -> Measurements:
    """The experiment's table as the calibration takes it."""
    table = experiment.table
    return Measurements(
        table[[f"q{i}_rad" for i in range(1, 5)]].to_numpy(),
        table[["sx_mm", "sy_mm", "sz_mm"]].to_numpy(),
        table[["bx_mm", "by_mm", "bz_mm"]].to_numpy(),
        pose=table["pose"].astype(str).to_numpy(dtype=str),
        sphere=table["sphere"].astype(str).to_numpy(dtype=str),
        train=(table["split"] == "train").to_numpy(),
    )


def coarse_experiment(
    robot: GrindingRobot, tracker: LaserTracker, q_rad: ArrayLike, rng: np.random.Generator
) -> CoarseCalibration:
    """The paper's coarse calibration: one pose (4,), three spheres in the field, their tracker positions, Eq 8."""
    centres = move_points(robot.believed_poses(q_rad), COARSE_SPHERES_MM)
    pose = robot.move(q_rad, rng)
    seen = move_points(inverse(pose), centres)
    down = nest_directions(np.repeat(pose[None], 3, axis=0))
    scanned = seen + sphere_centre_errors(robot.scanner, seen, down, rng)
    return three_point(robot.nominal, q_rad, scanned, tracker.measure(centres, rng))


@dataclass(frozen=True)
class NoiseFree:
    """Readings (M, 3) of spheres at ``centres_base_mm`` without any random error: only the scanner's own bias is left.

    ``robot`` took them at ``q_rad`` (M, 4), every joint exactly where it was told to be.
    """

    robot: GrindingRobot
    q_rad: Floats
    scanner_mm: Floats
    centres_base_mm: Floats

    def errors_mm(self, cell: ScannerOnArm, tracker: LaserTracker) -> Floats:
        """How far (M,) from the truth a calibrated cell puts the spheres."""
        truth = move_points(tracker.T_tracker_base, self.centres_base_mm)
        return np.linalg.norm(cell.points_tracker(self.q_rad, self.scanner_mm) - truth, axis=1)

    def best_cell(self, tracker: LaserTracker) -> ScannerOnArm:
        """The true arm and tracker with the scanner where its readings fit best: no calibration can do better."""
        poses = self.robot.exact_poses(self.q_rad)
        seen = np.einsum("mji,mj->mi", poses[:, :3, :3], self.centres_base_mm - poses[:, :3, 3])
        bias = fit_rigid(self.scanner_mm, seen).T_target_source
        return ScannerOnArm(self.robot.true, self.robot.T_joint4_scanner @ bias, tracker.T_tracker_base)


def noise_free(robot: GrindingRobot, q_rad: ArrayLike, centres_base_mm: ArrayLike) -> NoiseFree:
    """What the robot would read at joint angles (M, 4) of spheres at (M, 3) if nothing were random."""
    q, centres = np.asarray(q_rad, dtype=float), np.asarray(centres_base_mm, dtype=float)
    poses = robot.exact_poses(q)
    seen = np.einsum("mji,mj->mi", poses[:, :3, :3], centres - poses[:, :3, 3])
    errors = replace(robot.scanner.errors, white_mm=0.0, triangulation_px=0.0, correlated_px=0.0)
    quiet = replace(robot.scanner, errors=errors)
    bias = sphere_centre_errors(quiet, seen, nest_directions(poses), np.random.default_rng(0))
    return NoiseFree(robot, q, seen + bias, centres)


def random_readings(robot: GrindingRobot, count: int, rng: np.random.Generator) -> NoiseFree:
    """Noise-free readings at ``count`` random poses all over the workspace that look down at a sphere in the field."""
    low, high = JOINT_LIMITS_RAD.T
    q = rng.uniform(low, high, (8 * count, 4))
    q = q[robot.believed_poses(q)[:, 2, 2] < -0.5][:count]
    poses = robot.exact_poses(q)
    places = rng.uniform([-70, -45, 370], [70, 45, 430], (len(q), 3))
    return noise_free(robot, q, np.einsum("mij,mj->mi", poses[:, :3, :3], places) + poses[:, :3, 3])


@lru_cache(maxsize=2)
def poses_in_the_measuring_space(count: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Joint angles (count, 4) and sphere centres (count, 3) at random in the space that the paper's spheres span."""
    robot, rng = first_robot(), np.random.default_rng(seed)
    azimuths, reaches = np.radians([a for a, _ in LAYER_POSITIONS]), [r for _, r in LAYER_POSITIONS]
    low, high = JOINT_LIMITS_RAD.T
    low, high = np.append([azimuths.min() - 0.3], low[1:]), np.append([azimuths.max() + 0.3], high[1:])
    angles, centres, found = [], [], 0
    while found < count:
        q = rng.uniform(low, high, (50_000, 4))
        places = rng.uniform([-70, -45, 370], [70, 45, 430], (len(q), 3))
        poses = robot.believed_poses(q)
        x, y, z = centre = np.einsum("mij,mj->im", poses[:, :3, :3], places) + poses[:, :3, 3].T
        azimuth, reach = np.arctan2(y, x), np.hypot(x, y)
        inside = (azimuth > azimuths.min()) & (azimuth < azimuths.max()) & (poses[:, 2, 2] < -0.5)
        inside &= (reach > min(reaches)) & (reach < max(reaches)) & (z > min(LAYERS_MM)) & (z < max(LAYERS_MM))
        angles.append(q[inside])
        centres.append(centre.T[inside])
        found += int(inside.sum())
    return np.concatenate(angles)[:count], np.concatenate(centres)[:count]


def robot_number(serial: int) -> GrindingRobot:
    """The robot with another scanner of the same make: another field distortion, another scale error."""
    return replace(first_robot(), scanner=StructuredLightScanner(serial=serial))


@lru_cache(maxsize=1)
def first_robot() -> GrindingRobot:
    """The robot of the book: nominal arm, its true errors, and the first scanner of its make."""
    return GrindingRobot()


def aligned_tracker(quiet: bool = False) -> LaserTracker:
    """A tracker whose frame is the arm's base, as the paper takes it; ``quiet``: without noise."""
    return LaserTracker(np.eye(4), fixed_um=0.0, per_metre_um=0.0) if quiet else LaserTracker(np.eye(4))


@lru_cache(maxsize=4)
def paper_plan(seed: int = 0) -> CalibrationPlan:
    """The paper's 9 spheres x 6 directions to train with and 10 x 6 to test with, for the nominal arm."""
    return calibration_plan(first_robot(), np.random.default_rng(seed))


def calibration_trial(rng: np.random.Generator, plan_seed: int = 0) -> dict[str, float]:
    """Experiments 2 and 3 once, with a scanner drawn anew: errors in mm of every method, and what the truth says.

    ``floor``: held-out mean of the best cell possible. ``true_here``, ``true_everywhere``: mean distance from the truth
    without measurement noise, in the measuring space and over the whole workspace. ``covered`` of ``known`` parameters
    lie within one stated standard deviation.
    """
    robot, tracker, plan = robot_number(int(rng.integers(2**31))), aligned_tracker(), paper_plan(plan_seed)
    coarse = coarse_experiment(robot, tracker, plan.q_rad[0], rng).cell
    measurements = measurements_of(measured(plan, robot, tracker, rng, every=None))
    ours = calibrate(measurements, robot.nominal, Options(base_fixed=True), coarse)
    printed = calibrate(measurements, robot.nominal, Options(base_fixed=True, variant="paper"), coarse)
    test = measurements.rows(~measurements.train)
    there = random_readings(robot, 120, np.random.default_rng(0))
    here = noise_free(robot, *poses_in_the_measuring_space(120))
    inside = within_one_std(ours, robot)
    error = ours.errors(train=False)
    return {
        "coarse": ours.errors(train=False, before=True).mean,
        "mean": error.mean,
        "max": error.max,
        "std": error.std,
        "train": ours.errors(train=True).mean,
        "paper_variant": printed.errors(train=False).mean,
        "floor": error_statistics(residuals_of(here.best_cell(tracker), test)).mean,
        "true_here": float(here.errors_mm(ours.cell, tracker).mean()),
        "true_everywhere": float(there.errors_mm(ours.cell, tracker).mean()),
        "true_paper_variant": float(here.errors_mm(printed.cell, tracker).mean()),
        "covered": int(inside.sum()),
        "known": len(inside),
    }


def within_one_std(calibration: Calibration, robot: GrindingRobot) -> NDArray[np.bool_]:
    """Flags of the knowable entries of the MDH table, and of d2 + d3: does the truth lie within one stated std?"""
    unknowns = calibration.unknowns
    error = (calibration.arm.table - robot.true.table).ravel()[list(unknowns.table)]
    known = calibration.identifiability.known[unknowns.in_table]
    std = calibration.std[unknowns.in_table]
    total = parallel_offsets(calibration)
    off = total[0] - (robot.true.table - robot.nominal.table)[1:3, 2].sum()
    return np.append(np.abs(error[known]) <= std[known], abs(off) <= total[1])


def parallel_offsets(calibration: Calibration) -> tuple[float, float]:
    """Change of d2 + d3 and its standard deviation, mm: all that can be known of the two."""
    both = np.isin(calibration.unknowns.names, ("d2_mm", "d3_mm")).astype(float)
    return float(both @ calibration.values), float(np.sqrt(both @ calibration.covariance @ both))


def without(robot: GrindingRobot, *sources: str) -> GrindingRobot:
    """The robot with some error sources off: ``scanner noise``, ``scanner bias``, ``joints``."""
    errors, joints = robot.scanner.errors, robot.joint_noise_deg
    for source in sources:
        if source == "joints":
            joints = 0.0
        elif source == "scanner noise":
            errors = replace(errors, white_mm=0.0, triangulation_px=0.0, correlated_px=0.0, mixed_pixels=0.0)
        else:
            errors = replace(errors, distortion_mm=0.0, scale=0.0)
    return replace(robot, scanner=replace(robot.scanner, errors=errors), joint_noise_deg=joints)


def matrix_table(**matrices: ArrayLike) -> pd.DataFrame:
    """Transforms (4, 4) below each other: name, row, three rotation columns and the shift in mm."""
    parts = []
    for name, matrix in matrices.items():
        rows = pd.DataFrame(np.asarray(matrix, dtype=float)[:3], columns=["x", "y", "z", "shift_mm"])
        rows.insert(0, "row", [1, 2, 3])
        rows.insert(0, "matrix", name.replace("_", ", "))
        parts.append(rows)
    return pd.concat(parts, ignore_index=True)
