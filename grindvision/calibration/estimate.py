"""Weighted, regularised Gauss-Newton on the error model, and how large noise and parameter deviations really are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import CarriedPoints, ScannerOnArm, Unknowns, carry
from grindvision.calibration.statistics import whitening

Floats = NDArray[np.float64]

#: Below these the spreads count as zero: far under any instrument, far above rounding.
SMALLEST_MM, SMALLEST_RAD = 1e-9, 1e-12

#: A table's lengths (mm) and angles (rad) are never taken for more exact than this, however well the nominal ones fit:
#: a smaller learnt prior makes single parameters look surer than they are.
LEAST_DEVIATION = (0.2, 4e-4)
_MOST_DEVIATION = (100.0, 0.2)


@dataclass(frozen=True)
class Spreads:
    """Standard deviations that decide the weights: of what is measured, and of what the MDH table may deviate by.

    ``rest_mm``: isotropic noise per axis on top of the covariances that the measurements bring; ``joint_rad``:
    repeatability of each joint; ``length_mm`` and ``angle_rad``: deviations of the table's lengths and angles from
    the nominal ones.
    """

    rest_mm: float
    joint_rad: float
    length_mm: float
    angle_rad: float

    def __str__(self) -> str:
        return (
            f"noise {self.rest_mm:.4f} mm per axis, joints {np.degrees(self.joint_rad):.4f} deg;"
            f" arm deviates {self.length_mm:.3f} mm and {np.degrees(self.angle_rad):.4f} deg"
        )


def unit_sizes(measurements: Measurements, unknowns: Unknowns) -> Floats:
    """What counts as one unit of each unknown (K,): 1 mm, and the angle that moves a far point by 1 mm.

    Columns in mm and columns in rad can only be compared after this explicit scaling; the far distance is the rms
    spread of the measured points plus the rms distance of the spheres from the scanner.
    """
    spread = measurements.tracker_mm - measurements.tracker_mm.mean(axis=0)
    far = np.sqrt((spread**2).sum(axis=1).mean()) + np.sqrt((measurements.scanner_mm**2).sum(axis=1).mean())
    return np.where(unknowns.is_angle, 1 / max(far, 1.0), 1.0)


def noise_covariances(cell: ScannerOnArm, measurements: Measurements, spreads: Spreads) -> Floats:
    """Covariance (M, 3, 3) of each residual in the tracker's frame: sphere fit, tracker, joints and the rest."""
    noise = _noise_covariances(_carried(cell, measurements), measurements, spreads)
    return np.broadcast_to(noise, (len(measurements), 3, 3))


def residuals_of(cell: ScannerOnArm, measurements: Measurements) -> Floats:
    """Measured minus predicted points (M, 3) in the tracker's frame, X_B^R - X_B of Eq 16."""
    return measurements.tracker_mm - cell.points_tracker(measurements.q_rad, measurements.scanner_mm)


def prior_widths(unknowns: Unknowns, spreads: Spreads) -> Floats:
    """Prior standard deviation (K,) of each unknown: the spreads for table entries, infinite for scanner and base."""
    widths = np.where(unknowns.is_angle, spreads.angle_rad, spreads.length_mm)
    return np.where(unknowns.in_table, widths, np.inf)


def whitened_design(cell: ScannerOnArm, unknowns: Unknowns, measurements: Measurements, spreads: Spreads) -> Floats:
    """Design matrix (3 M, K) whose rows are scaled to unit noise."""
    points = _carried(cell, measurements)
    noise = _noise_covariances(points, measurements, spreads)
    return (whitening(noise) @ points.design(unknowns)).reshape(-1, len(unknowns))


def posterior_covariance(
    cell: ScannerOnArm, unknowns: Unknowns, measurements: Measurements, spreads: Spreads
) -> Floats:
    """Covariance (K, K) of the unknowns from noise and priors; zero in directions that neither of them holds."""
    units = unit_sizes(measurements, unknowns)
    rows = whitened_design(cell, unknowns, measurements, spreads) * units
    information = rows.T @ rows + np.diag((units / prior_widths(unknowns, spreads)) ** 2)
    return np.linalg.pinv(information, rcond=1e-15, hermitian=True) * np.outer(units, units)


