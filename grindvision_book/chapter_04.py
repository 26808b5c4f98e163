"""What chapter 04 repeats: calibrations with one error source, and with poses chosen in other ways."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.calibration import (
    Calibration,
    Measurements,
    Options,
    PoseChoice,
    PredictedErrors,
    ScannerOnArm,
    Sigmas,
    Unknowns,
    calibrate,
    choose_poses,
    on_test_rows,
    suggest_poses,
    table_entries,
    unit_sizes,
    whitened_jacobian,
)
from grindvision.calibration.uncertainty import MEAN_OF_RMS
from grindvision.cell import (
    CalibrationPlan,
    GrindingRobot,
    directions_seeing,
    drawn_joint_errors,
    measured,
)
from grindvision.cell.joint_errors import JointErrors
from grindvision.errors import SightError
from grindvision_book.chapter_03 import (
    NoiseFree,
    aligned_tracker,
    coarse_experiment,
    first_robot,
    measurements_of,
    noise_free,
    paper_plan,
    poses_in_the_measuring_space,
    random_readings,
    robot_number,
    without,
)


def source_trial(rng: np.random.Generator, source: str) -> dict[str, float]:
    """Mean squared held-out error in mm squared with one error source on (``all``: every one of them)."""
    robot, plan = robot_number(int(rng.integers(2**31))), paper_plan()
    off = [other for other in ("scanner noise", "scanner bias", "joints") if source not in (other, "all")]
    tracker = aligned_tracker(quiet=source not in ("tracker", "all"))
    measurements = measurements_of(measured(plan, without(robot, *off), tracker, rng, every=None))
    fit = calibrate(measurements, robot.nominal, Options(base_fixed=True, diagnose=False))
    return {"squared": fit.errors(train=False).rms ** 2}


def rig_trial(
    rng: np.random.Generator,
    joint_noise_deg: float = 0.003,
    gear_waves_deg: float = 0.0,
    drift_mm: float = 0.0,
    nest_mm: float = 0.0,
    distortion: float = 1.0,
) -> dict[str, float]:
    """Held-out errors in mm by the printed method on a rig that is worse than its parts promise: ``mean, max, std``.

    Args:
        joint_noise_deg: standard deviation of a joint about its commanded angle; 0.003 is the data sheet's.
        gear_waves_deg: rms of the error of each joint's gear, one and two waves a turn, the same in every move.
        drift_mm: how far the arm's base moves against the tracker from the first measurement to the last.
        nest_mm: standard deviation, per axis, of a sphere's place in the nest of the tracker's reflector.
        distortion: the scanner's field distortion, in units of the twin's.
    """
    robot, plan, tracker = robot_number(int(rng.integers(2**31))), paper_plan(), aligned_tracker()
    errors, n = robot.scanner.errors, robot.true.n
    waves = np.radians(gear_waves_deg) * rng.standard_normal((n, 2, 2)) / np.sqrt(2)
    robot = replace(
        robot,
        joint_noise_deg=joint_noise_deg,
        joint_errors=JointErrors(robot.true, waves, np.zeros(n), np.zeros(n), np.zeros((n, 3))),
        scanner=robot.scanner.with_errors(replace(errors, distortion_mm=distortion * errors.distortion_mm)),
    )
    coarse = coarse_experiment(robot, tracker, plan.q_rad[0], rng).cell
    measurements = measurements_of(measured(plan, robot, tracker, rng, every=None))
    way = rng.standard_normal(3)
    drift = np.linspace(0, drift_mm, len(measurements))[:, None] * way / np.linalg.norm(way)
    nests = nest_mm * rng.standard_normal((len(plan.centres_mm), 3))[plan.sphere]
    moved = replace(measurements, tracker_mm=measurements.tracker_mm + drift + nests)
    fit = calibrate(moved, robot.nominal, Options(base_fixed=True, variant="paper"), coarse)
    found = fit.errors(train=False)
    return {"mean": found.mean, "max": found.max, "std": found.std}


#: Sizes of each cause that are tried alone in ``rig_trial``.
CAUSES = {
    "joint_noise_deg": (0.006, 0.008, 0.009, 0.010, 0.012),
    "gear_waves_deg": (0.01, 0.02, 0.025, 0.03),
    "drift_mm": (0.1, 0.2, 0.3),
    "nest_mm": (0.03, 0.06, 0.09),
    "distortion": (1.5, 2.0, 3.0, 4.0),
}


def pose_trial(rng: np.random.Generator, choice: str, count: int, spheres: int) -> dict[str, float]:
    """True error in mm over the workspace after ``count`` poses: ``optimal``, ``random`` or the paper's ``regular``."""
    robot, tracker = robot_number(int(rng.integers(2**31))), aligned_tracker()
    plan = paper_plan() if choice == "regular" else candidate_poses(spheres)
    if choice == "optimal":
        rows = optimal_poses(spheres, count).chosen
    else:
        rows = rng.choice(np.flatnonzero(plan.train), count, replace=False)
    measurements = measurements_of(measured(part_of(plan, rows), robot, tracker, rng, every=None))
    fit = calibrate(measurements, robot.nominal, Options(base_fixed=True, diagnose=False))
    there = random_readings(robot, 120, np.random.default_rng(0))
    return {"true": float(there.errors_mm(fit.cell, tracker).mean())}


