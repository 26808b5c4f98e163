"""Weighted, regularised Gauss-Newton on the error model, and how large noise and parameter deviations really are."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import CarriedPoints, ScannerOnArm, carried, measured_points
from grindvision.calibration.statistics import whitening
from grindvision.calibration.unknowns import Unknowns

Floats = NDArray[np.float64]

#: Below these they count as zero: far under any instrument, far above rounding.
SMALLEST_MM, SMALLEST_RAD = 1e-9, 1e-12

#: A table's lengths (mm) and angles (rad) are never taken for more exact than this, however well the nominal ones fit:
#: a smaller learnt prior makes single parameters look surer than they are.
MIN_DEVIATION = (0.2, 4e-4, 1e-7, 1e-7)
_MAX_DEVIATION = (100.0, 0.2, 0.1, 0.1)

#: Standard deviation (mm) across a bar or along a touched plane, where the measurement says nothing.
FREE_MM = 1e4

#: Standard deviation (mm) of a distance between two sockets that is given as known: a machined plate's.
DISTANCE_MM = 0.01

#: A prismatic joint repeats to so many mm where a revolute one repeats to one rad: 0.02 mm for 4e-5 rad.
PRISMATIC_MM_PER_RAD = 500.0

#: Rows that the noise is learnt from: more of them change it by less than it is known (2 %).
MAX_NOISE_ROWS = 2000

#: A step that moves no point by more than this (mm) is the last one; by this fraction of the error, none is missed.
STILL_MM, STILL_FRACTION = 1e-7, 0.01


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations that decide the weights: of what is measured, and of what the MDH table may deviate by.

    ``rest_mm``: isotropic noise per axis on top of the covariances that the measurements bring; ``joint_rad``:
    repeatability of each joint; ``length_mm`` and ``angle_rad``: deviations of the table's lengths and angles from
    the nominal ones; ``term_rad``: coefficients of gear waves and couplings; ``sag_rad``: of compliances.
    """

    rest_mm: float
    joint_rad: float
    length_mm: float
    angle_rad: float
    term_rad: float = 2e-4
    sag_rad: float = 5e-4

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
    tracked = measurements.tracker_mm[measurements.tracked]
    if not len(tracked):
        tracked = np.full((1, 3), 1.0) * [[-300.0], [300.0]]
    centred = tracked - tracked.mean(axis=0)
    far = np.sqrt((centred**2).sum(axis=1).mean()) + np.sqrt((measurements.scanner_mm**2).sum(axis=1).mean())
    return np.where(unknowns.is_angle, 1 / max(far, 1.0), 1.0)


def noise_covariances(cell: ScannerOnArm, measurements: Measurements, sigmas: Sigmas) -> Floats:
    """Covariance (M, 3, 3) of each residual in the tracker's frame: sphere fit, tracker, joints and the rest."""
    points = carried(cell, measurements)
    noise = _noise_covariances(points, measurements, sigmas, measured_points(points, measurements)[1])
    return np.broadcast_to(noise, (len(measurements), 3, 3))


def joint_noise_jacobian(points: CarriedPoints) -> Floats:
    """How one unit of joint noise moves each point, (M, 3, n): a radian, or what a prismatic joint has instead."""
    prismatic = points.cell.arm.prismatic
    return points.jacobian() * np.where(prismatic, PRISMATIC_MM_PER_RAD, 1.0) if any(prismatic) else points.jacobian()


def row_covariances(points: CarriedPoints, measurements: Measurements, sigmas: Sigmas) -> Floats:
    """Covariance (M, 3, 3) of each residual without the joints' part, or the one (1, 3, 3) that all have in common."""
    known = _known_covariances(points, measurements, measured_points(points, measurements)[1])
    return known + sigmas.rest_mm**2 * np.eye(3)


def residuals_of(cell: ScannerOnArm, measurements: Measurements) -> Floats:
    """Measured minus predicted points (M, 3) in the tracker's frame, X_B^R - X_B of Eq 16."""
    points = carried(cell, measurements)
    return measured_points(points, measurements)[0] - points.tracker_mm