def deviations(cell: ScannerOnArm, nominal: MdhArm, unknowns: Unknowns) -> Floats:
    """Deviation (K,) of the cell's table from the nominal one; zero for scanner and base, which have none."""
    values = np.zeros(len(unknowns))
    values[unknowns.in_table] = (cell.arm.table - nominal.table).ravel()[list(unknowns.table)]
    return values


def gauss_newton(
    cell: ScannerOnArm,
    nominal: MdhArm,
    unknowns: Unknowns,
    measurements: Measurements,
    spreads: Spreads,
    robust: bool = False,
    iterations: int = 50,
) -> tuple[ScannerOnArm, int, bool]:
    """Move the cell to the least weighted squares of residuals and deviations; the cell, steps taken, converged or not.

    Directions that neither data nor priors hold are left where they are (smallest step). ``robust`` weights each row
    down by Cauchy's function of its residual, so that some wildly wrong rows do not matter.
    """
    units, widths = unit_sizes(measurements, unknowns), prior_widths(unknowns, spreads)

    def weighted(at: CarriedPoints) -> tuple[Floats, Floats, Floats, float]:
        to_unit = whitening(_noise_covariances(at, measurements, spreads))
        whitened = np.einsum("mij,mj->mi", to_unit, measurements.tracker_mm - at.tracker_mm)
        if robust:
            length = np.linalg.norm(whitened, axis=1)
            ratio = length / (2.4 * max(np.median(length) / 1.54, 1e-300))
            weight, cost = 1 / np.sqrt(1 + ratio**2), np.log1p(ratio**2).sum()
        else:
            weight, cost = np.ones(len(whitened)), (whitened**2).sum()
        pull = deviations(at.cell, nominal, unknowns) / widths
        cost = float(cost + (0 if robust else pull @ pull))
        return to_unit * weight[:, None, None], whitened * weight[:, None], pull, cost

    points = _carried(cell, measurements)
    to_unit, goal, pull, cost = weighted(points)
    for step_number in range(1, iterations + 1):
        triangle = _triangle(points, unknowns, to_unit, goal, units)
        rows = np.vstack([triangle[:, :-1], np.diag(units / widths)])
        step = np.linalg.lstsq(rows, np.concatenate([triangle[:, -1], -pull]), rcond=1e-12)[0]
        for _ in range(12):
            trial = points.moved(unknowns, step * units)
            to_unit, goal, pull, trial_cost = weighted(trial)
            if robust or trial_cost <= cost * (1 + 1e-9) or np.abs(step).max() < 1e-7:
                break
            step = step / 2
        points, cost = trial, trial_cost
        if np.abs(step).max() < 1e-10:
            return points.cell, step_number, True
    return points.cell, iterations, bool(np.abs(step).max() < 1e-6)