@lru_cache(maxsize=2)
def candidate_poses(spheres: int, seed: int = 4) -> CalibrationPlan:
    """Poses all over the reach to choose from: ``spheres`` places, eight directions each."""
    robot, rng = first_robot(), np.random.default_rng(seed)
    q: list[NDArray[np.float64]] = []
    centres: list[NDArray[np.float64]] = []
    while len(q) < spheres:
        azimuth, reach, height = rng.uniform([-2.9, 350, -250], [2.9, 850, 350])
        centre = np.array([reach * np.cos(azimuth), reach * np.sin(azimuth), height])
        try:
            q.append(directions_seeing(robot, centre, 8, rng))
        except SightError:
            continue
        centres.append(centre)
    number = np.repeat(np.arange(spheres), 8)
    return CalibrationPlan(np.array(centres), number, np.concatenate(q), np.ones(len(number), dtype=bool))


def part_of(plan: CalibrationPlan, rows: ArrayLike) -> CalibrationPlan:
    """The plan's ``rows`` alone, all of them to train with."""
    rows = np.asarray(rows)
    return CalibrationPlan(plan.centres_mm, plan.sphere[rows], plan.q_rad[rows], np.ones(len(rows), dtype=bool))


@lru_cache(maxsize=16)
def optimal_poses(spheres: int, count: int) -> PoseChoice:
    """D-optimal choice of ``count`` candidates, with the nominal cell and the noise foreseen: nothing of the truth."""
    robot, plan = first_robot(), candidate_poses(spheres)
    cell = ScannerOnArm(robot.nominal, robot.T_joint4_scanner_nominal, np.eye(4))
    poses, centres = robot.believed_poses(plan.q_rad), plan.centres_mm[plan.sphere]
    seen = np.einsum("mji,mj->mi", poses[:, :3, :3], centres - poses[:, :3, 3])
    foreseen = Measurements(plan.q_rad, seen, centres)
    unknowns = Unknowns(6, table_entries(robot.nominal), 0)
    spreads = Sigmas(0.02, np.radians(robot.joint_noise_deg), 1.0, 1.0)
    rows = whitened_jacobian(cell, unknowns, foreseen, spreads) * unit_sizes(foreseen, unknowns)
    return choose_poses(rows.reshape(len(foreseen), 3, -1), count, np.random.default_rng(0))