def prior_widths(unknowns: Unknowns, sigmas: Sigmas) -> Floats:
    """Prior standard deviation (K,) of each unknown: the sigmas for table entries, infinite for scanner and base."""
    widths = np.where(unknowns.is_angle, sigmas.angle_rad, sigmas.length_mm)
    terms = np.where(unknowns.in_sag, sigmas.sag_rad, sigmas.term_rad)
    return np.where(unknowns.in_terms, terms, np.where(unknowns.in_table, widths, np.inf))


def whitened_jacobian(cell: ScannerOnArm, unknowns: Unknowns, measurements: Measurements, sigmas: Sigmas) -> Floats:
    """Design matrix (3 M, K) whose rows are scaled to unit noise."""
    points = carried(cell, measurements)
    noise = _noise_covariances(points, measurements, sigmas, measured_points(points, measurements)[1])
    return (whitening(noise) @ points.design(unknowns)).reshape(-1, len(unknowns))


def posterior_covariance(cell: ScannerOnArm, unknowns: Unknowns, measurements: Measurements, sigmas: Sigmas) -> Floats:
    """Covariance (K, K) of the unknowns from noise and priors; zero in directions that neither of them holds."""
    units = unit_sizes(measurements, unknowns)
    rows = whitened_jacobian(cell, unknowns, measurements, sigmas) * units
    distances = _distance_rows(carried(cell, measurements), measurements, unknowns) * units
    information = rows.T @ rows + distances.T @ distances + np.diag((units / prior_widths(unknowns, sigmas)) ** 2)
    return np.linalg.pinv(information, rcond=1e-15, hermitian=True) * np.outer(units, units)


def deviations(cell: ScannerOnArm, nominal: MdhArm, unknowns: Unknowns) -> Floats:
    """Deviation (K,) of the cell's table and joint terms from the nominal ones; zero for what has none."""
    values = np.zeros(len(unknowns))
    if unknowns.terms:
        values[unknowns.in_terms] = cell.corrections.values
    values[unknowns.in_table] = (cell.arm.table - nominal.table).ravel()[list(unknowns.table)]
    return values


def gauss_newton(
    cell: ScannerOnArm,
    nominal: MdhArm,
    unknowns: Unknowns,
    measurements: Measurements,
    sigmas: Sigmas,
    robust: bool = False,
    iterations: int = 50,
) -> tuple[ScannerOnArm, int, bool]:
    """Move the cell to the least weighted squares of residuals and deviations; the cell, steps taken, converged or not.

    Directions that neither data nor priors hold are left where they are (smallest step). ``robust`` weights each row
    down by Cauchy's function of its residual, so that some wildly wrong rows do not matter.
    """
    units, widths = unit_sizes(measurements, unknowns), prior_widths(unknowns, sigmas)

    def weighted(at: CarriedPoints) -> tuple[Floats, Floats, Floats, float]:
        measured, free = measured_points(at, measurements)
        to_unit = whitening(_noise_covariances(at, measurements, sigmas, free))
        whitened = np.einsum("mij,mj->mi", to_unit, measured - at.tracker_mm)
        if robust:
            length = np.linalg.norm(whitened, axis=1)
            ratio = length / (2.4 * max(np.median(length) / 1.54, 1e-300))
            weight, cost = 1 / np.sqrt(1 + ratio**2), np.log1p(ratio**2).sum()
        else:
            weight, cost = np.ones(len(whitened)), (whitened**2).sum()
        pull = np.concatenate([deviations(at.cell, nominal, unknowns) / widths, _distance_errors(at, measurements)])
        cost = float(cost + (0 if robust else pull @ pull))
        return to_unit * weight[:, None, None], whitened * weight[:, None], pull, cost

    points = carried(cell, measurements)
    to_unit, goal, pull, cost = weighted(points)
    last = 0.0
    for step_number in range(1, iterations + 1):
        triangle = _triangle(points, unknowns, to_unit, goal, units)
        held = np.vstack([np.diag(units / widths), _distance_rows(points, measurements, unknowns) * units])
        step = np.linalg.lstsq(
            np.vstack([triangle[:, :-1], held]), np.concatenate([triangle[:, -1], -pull]), rcond=1e-12
        )[0]
        for _ in range(12):
            trial = points.moved(unknowns, step * units)
            to_unit, goal, pull, trial_cost = weighted(trial)
            if robust or trial_cost <= cost * (1 + 1e-9) or np.abs(step).max() < 1e-7:
                break
            step = step / 2
        last = float(np.abs(trial.tracker_mm - points.tracker_mm).max())
        points, cost = trial, trial_cost
        if last < STILL_MM:
            return points.cell, step_number, True
    typical = float(np.median(np.linalg.norm(measured_points(points, measurements)[0] - points.tracker_mm, axis=1)))
    return points.cell, iterations, last < max(STILL_FRACTION * typical, 100 * STILL_MM)