def estimate_spreads(
    cell: ScannerOnArm,
    nominal: MdhArm,
    unknowns: Unknowns,
    measurements: Measurements,
    start: Spreads,
    fixed_length_mm: float | None = None,
    fixed_angle_rad: float | None = None,
    iterations: int = 60,
) -> Spreads:
    """Spreads under which the residuals are most likely, scanner and base integrated out (restricted likelihood).

    The error model is linear here, so four variances are found by minorise-maximise steps: each is multiplied by the
    square root of the ratio of the squares it explains to the squares it expects. No step can lower the likelihood.
    """
    units = unit_sizes(measurements, unknowns)
    points = _carried(cell, measurements)
    design, slopes = points.design(unknowns) * units, points.slopes()
    residuals = measurements.tracker_mm - points.tracker_mm
    observed = residuals + design @ (deviations(cell, nominal, unknowns) / units)
    known = _known_covariances(points, measurements)
    groups = [unknowns.in_table & ~unknowns.is_angle, unknowns.in_table & unknowns.is_angle]
    size = len(unknowns)
    fixed = [fixed_length_mm, fixed_angle_rad]
    spreads = start
    for _ in range(iterations):
        to_unit = whitening(known + _noise(slopes, spreads))
        noises = (to_unit, to_unit @ slopes)
        normal, right, seen = np.zeros((size, size)), np.zeros(size), np.zeros((2, size, size))
        for rows, _ in points.blocks():
            white = to_unit[rows] @ design[rows]
            flat = white.reshape(-1, size)
            normal += flat.T @ flat
            right += np.einsum("mij,mj->mi", to_unit[rows], observed[rows]).ravel() @ flat
            for number, noise in enumerate(noises):
                flat = (np.swapaxes(noise[rows], 1, 2) @ white).reshape(-1, size)
                seen[number] += flat.T @ flat
        widths = prior_widths(unknowns, spreads)
        covariance = np.linalg.pinv(normal + np.diag((units / widths) ** 2), rcond=1e-14, hermitian=True)
        solution = covariance @ right
        left = np.einsum("mij,mj->mi", to_unit, observed - design @ solution)
        explained = [(np.einsum("mij,mi->mj", noise, left) ** 2).sum() for noise in noises]
        expected = [(noise**2).sum() - np.sum(covariance * part) for noise, part in zip(noises, seen, strict=True)]
        pulls, variances = solution * units / widths**2, np.diag(covariance) * units**2
        for group in groups:
            explained.append((pulls[group] ** 2).sum())
            expected.append(((1 - variances[group] / widths[group] ** 2) / widths[group] ** 2).sum())
        factors = np.sqrt(np.sqrt(np.maximum(explained, 1e-60) / np.maximum(expected, 1e-60)))
        old = np.array([spreads.rest_mm, spreads.joint_rad, spreads.length_mm, spreads.angle_rad])
        new = old * np.clip(factors, 1e-3, 1e3)
        new[:2] = np.maximum(new[:2], [SMALLEST_MM, SMALLEST_RAD])
        new[2:] = [
            np.clip(value, low, high) if given is None else given
            for value, given, low, high in zip(new[2:], fixed, LEAST_DEVIATION, _MOST_DEVIATION, strict=True)
        ]
        spreads = Spreads(*(float(value) for value in new))
        if np.abs(np.log(new / old)).max() < 3e-3:
            break
    return spreads


def _triangle(points: CarriedPoints, unknowns: Unknowns, to_unit: Floats, goal: Floats, units: Floats) -> Floats:
    """Triangle of the QR decomposition of whitened slopes (3 M, K), in ``units``, and their goal (M, 3) behind them."""
    triangle: Floats = np.empty((0, len(unknowns) + 1))
    for rows, part in points.blocks():
        design = (to_unit[rows] @ part.design(unknowns)).reshape(-1, len(unknowns)) * units
        block = np.column_stack([design, goal[rows].ravel()])
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, block]), mode="r"))
    return triangle


def _carried(cell: ScannerOnArm, measurements: Measurements) -> CarriedPoints:
    return carry(cell, measurements.q_rad, measurements.scanner_mm)


def _noise_covariances(points: CarriedPoints, measurements: Measurements, spreads: Spreads) -> Floats:
    """Covariance (M, 3, 3) of each residual, or the one (1, 3, 3) that all have in common."""
    known = _known_covariances(points, measurements)
    if spreads.joint_rad == 0:
        return known + spreads.rest_mm**2 * np.eye(3)
    return known + _noise(points.slopes(), spreads)


def _noise(slopes: Floats, spreads: Spreads) -> Floats:
    return spreads.joint_rad**2 * slopes @ np.swapaxes(slopes, -1, -2) + spreads.rest_mm**2 * np.eye(3)


def _known_covariances(points: CarriedPoints, measurements: Measurements) -> Floats:
    known = measurements.tracker_std_mm**2 * np.eye(3)[None]
    if measurements.scanner_covariance_mm2 is None:
        return known
    turn = (points.cell.T_tracker_base @ points.frames[:, -1] @ points.cell.T_joint_scanner)[:, :3, :3]
    return known + turn @ measurements.scanner_covariance_mm2 @ np.swapaxes(turn, 1, 2)