@dataclass(frozen=True)
class Elsewhere:
    """A calibration with its robot, judged where it was measured (``here``) and all over the workspace (``there``)."""

    robot: GrindingRobot
    measurements: Measurements
    fit: Calibration
    here: NoiseFree
    there: NoiseFree

    def predicted_mm(self, at: NoiseFree) -> NDArray[np.float64]:
        """Mean error (M,) in mm that the calibration predicts at readings, from what it was fitted to alone."""
        return MEAN_OF_RMS * self.fit.predicted_rms_mm(at.q_rad, at.scanner_mm)

    def true_mm(self, at: NoiseFree) -> NDArray[np.float64]:
        """Distances (M,) from the truth in mm at readings."""
        return at.errors_mm(self.fit.cell, aligned_tracker())

    def suggested(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Joint angles (count, n) that would lower the predicted error over the workspace most."""
        train = self.measurements.rows(self.measurements.train)
        there = PredictedErrors(
            self.there.q_rad,
            self.there.centres_base_mm,
            self.fit.predicted_rms_mm(self.there.q_rad, self.there.scanner_mm),
            self.fit.predicted_rms_mm(train.q_rad, train.scanner_mm),
            "over the workspace, looking down",
        )
        return suggest_poses(self.fit, there, count, rng).q_rad

    def with_more(self, q_rad: ArrayLike, rng: np.random.Generator) -> Elsewhere:
        """The calibration again with a sphere measured at each of some more joint angles (M, n), the cell alone."""
        q = np.asarray(q_rad, dtype=float)
        poses = self.robot.believed_poses(q)
        centres = poses[:, :3, 3] + 400.0 * poses[:, :3, 2]
        plan = CalibrationPlan(centres, np.arange(len(q)), q, np.ones(len(q), dtype=bool))
        more = measurements_of(measured(plan, self.robot, aligned_tracker(), rng, every=None))
        old, names = self.measurements, [f"more {i}" for i in range(len(q))]
        measurements = Measurements(
            np.vstack([old.q_rad, more.q_rad]),
            np.vstack([old.scanner_mm, more.scanner_mm]),
            np.vstack([old.tracker_mm, more.tracker_mm]),
            np.append(old.pose, names),
            np.append(old.sphere, names),
            train=np.append(old.train, more.train),
        )
        fit = calibrate(measurements, self.robot.nominal, Options(base_fixed=True, diagnose=False))
        return replace(self, measurements=measurements, fit=fit)


def elsewhere(rng: np.random.Generator, worn: bool = True, readings: int = 400) -> Elsewhere:
    """The paper's calibration of an arm, ``worn``: whose gears wave and whose links sag, with both places to judge it.

    Args:
        rng: draws the scanner, the wear and the noise.
        worn: see above; else the twin, whose joints err at random alone.
        readings: over the workspace.
    """
    robot, plan = robot_number(int(rng.integers(2**31))), paper_plan()
    if worn:
        robot = replace(robot, joint_errors=drawn_joint_errors(robot.true, rng))
    measurements = measurements_of(measured(plan, robot, aligned_tracker(), rng, every=None))
    fit = calibrate(measurements, robot.nominal, Options(base_fixed=True))
    here = noise_free(robot, *poses_in_the_measuring_space(120))
    return Elsewhere(robot, measurements, fit, here, random_readings(robot, readings, np.random.default_rng(0)))


def elsewhere_trial(rng: np.random.Generator, worn: bool, more: int = 12) -> dict[str, float]:
    """Mean errors in mm here and there, as predicted and true, and true ones after ``more`` poses were measured.

    ``held_out`` is what the paper's test spheres say, noise of measuring included.
    """
    found = elsewhere(rng, worn)
    held_out = on_test_rows(found.fit).after.mean
    chosen = found.with_more(found.suggested(more, rng), rng)
    at_random = found.with_more(random_readings(found.robot, more, rng).q_rad, rng)
    return {
        "held_out": held_out,
        "predicted_here": float(found.predicted_mm(found.here).mean()),
        "true_here": float(found.true_mm(found.here).mean()),
        "predicted_there": float(found.predicted_mm(found.there).mean()),
        "true_there": float(found.true_mm(found.there).mean()),
        "suggested_there": float(chosen.true_mm(chosen.there).mean()),
        "random_there": float(at_random.true_mm(at_random.there).mean()),
    }