def estimate_sigmas(
    cell: ScannerOnArm,
    nominal: MdhArm,
    unknowns: Unknowns,
    measurements: Measurements,
    start: Sigmas,
    fixed_length_mm: float | None = None,
    fixed_angle_rad: float | None = None,
    iterations: int = 60,
) -> Sigmas:
    """Sigmas under which the residuals are most likely, scanner and base integrated out (restricted likelihood).

    The error model is linear here, so the variances are found by minorise-maximise steps: each is multiplied by the
    square root of the ratio of the squares it explains to the squares it expects. No step can lower the likelihood.
    At most ``MAX_NOISE_ROWS`` rows are used, spread evenly over them in the order of their joint angles.
    """
    if len(measurements) > MAX_NOISE_ROWS:
        order = np.lexsort([*measurements.tracker_mm.T, *measurements.q_rad.T])
        measurements = measurements.rows(order[np.linspace(0, len(order) - 1, MAX_NOISE_ROWS).astype(int)])
    units = unit_sizes(measurements, unknowns)
    points = carried(cell, measurements)
    measured, free = measured_points(points, measurements)
    design, jacobian = points.design(unknowns) * units, joint_noise_jacobian(points)
    observed = measured - points.tracker_mm + design @ (deviations(cell, nominal, unknowns) / units)
    known = _known_covariances(points, measurements, free)
    distances = _distance_rows(points, measurements, unknowns) * units
    table, sag = unknowns.in_table, unknowns.in_sag
    groups = [table & ~unknowns.is_angle, table & unknowns.is_angle, unknowns.in_terms & ~sag, sag]
    size = len(unknowns)
    fixed = [fixed_length_mm, fixed_angle_rad, None, None]
    sigmas = start
    for _ in range(iterations):
        to_unit = whitening(known + _noise(jacobian, sigmas))
        noises = (to_unit, to_unit @ jacobian)
        normal, right, seen = np.zeros((size, size)), np.zeros(size), np.zeros((2, size, size))
        for rows, _ in points.blocks():
            white = to_unit[rows] @ design[rows]
            flat = white.reshape(-1, size)
            normal += flat.T @ flat
            right += np.einsum("mij,mj->mi", to_unit[rows], observed[rows]).ravel() @ flat
            for number, noise in enumerate(noises):
                flat = (np.swapaxes(noise[rows], 1, 2) @ white).reshape(-1, size)
                seen[number] += flat.T @ flat
        widths = prior_widths(unknowns, sigmas)
        held = np.diag((units / widths) ** 2) + distances.T @ distances
        covariance = np.linalg.pinv(normal + held, rcond=1e-14, hermitian=True)
        solution = covariance @ right
        left = np.einsum("mij,mj->mi", to_unit, observed - design @ solution)
        explained = [(np.einsum("mij,mi->mj", noise, left) ** 2).sum() for noise in noises]
        expected = [(noise**2).sum() - np.sum(covariance * part) for noise, part in zip(noises, seen, strict=True)]
        pulls, variances = solution * units / widths**2, np.diag(covariance) * units**2
        for group in groups:
            explained.append((pulls[group] ** 2).sum())
            expected.append(((1 - variances[group] / widths[group] ** 2) / widths[group] ** 2).sum())
        factors = np.sqrt(np.sqrt(np.maximum(explained, 1e-60) / np.maximum(expected, 1e-60)))
        old = np.array([getattr(sigmas, field.name) for field in fields(sigmas)])
        new = old * np.clip(factors, 1e-3, 1e3)
        new[:2] = np.maximum(new[:2], [SMALLEST_MM, SMALLEST_RAD])
        new[2:] = [
            np.clip(value, low, high) if given is None else given
            for value, given, low, high in zip(new[2:], fixed, MIN_DEVIATION, _MAX_DEVIATION, strict=True)
        ]
        new[4:] = [
            value if group.any() else kept for value, kept, group in zip(new[4:], old[4:], groups[2:], strict=True)
        ]
        sigmas = Sigmas(*(float(value) for value in new))
        if np.abs(np.log(new / old)).max() < 3e-3:
            break
    return sigmas


