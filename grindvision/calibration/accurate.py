"""Accurate calibration: scanner, arm and base from sphere measurements, with what can be known and how well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.arm import MdhArm
from grindvision.calibration.coarse import coarse_start
from grindvision.calibration.diagnosis import (
    SUSPICIOUS_MM,
    check_fit,
    check_measurements,
    far_from_nominal,
    without_copies,
)
from grindvision.calibration.estimate import (
    SMALLEST_MM,
    Spreads,
    deviations,
    estimate_spreads,
    gauss_newton,
    noise_covariances,
    posterior_covariance,
    residuals_of,
    unit_sizes,
    whitened_design,
)
from grindvision.calibration.identifiability import Identifiability, analyse
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm, Unknowns, design_matrix, moved_cell, table_entries
from grindvision.calibration.robust import consistent_rows
from grindvision.calibration.starts import median_error
from grindvision.calibration.statistics import ErrorStatistics, error_statistics
from grindvision.errors import InputError, UnitError
from grindvision.geometry import inverse

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: So many rows that contradict the others get a sentence each; more are told in one.
MOST_NAMED = 6


@dataclass(frozen=True)
class Options:
    """How to calibrate.

    ``base_fixed``: the tracker already measures in the arm's base frame. ``free``: entries of the MDH table to
    estimate, by name (``d3_mm``), instead of the usual ones. ``length_prior_mm`` and ``angle_prior_rad``: how far the
    table may deviate (standard deviation); learnt from the data where left out. ``robust``: drop rows that contradict
    the others and name them. ``worst_std``: a combination known worse than this many millimetres counts as unknown.
    ``variant``: ``ours``, or ``paper`` for Eqs 9-18 as printed: one linear step, every row with the same weight, no
    priors, generalised inverse with relative ``tolerance`` on the singular values in mm and rad as they come.
    """

    base_fixed: bool = False
    free: tuple[str, ...] | None = None
    length_prior_mm: float | None = None
    angle_prior_rad: float | None = None
    robust: bool = True
    worst_std: float = 10.0
    variant: str = "ours"
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        if self.variant not in ("ours", "paper"):
            raise InputError(f"variant {self.variant!r}; choose ours or paper")
        for name in ("length_prior_mm", "angle_prior_rad", "worst_std", "tolerance"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"{name} is {value}; it must be above zero")


@dataclass(frozen=True)
class Calibration:
    """A calibrated cell and what is known about it.

    ``cell`` after, ``coarse`` before; ``unknowns`` names K numbers, ``values`` (K,) their change from ``coarse`` and
    ``covariance`` (K, K) that of the result (scanner and base: small motions), in mm and rad. ``identifiability`` holds
    rank, singular values and null space. ``spreads`` are the noise and the deviations found. ``dropped`` numbers the
    training rows left out, ``warnings`` says what the user should know.
    """

    cell: ScannerOnArm
    coarse: ScannerOnArm
    unknowns: Unknowns
    values: Floats
    covariance: Floats
    identifiability: Identifiability
    spreads: Spreads
    measurements: Measurements
    dropped: tuple[int, ...]
    iterations: int
    converged: bool
    warnings: tuple[str, ...]

    @property
    def arm(self) -> MdhArm:
        """The corrected arm."""
        return self.cell.arm

    @property
    def std(self) -> Floats:
        """Standard deviation (K,) of each unknown, NaN where it stands in a combination that cannot be known."""
        return np.where(self.identifiability.known, np.sqrt(np.diag(self.covariance)), np.nan)

    def errors(self, train: bool, before: bool = False) -> ErrorStatistics:
        """Error statistics of the training or the test rows, after calibration or before it (coarse)."""
        chosen = self.measurements.train == train
        return error_statistics(residuals_of(self.coarse if before else self.cell, self.measurements.rows(chosen)))

    def __str__(self) -> str:
        state = "" if self.converged else ", not converged"
        return (
            f"calibration of {len(self.unknowns)} unknowns, rank {self.identifiability.rank}{state};"
            f" training error {self.errors(train=True).mean:.3f} mm,"
            f" before {self.errors(train=True, before=True).mean:.3f} mm"
        )


def calibrate(
    measurements: Measurements,
    arm: MdhArm,
    options: Options | None = None,
    start: ScannerOnArm | None = None,
) -> Calibration:
    """Calibrate scanner, arm and base on the training rows of ``measurements``, from the nominal ``arm``.

    Args:
        measurements: sphere centres, mm, with joint angles, rad.
        arm: nominal MDH table whose last joint carries the scanner.
        options: what to estimate and how.
        start: the coarse calibration to start from; ``coarse_start`` of the training rows when left out.

    Raises:
        InputError, UnitError: the measurements do not fit the arm, or look like other units or a shifted pairing.
        DegenerateError: too few measurements for the unknowns, or all from one pose.
    """
    options = options or Options()
    unknowns = Unknowns(
        3 if measurements.on_tool else 6, table_entries(arm, options.free), 0 if options.base_fixed else 6
    )
    warnings = list(check_measurements(measurements, arm, len(unknowns)))
    fitted = np.flatnonzero(without_copies(measurements) & measurements.train)
    training = measurements.rows(fitted)
    coarse = start or coarse_start(training, arm, options.base_fixed).cell
    if options.variant == "paper":
        fit = _linear_step(coarse, unknowns, training, options.tolerance)
    else:
        try:
            fit = _iterated(coarse, arm, unknowns, training, options)
        except UnitError:  # an angle ran beyond a turn: nothing near the nominal arm fits, and ``check_fit`` says why
            fit = _Fit(coarse, Spreads(0.1, 0.0, 1.0, 2e-3), np.ones(len(training), dtype=bool), 0, False)
    warnings += check_fit(coarse, fit.cell, measurements, fitted, fit.kept, options.base_fixed)
    warnings += far_from_nominal(fit.cell.arm, arm)
    if not fit.converged:
        warnings.append("the iteration did not converge: look at the residuals before you use the result")
    dropped = tuple(int(row) for row in fitted[~fit.kept])
    warnings += _named(
        dropped, measurements, "left out, it contradicts", "rows were left out, they contradict", "the others"
    )
    if not measurements.train.all():
        odd = np.flatnonzero(~measurements.train & ~_consistent(fit, unknowns, training, measurements))
        warnings += _named(odd, measurements, "a test row contradicts", "test rows contradict", "the calibration")
    used = training.rows(fit.kept)
    rows = whitened_design(fit.cell, unknowns, used, fit.spreads)
    return Calibration(
        fit.cell,
        coarse,
        unknowns,
        _change(coarse, fit.cell, unknowns),
        posterior_covariance(fit.cell, unknowns, used, fit.spreads),
        analyse(rows, unknowns.names, unit_sizes(used, unknowns), options.worst_std),
        fit.spreads,
        measurements,
        dropped,
        fit.iterations,
        fit.converged,
        tuple(warnings),
    )


@dataclass(frozen=True)
class _Fit:
    cell: ScannerOnArm
    spreads: Spreads
    kept: Flags
    iterations: int
    converged: bool


def _iterated(coarse: ScannerOnArm, arm: MdhArm, unknowns: Unknowns, training: Measurements, options: Options) -> _Fit:
    """Fit all rows; if some contradict the rest, begin again from a robust fit and leave them out."""
    fit = _fit_rows(coarse, arm, unknowns, training, np.ones(len(training), dtype=bool), options)
    if not options.robust:
        return fit
    agree = _consistent(fit, unknowns, training)
    if agree.all() and median_error(fit.cell, training) <= SUSPICIOUS_MM:
        return fit
    rough = Spreads(0.1, 0.0, options.length_prior_mm or 1.0, options.angle_prior_rad or 2e-3)
    cell, steps, _ = gauss_newton(coarse, arm, unknowns, training, rough, robust=True, iterations=20)
    agree = consistent_rows(residuals_of(cell, training), noise_covariances(cell, training, rough))
    for _ in range(6):
        fit = _fit_rows(cell, arm, unknowns, training, agree, options)
        fit, agree = replace(fit, iterations=fit.iterations + steps), _consistent(fit, unknowns, training)
        if (agree == fit.kept).all():
            break
    return fit


def _fit_rows(
    start: ScannerOnArm, arm: MdhArm, unknowns: Unknowns, training: Measurements, kept: Flags, options: Options
) -> _Fit:
    """Gauss-Newton, the spreads that its residuals show, and Gauss-Newton with these."""
    used = training.rows(kept)
    spreads = Spreads(0.1, 0.0, options.length_prior_mm or 1.0, options.angle_prior_rad or 2e-3)
    cell, steps, _ = gauss_newton(start, arm, unknowns, used, spreads)
    rest = max(float(np.sqrt((residuals_of(cell, used) ** 2).mean())), SMALLEST_MM)
    begin = replace(spreads, rest_mm=rest, joint_rad=rest / 1000)
    spreads = estimate_spreads(cell, arm, unknowns, used, begin, options.length_prior_mm, options.angle_prior_rad)
    cell, more, converged = gauss_newton(cell, arm, unknowns, used, spreads)
    return _Fit(cell, spreads, kept, steps + more, converged)


def _consistent(fit: _Fit, unknowns: Unknowns, training: Measurements, unseen: Measurements | None = None) -> Flags:
    """Rows whose residuals fit; a row that was fitted leaves less than its noise, one left out or unseen leaves more.

    The rows are those of ``unseen`` where it is given, else the training rows.
    """
    judged = training if unseen is None else unseen
    noise = noise_covariances(fit.cell, judged, fit.spreads)
    design = design_matrix(fit.cell, judged.q_rad, judged.scanner_mm, unknowns)
    covariance = posterior_covariance(fit.cell, unknowns, training.rows(fit.kept), fit.spreads)
    pull = design @ covariance @ np.swapaxes(design, 1, 2)
    was_fitted = fit.kept if unseen is None else np.zeros(len(judged), dtype=bool)
    expected = np.where(was_fitted[:, None, None], noise - 0.95 * pull, noise + pull)
    return consistent_rows(residuals_of(fit.cell, judged), expected)


def _linear_step(coarse: ScannerOnArm, unknowns: Unknowns, training: Measurements, tolerance: float) -> _Fit:
    """Eqs 16-18: the generalised inverse of the stacked G_i, applied once to the stacked residuals."""
    design = design_matrix(coarse, training.q_rad, training.scanner_mm, unknowns).reshape(-1, len(unknowns))
    cell = moved_cell(
        coarse, unknowns, np.linalg.pinv(design, rcond=tolerance) @ residuals_of(coarse, training).ravel()
    )
    left = residuals_of(cell, training).ravel()
    freedom = max(len(left) - np.linalg.matrix_rank(design, tol=tolerance * np.linalg.norm(design, 2)), 1)
    spreads = Spreads(max(float(np.sqrt(left @ left / freedom)), SMALLEST_MM), 0.0, np.inf, np.inf)
    return _Fit(cell, spreads, np.ones(len(training), dtype=bool), 1, True)


def _named(
    rows: Sequence[int] | NDArray[np.int64], measurements: Measurements, one: str, many: str, what: str
) -> list[str]:
    """Rows that contradict the others: a sentence each, or one for all of them where they are many."""
    if len(rows) <= MOST_NAMED:
        return [f"{one} {what}: {measurements.label(row)}" for row in rows]
    first = ", ".join(measurements.label(row) for row in rows[:MOST_NAMED])
    return [f"{len(rows)} {many} {what}: {first} and others"]


def _change(coarse: ScannerOnArm, cell: ScannerOnArm, unknowns: Unknowns) -> Floats:
    values = deviations(cell, coarse.arm, unknowns)
    scanner = _twist(cell.T_joint_scanner @ inverse(coarse.T_joint_scanner))
    base = _twist(inverse(coarse.T_tracker_base) @ cell.T_tracker_base)
    values[: unknowns.scanner] = scanner[: unknowns.scanner]
    values[len(values) - unknowns.base :] = base[: unknowns.base]
    return values


def _twist(motion: Floats) -> Floats:
    return np.concatenate([motion[:3, 3], Rotation.from_matrix(motion[:3, :3]).as_rotvec()])
