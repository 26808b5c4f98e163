"""The calibration experiment of diao2018: spheres in layers, measured from several directions and by a tracker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from grindvision.arm import joint_twists, moved_by_twist
from grindvision.cell.arms import JOINT_LIMITS_RAD, GrindingRobot, LaserTracker
from grindvision.cell.spheres import SPHERE_RADIUS_MM, measure_sphere, nest_directions, sphere_centre_errors
from grindvision.errors import InputError, SightError
from grindvision.geometry import inverse, small_motion
from grindvision.records import by_content

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Heights of the three layers of training spheres, base frame, mm; the test spheres lie half-way between them.
LAYERS_MM = (-100.0, 0.0, 100.0)

#: Azimuth in degrees and distance in mm from joint 1 of the three positions in a layer.
LAYER_POSITIONS = ((-80.0, 560.0), (-50.0, 660.0), (-20.0, 560.0))


@by_content
@dataclass(frozen=True)
class CalibrationPlan:
    """Who measures what from where: one row per measurement.

    ``centres_mm`` (S, 3) true sphere centres in the base frame; ``sphere`` (K,) index into them; ``q_rad`` (K, 4)
    commanded joint angles; ``train`` (K,) marks the rows to calibrate with.
    """

    centres_mm: Floats
    sphere: Integers
    q_rad: Floats
    train: NDArray[np.bool_]

    def __str__(self) -> str:
        return (
            f"{len(self.centres_mm)} spheres, {int(self.train.sum())} measurements to calibrate with,"
            f" {int((~self.train).sum())} to test with"
        )


@by_content
@dataclass(frozen=True)
class CalibrationExperiment:
    """A measurement table as ``grindvision calibrate`` reads it, and the truth behind it.

    ``table``: pose, sphere, q1_rad..q4_rad (commanded), sx_mm..sz_mm (measured centre, scanner frame), bx_mm..bz_mm
    (tracker frame), split (train or test). Truth, one row per measurement: ``centres_base_mm`` (K, 3) and
    ``T_base_scanner`` (K, 4, 4) with the joint noise of that move; ``robot`` and ``tracker`` hold the rest.
    """

    table: pd.DataFrame
    plan: CalibrationPlan
    robot: GrindingRobot
    tracker: LaserTracker
    centres_base_mm: Floats
    T_base_scanner: Floats

    def __str__(self) -> str:
        return f"calibration experiment: {self.plan}"


def calibration_plan(
    robot: GrindingRobot, rng: np.random.Generator, spheres: int = 9, directions: int = 6, test_spheres: int = 10
) -> CalibrationPlan:
    """Place spheres as diao2018 does and find joint angles that see each from ``directions`` well spread directions.

    Training spheres: three positions on each of three layers (the first ``spheres`` of these nine, layer by layer; more
    than nine are placed at random between the layers). Test spheres: at random on the two intermediate layers.

    Raises:
        InputError: fewer than one sphere or direction. SightError: a sphere cannot be seen from so many directions.
    """
    for name, count, least in (
        ("spheres", spheres, 1),
        ("directions", directions, 1),
        ("test_spheres", test_spheres, 0),
    ):
        if count < least:
            raise InputError(f"{name} is {count}; at least {least} needed")
    layered = [_at(azimuth, reach, z) for z in LAYERS_MM for azimuth, reach in LAYER_POSITIONS][:spheres]
    azimuths, reaches = zip(*LAYER_POSITIONS, strict=True)
    between = (np.array(LAYERS_MM[:-1]) + np.array(LAYERS_MM[1:])) / 2

    def anywhere(number: int) -> Floats:
        return _at(
            rng.uniform(min(azimuths), max(azimuths)), rng.uniform(min(reaches), max(reaches)), between[number % 2]
        )

    extra = [anywhere(i) for i in range(spheres - len(layered))]
    centres = np.array(layered + extra + [anywhere(i) for i in range(test_spheres)])
    q_rad = np.concatenate([directions_seeing(robot, centre, directions, rng) for centre in centres])
    sphere = np.repeat(np.arange(len(centres)), directions)
    return CalibrationPlan(centres, sphere, q_rad, sphere < spheres)


def directions_seeing(
    robot: GrindingRobot, centre_base_mm: ArrayLike, count: int, rng: np.random.Generator, tries: int = 300
) -> Floats:
    """Joint angles (count, 4) within the limits that see a sphere whole from above, from well spread directions.

    The choice uses only what the controller believes: for a random place of the sphere in the field, 370 to 430 mm
    away, and a random joint 4, the joints 1 to 3 that bring it there. Of what is found each next one is the farthest in
    direction and roll from those chosen.

    Raises:
        SightError: fewer than ``count`` such joint angles were found.
    """
    centre = np.asarray(centre_base_mm, dtype=float)
    half = np.array([robot.scanner.columns, robot.scanner.rows]) / 2 / robot.scanner.focal_px
    place = rng.uniform(-1, 1, (tries, 3))
    place[:, 2] = robot.scanner.reference_mm + 30 * place[:, 2]
    place[:, :2] *= half * place[:, 2:] - 1.3 * SPHERE_RADIUS_MM
    low, high = JOINT_LIMITS_RAD.T
    q = rng.uniform(low, high, (tries, 4))
    q[:, 0] = np.arctan2(centre[1], centre[0]) + rng.uniform(-0.3, 0.3, tries)
    for _ in range(25):
        poses = robot.believed_poses(q)
        reached = np.einsum("kij,kj->ki", poses[:, :3, :3], place) + poses[:, :3, 3]
        slopes = moved_by_twist(joint_twists(robot.nominal, q), reached)[:, :, :3]
        damped = np.swapaxes(slopes, 1, 2) @ slopes + 100.0 * np.eye(3)
        step = np.linalg.solve(damped, np.einsum("kij,ki->kj", slopes, centre - reached)[:, :, None])[:, :, 0]
        q[:, :3] += np.clip(step, -0.3, 0.3)
    poses = robot.believed_poses(q)
    missed = np.linalg.norm(np.einsum("kij,kj->ki", poses[:, :3, :3], place) + poses[:, :3, 3] - centre, axis=1)
    good = (missed < 1.0) & (q >= low).all(axis=1) & (q <= high).all(axis=1) & (poses[:, 2, 2] < -0.3)
    q, poses = q[good], poses[good]
    if len(q) < count:
        place_mm = ", ".join(f"{value:.0f}" for value in centre)
        raise SightError(
            f"the sphere at ({place_mm}) mm can be seen from {len(q)} of {tries} directions"
            f" tried, {count} are needed; place it nearer to the arm"
        )
    axes = np.concatenate([poses[:, :3, 2], 0.3 * poses[:, :3, 0]], axis=1)
    chosen = [int(rng.integers(len(q)))]
    distance = np.full(len(q), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(axes - axes[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return q[chosen]


def measured(
    plan: CalibrationPlan,
    robot: GrindingRobot,
    tracker: LaserTracker,
    rng: np.random.Generator,
    every: int | None = 3,
) -> CalibrationExperiment:
    """Carry a plan out: every row is one move of the arm and one scan; the tracker measures each sphere once.

    With ``every`` (pixel step) each sphere is scanned, cut out and fitted (about 10 ms). With ``every=None`` the
    centre's error comes from ``sphere_centre_errors`` (about 0.3 ms), which leaves out mixed pixels and disparity
    steps.
    """
    centres = plan.centres_mm[plan.sphere]
    if every is None:
        poses = robot.move(plan.q_rad, rng)
        T_scanner_base = inverse(poses)
        true = (centres[:, None] @ np.swapaxes(T_scanner_base[:, :3, :3], 1, 2))[:, 0] + T_scanner_base[:, :3, 3]
        scanned = true + sphere_centre_errors(robot.scanner, true, nest_directions(poses), rng)
    else:
        poses, scanned = np.empty((len(centres), 4, 4)), np.empty((len(centres), 3))
        for row, (q, centre) in enumerate(zip(plan.q_rad, centres, strict=True)):
            fit = measure_sphere(robot, q, centre, rng, every)
            poses[row], scanned[row] = fit.T_base_scanner, fit.centre_mm
    tracked = tracker.measure(plan.centres_mm, rng)[plan.sphere]
    columns = np.column_stack([plan.q_rad, scanned, tracked])
    names = [f"q{i}_rad" for i in range(1, 5)] + [f"{frame}{axis}_mm" for frame in "sb" for axis in "xyz"]
    table = pd.DataFrame(columns, columns=names)
    table.insert(0, "pose", np.arange(1, len(table) + 1))
    table.insert(1, "sphere", plan.sphere + 1)
    table["split"] = np.where(plan.train, "train", "test")
    return CalibrationExperiment(table, plan, robot, tracker, centres, poses)


def misaligned_tracker(
    rng: np.random.Generator, translation_mm: float = 0.3, rotation_deg: float = 0.02
) -> LaserTracker:
    """A tracker whose frame was laid into the arm's base, but is off by about ``translation_mm`` and
    ``rotation_deg``."""
    twist = np.concatenate([rng.normal(0, translation_mm, 3), rng.normal(0, np.radians(rotation_deg), 3)])
    return LaserTracker(small_motion(twist))


def calibration_experiment(
    rng: np.random.Generator,
    spheres: int = 9,
    directions: int = 6,
    test_spheres: int = 10,
    robot: GrindingRobot | None = None,
    tracker: LaserTracker | None = None,
    every: int | None = 3,
) -> CalibrationExperiment:
    """Experiments 2 and 3 of diao2018: plan, moves, scans and tracker readings in one go; see ``measured``.

    Raises:
        InputError: counts below one. SightError: a sphere cannot be seen from so many directions.
    """
    robot = robot or GrindingRobot()
    tracker = tracker or misaligned_tracker(rng)
    return measured(calibration_plan(robot, rng, spheres, directions, test_spheres), robot, tracker, rng, every)


def _at(azimuth_deg: float, reach_mm: float, z_mm: float) -> Floats:
    angle = np.radians(azimuth_deg)
    return np.array([reach_mm * np.cos(angle), reach_mm * np.sin(angle), z_mm])
