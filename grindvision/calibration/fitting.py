"""Fits of the unknowns to the training rows: ours, which leaves out rows that contradict the rest, and the paper's."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm
from grindvision.calibration.diagnosis import SUSPICIOUS_MM
from grindvision.calibration.estimate import (
    SMALLEST_MM,
    Sigmas,
    estimate_sigmas,
    gauss_newton,
    noise_covariances,
    posterior_covariance,
    residuals_of,
)
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm, carried, moved_cell
from grindvision.calibration.options import Options
from grindvision.calibration.robust import consistent_rows
from grindvision.calibration.starts import median_error
from grindvision.calibration.unknowns import Unknowns
from grindvision.records import by_content

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


@by_content
@dataclass(frozen=True)
class Fit:
    """A cell fitted to the ``kept`` (N,) training rows, with the sigmas found and the iterations taken."""

    cell: ScannerOnArm
    sigmas: Sigmas
    kept: Flags
    iterations: int
    converged: bool


def iterated_fit(
    coarse: ScannerOnArm, arm: MdhArm, unknowns: Unknowns, training: Measurements, options: Options
) -> Fit:
    """Fit all rows; if some contradict the rest, begin again from a robust fit and leave them out."""
    fit = _fit_rows(coarse, arm, unknowns, training, np.ones(len(training), dtype=bool), options)
    if not options.robust:
        return fit
    agree = consistent(fit, unknowns, training)
    if agree.all() and median_error(fit.cell, training) <= SUSPICIOUS_MM:
        return fit
    rough = Sigmas(0.1, 0.0, options.length_prior_mm or 1.0, options.angle_prior_rad or 2e-3)
    cell, steps, _ = gauss_newton(coarse, arm, unknowns, training, rough, robust=True, iterations=20)
    agree = consistent_rows(residuals_of(cell, training), noise_covariances(cell, training, rough), training.directions)
    for _ in range(6):
        fit = _fit_rows(cell, arm, unknowns, training, agree, options)
        fit, agree = replace(fit, iterations=fit.iterations + steps), consistent(fit, unknowns, training)
        if (agree == fit.kept).all():
            break
    return fit


def _fit_rows(
    start: ScannerOnArm, arm: MdhArm, unknowns: Unknowns, training: Measurements, kept: Flags, options: Options
) -> Fit:
    """Gauss-Newton, the sigmas that its residuals show, and Gauss-Newton with these."""
    used = training.rows(kept)
    sigmas = Sigmas(0.1, 0.0, options.length_prior_mm or 1.0, options.angle_prior_rad or 2e-3)
    cell, steps, _ = gauss_newton(start, arm, unknowns, used, sigmas)
    rest = max(float(np.sqrt((residuals_of(cell, used) ** 2).mean())), SMALLEST_MM)
    begin = replace(sigmas, rest_mm=rest, joint_rad=rest / 1000)
    sigmas = estimate_sigmas(cell, arm, unknowns, used, begin, options.length_prior_mm, options.angle_prior_rad)
    cell, more, converged = gauss_newton(cell, arm, unknowns, used, sigmas)
    return Fit(cell, sigmas, kept, steps + more, converged)


def consistent(fit: Fit, unknowns: Unknowns, training: Measurements) -> Flags:
    """Rows whose residuals fit; a row that was fitted leaves less than its noise, one left out leaves more."""
    return consistent_rows(
        residuals_of(fit.cell, training),
        expected_covariance(fit, unknowns, training, training, fit.kept),
        training.directions,
    )


def expected_covariance(
    fit: Fit, unknowns: Unknowns, training: Measurements, judged: Measurements, was_fitted: Flags
) -> Floats:
    """Covariance (M, 3, 3) to expect of the residuals of rows that were fitted or not."""
    noise = noise_covariances(fit.cell, judged, fit.sigmas)
    design = carried(fit.cell, judged).design(unknowns)
    covariance = posterior_covariance(fit.cell, unknowns, training.rows(fit.kept), fit.sigmas)
    pull = design @ covariance @ np.swapaxes(design, 1, 2)
    return np.where(was_fitted[:, None, None], noise - 0.95 * pull, noise + pull)


def linear_step(coarse: ScannerOnArm, unknowns: Unknowns, training: Measurements, tolerance: float) -> Fit:
    """Eqs 16-18: the generalised inverse of the stacked G_i, applied once to the stacked residuals."""
    design = carried(coarse, training).design(unknowns).reshape(-1, len(unknowns))
    cell = moved_cell(
        coarse, unknowns, np.linalg.pinv(design, rcond=tolerance) @ residuals_of(coarse, training).ravel()
    )
    left = residuals_of(cell, training).ravel()
    freedom = max(len(left) - np.linalg.matrix_rank(design, tol=tolerance * np.linalg.norm(design, 2)), 1)
    sigmas = Sigmas(max(float(np.sqrt(left @ left / freedom)), SMALLEST_MM), 0.0, np.inf, np.inf)
    return Fit(cell, sigmas, np.ones(len(training), dtype=bool), 1, True)