def _triangle(points: CarriedPoints, unknowns: Unknowns, to_unit: Floats, goal: Floats, units: Floats) -> Floats:
    """Triangle of the QR decomposition of the whitened Jacobian (3 M, K), in ``units``, with its goal (M, 3)."""
    triangle: Floats = np.empty((0, len(unknowns) + 1))
    for rows, part in points.blocks():
        design = (to_unit[rows] @ part.design(unknowns)).reshape(-1, len(unknowns)) * units
        block = np.column_stack([design, goal[rows].ravel()])
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, block]), mode="r"))
    return triangle


def _noise_covariances(
    points: CarriedPoints, measurements: Measurements, sigmas: Sigmas, free: Floats | None = None
) -> Floats:
    """Covariance (M, 3, 3) of each residual, or the one (1, 3, 3) that all have in common."""
    known = _known_covariances(points, measurements, free)
    if sigmas.joint_rad == 0:
        return known + sigmas.rest_mm**2 * np.eye(3)
    return known + _noise(joint_noise_jacobian(points), sigmas)


def _noise(jacobian: Floats, sigmas: Sigmas) -> Floats:
    return sigmas.joint_rad**2 * jacobian @ np.swapaxes(jacobian, -1, -2) + sigmas.rest_mm**2 * np.eye(3)


def _known_covariances(points: CarriedPoints, measurements: Measurements, free: Floats | None) -> Floats:
    known = measurements.tracker_std_mm**2 * np.eye(3)[None]
    if measurements.scanner_covariance_mm2 is not None:
        R_tracker_scanner = (points.cell.T_tracker_base @ points.frames[:, -1] @ points.cell.T_joint_scanner)[:, :3, :3]
        known = known + R_tracker_scanner @ measurements.scanner_covariance_mm2 @ np.swapaxes(R_tracker_scanner, 1, 2)
    return known if free is None else known + FREE_MM**2 * free


def _distance_errors(points: CarriedPoints, measurements: Measurements) -> Floats:
    """How much longer the known distances between sockets are found, in units of their standard deviation."""
    places = points.cell.fixtures_mm
    found = [np.linalg.norm(places[a, :3] - places[b, :3]) - mm for a, b, mm in measurements.distances_mm]
    return np.array(found, dtype=float) / DISTANCE_MM


def _distance_rows(points: CarriedPoints, measurements: Measurements, unknowns: Unknowns) -> Floats:
    """Jacobian of ``_distance_errors`` by the unknowns."""
    rows = np.zeros((len(measurements.distances_mm), len(unknowns)))
    if not unknowns.fixtures:
        return rows
    first = int(np.flatnonzero(unknowns.in_fixtures)[0])
    for row, (a, b, _) in zip(rows, measurements.distances_mm, strict=True):
        ray = points.cell.fixtures_mm[a, :3] - points.cell.fixtures_mm[b, :3]
        ray = ray / np.linalg.norm(ray) / DISTANCE_MM
        row[first + 3 * a : first + 3 * a + 3] = ray
        row[first + 3 * b : first + 3 * b + 3] = -ray
    return rows
