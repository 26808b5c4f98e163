"""Two arms with a laser tracker on the tool: what a calibration leaves on poses that it has not seen."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from grindvision.arm import MdhArm, forward, read_arm
from grindvision.calibration import (
    Calibration,
    Measurements,
    Options,
    calibrate,
    error_statistics,
    on_test_rows,
    residuals_of,
)
from grindvision.calibration.coarse import best_fit
from grindvision.calibration.measurement_files import read_measurements
from grindvision.data_files import data_folder
from grindvision.files import read_table

Floats = NDArray[np.float64]

JOINTS = tuple(f"joint_{i}" for i in range(1, 7))


@dataclass(frozen=True)
class TrackedArm:
    """An arm by its maker's table, and where a tracker saw the reflector on its tool."""

    nominal: MdhArm
    measurements: Measurements


@dataclass(frozen=True)
class ArmErrors:
    """Distances (H,) in mm between measured and computed places on unseen poses.

    ``placed``: base and tool fitted, the arm as its maker has it; ``geometry``: its table too; ``beyond``: gear waves,
    sag and couplings where they lower the error of held-out poses. ``scipy_mean_mm`` is the mean of SciPy's own fit of
    base and tool.
    """

    placed: Floats
    geometry: Floats
    beyond: Floats
    beyond_kind: str
    scipy_mean_mm: float
    calibration: Calibration


def ur5(folder: Path, training: int, seed: int) -> TrackedArm:
    """The UR5: ``training`` of 1,000 poses drawn to fit, the others to test. Measured = commanded + difference."""
    names = [f"{axis}_{part}" for part in ("t", "dif") for axis in "xyz"]
    table = read_table(folder / "ur5_grid.csv", (*names, *JOINTS))
    q_rad = np.radians(table[list(JOINTS)].to_numpy())
    places = table[names[:3]].to_numpy() + table[names[3:]].to_numpy()
    train = np.zeros(len(q_rad), dtype=bool)
    train[np.random.default_rng(seed).permutation(len(q_rad))[:training]] = True
    arm = read_arm(data_folder() / "robots" / "ur5.csv")
    return TrackedArm(arm, Measurements(q_rad, np.zeros_like(places), places, train=train))


def commanded_mean_mm(folder: Path) -> float:
    """Mean length of the differences as the file has them."""
    names = ("x_dif", "y_dif", "z_dif")
    return float(np.linalg.norm(read_table(folder / "ur5_grid.csv", names)[list(names)], axis=1).mean())


def ur10(folder: Path) -> TrackedArm:
    """The UR10: 60 poses to fit and 1,000 to test, as the file marks them."""
    arm = read_arm(folder / "ur10" / "robot.csv")
    return TrackedArm(arm, read_measurements(folder / "ur10" / "measurements.csv", arm.n))


def arm_errors(arm: TrackedArm) -> ArmErrors:
    """Calibrate on the training rows with the package's defaults, and look at the others."""
    rows, train = arm.measurements, arm.measurements.train
    placed = residuals_of(best_fit(rows.rows(train), arm.nominal).cell, rows.rows(~train))
    fit = calibrate(rows, arm.nominal, Options(beyond_geometry=True))
    unseen = on_test_rows(fit)
    beyond = unseen.after_mm if unseen.beyond_mm is None else unseen.beyond_mm
    return ArmErrors(
        np.linalg.norm(placed, axis=1),
        np.linalg.norm(unseen.after_mm, axis=1),
        np.linalg.norm(beyond, axis=1),
        "geometry alone" if fit.beyond is None else fit.beyond.kind,
        scipy_mean_mm(arm),
        fit,
    )


def scipy_mean_mm(arm: TrackedArm) -> float:
    """Mean error on unseen poses when SciPy's plain least squares fits base and tool: nine unknowns, several starts."""
    rows, train = arm.measurements, arm.measurements.train
    flanges = forward(arm.nominal, rows.q_rad)

    def away(unknown: Floats, chosen: NDArray[np.bool_]) -> Floats:
        tool = rows.scanner_mm[chosen] + unknown[6:]
        in_base = np.einsum("nij,nj->ni", flanges[chosen][:, :3, :3], tool) + flanges[chosen][:, :3, 3]
        return Rotation.from_rotvec(unknown[:3]).apply(in_base) + unknown[3:6] - rows.tracker_mm[chosen]

    def fitted(start: Floats, chosen: NDArray[np.bool_]) -> OptimizeResult:
        return least_squares(lambda unknown: away(unknown, chosen).ravel(), start, x_scale="jac")

    starts = [np.concatenate([turn, np.zeros(6)]) for turn in np.pi * np.vstack([np.zeros(3), np.eye(3)])]
    few = train & (np.cumsum(train) % 5 == 0)
    best = fitted(min((fitted(start, few) for start in starts), key=lambda fit: fit.cost).x, train)
    return error_statistics(away(best.x, ~train)).mean
