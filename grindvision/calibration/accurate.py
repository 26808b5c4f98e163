"""Accurate calibration: scanner, arm and base from sphere measurements, with what can be known and how well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.arm import MdhArm
from grindvision.calibration.beyond_geometry import BeyondGeometry, choose_terms, kinds_of_terms
from grindvision.calibration.coarse import coarse_start
from grindvision.calibration.diagnosis import check_fit
from grindvision.calibration.dropped import judge_dropped
from grindvision.calibration.estimate import (
    Sigmas,
    deviations,
    gauss_newton,
    residuals_of,
    unit_sizes,
    whitened_jacobian,
)
from grindvision.calibration.fitting import Fit, expected_covariance, iterated_fit, linear_step
from grindvision.calibration.identifiability import Identifiability, analyse
from grindvision.calibration.input_checks import check_measurements, without_copies
from grindvision.calibration.joint_terms import GravityLoad, uniform_load
from grindvision.calibration.length_scale import length_scale
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm
from grindvision.calibration.options import Options
from grindvision.calibration.robust import consistent_rows
from grindvision.calibration.socket_distances import doubt_distances
from grindvision.calibration.starts import median_error, place_unseen_fixtures
from grindvision.calibration.statistics import ErrorStatistics, error_statistics
from grindvision.calibration.structure import Finding, sentences_of, structure_in
from grindvision.calibration.uncertainty import ModelError, honest_covariance, model_error, one_sigma, predicted_rms_mm
from grindvision.calibration.unknowns import Unknowns, table_entries, unknowns_for
from grindvision.errors import UnitError
from grindvision.geometry import inverse
from grindvision.lazy import renamed_property
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: So many rows that contradict the others get a sentence each; more are told in one.
MAX_NAMED = 6
LEFT_OUT = ("left out, it contradicts", "rows were left out, they contradict", "the others")


@by_content
@dataclass(frozen=True)
class OffsetsAlone:
    """What to add to each joint's angle (n,), rad (prismatic: mm), when nothing else is corrected.

    ``known`` (n,) marks zeros that the measurements tell; ``mean_mm`` is the error that is left on the test rows (or,
    without any, on the training rows).
    """

    arm: MdhArm
    change_rad: Floats
    known: Flags
    mean_mm: float


@by_content
@dataclass(frozen=True)
class Calibration:
    """A calibrated cell and what is known about it.

    ``cell`` after, ``coarse`` before; ``unknowns`` names K numbers, ``values`` (K,) their change from ``coarse`` and
    ``covariance`` (K, K) that of the result (scanner and base: small motions), in mm and rad. ``identifiability`` holds
    rank, singular values and null space. ``sigmas`` are the noise and the deviations found. ``dropped`` numbers the
    training rows left out, ``warnings`` says what the user should know.
    """

    cell: ScannerOnArm
    coarse: ScannerOnArm
    unknowns: Unknowns
    values: Floats
    covariance: Floats
    identifiability: Identifiability
    sigmas: Sigmas
    measurements: Measurements
    dropped: tuple[int, ...]
    iterations: int
    converged: bool
    warnings: tuple[str, ...]
    findings: tuple[Finding, ...]
    model_error: ModelError
    beyond: BeyondGeometry | None

    @property
    def arm(self) -> MdhArm:
        """The corrected arm."""
        return self.cell.arm

    @property
    def std(self) -> Floats:
        """Standard deviation (K,) of each unknown, NaN where it stands in a combination that cannot be known."""
        return np.where(self.identifiability.known, one_sigma(self.model_error, self.findings), np.nan)

    def errors(self, train: bool, before: bool = False) -> ErrorStatistics:
        """Error statistics of the training or the test rows, after calibration or before it (coarse)."""
        chosen = self.measurements.train == train
        return error_statistics(residuals_of(self.coarse if before else self.cell, self.measurements.rows(chosen)))

    def errors_of_dropped(self) -> ErrorStatistics:
        """Error statistics of the training rows that were left out, after calibration."""
        return error_statistics(residuals_of(self.cell, self.measurements.rows(list(self.dropped))))

    def offsets_alone(self) -> OffsetsAlone:
        """Fit the joints' zeros alone to the rows that were kept, for controllers that take nothing else."""
        kept = self.measurements.train & without_copies(self.measurements)
        kept[list(self.dropped)] = False
        used = self.measurements.rows(kept)
        entries = tuple(5 * joint + (2 if slides else 3) for joint, slides in enumerate(self.arm.prismatic))
        unknowns = replace(self.unknowns, table=entries)
        cell, *_ = gauss_newton(self.coarse, self.coarse.arm, unknowns, used, self.sigmas)
        change = (cell.arm.table - self.coarse.arm.table).ravel()[list(entries)]
        known = analyse(
            whitened_jacobian(cell, unknowns, used, self.sigmas), unknowns.names, unit_sizes(used, unknowns)
        )
        test = self.measurements.rows(~self.measurements.train) if not self.measurements.train.all() else used
        return OffsetsAlone(
            self.arm, change, known.known[unknowns.in_table], error_statistics(residuals_of(cell, test)).mean
        )

    def predicted_rms_mm(self, q_rad: Floats, points_scanner: Floats) -> Floats:
        """Root mean square error (P,) in mm to expect at joint angles (P, n) for points (P, 3) of the scanner's frame.

        The systematic part: what is left of the arm's and the scanner's errors, without the noise of measuring. An arm
        whose table was held keeps its own errors, which nothing tells from noise: there all that the fit left counts.
        """
        rms = predicted_rms_mm(self.cell, self.unknowns, self.model_error, self.findings, q_rad, points_scanner)
        return rms if self.unknowns.table else np.hypot(rms, self.errors(train=True).rms)

    foreseen_rms_mm = renamed_property("foreseen_rms_mm", "predicted_rms_mm")

    def __str__(self) -> str:
        state = "" if self.converged else ", not converged"
        return (
            f"calibration of {len(self.unknowns)} unknowns, rank {self.identifiability.rank}{state};"
            f" training error {self.errors(train=True).mean:.3f} mm,"
            f" before {self.errors(train=True, before=True).mean:.3f} mm"
        )


@one_blas_thread()
def calibrate(
    measurements: Measurements, arm: MdhArm, options: Options | None = None, start: ScannerOnArm | None = None
) -> Calibration:
    """Calibrate scanner, arm and base on the training rows of ``measurements``, from the nominal ``arm``.

    Args:
        measurements: sphere centres, mm, with joint angles, rad.
        arm: nominal MDH table whose last joint carries the scanner.
        options: what to estimate and how.
        start: the coarse calibration to start from; ``coarse_start`` of the training rows when left out.

    Returns:
        The calibrated cell, ``T_joint_scanner`` and ``T_tracker_base`` (4, 4) in mm and the corrected MDH table, with
        covariance, rank, and what speaks against it.

    Raises:
        InputError, UnitError: the measurements do not fit the arm, or look like other units or a shifted pairing.
        DegenerateError: too few measurements for the unknowns, or all from one pose.

    Example:
        >>> import numpy as np
        >>> from grindvision import CalibrateOptions, Measurements, calibrate, read_arm
        >>> from grindvision.calibration import ScannerOnArm
        >>> from grindvision.data_files import data_folder
        >>> from grindvision.geometry import rigid
        >>> arm = read_arm(data_folder() / "robots" / "er3a_c60.csv").first(4)
        >>> rng = np.random.default_rng(1)
        >>> true = ScannerOnArm(arm, rigid(translation_mm=[20, -30, 90]), rigid(translation_mm=[900, 100, -400]))
        >>> q_rad, seen_mm = rng.uniform(-1, 1, (40, 4)), rng.uniform(-30, 30, (40, 3)) + [0, 0, 400]
        >>> shots = Measurements(q_rad, seen_mm, true.points_base(q_rad, seen_mm) + true.T_tracker_base[:3, 3])
        >>> result = calibrate(shots, arm, CalibrateOptions(free=("theta2_rad", "theta3_rad")))
        >>> bool(np.abs(result.cell.T_joint_scanner - true.T_joint_scanner).max() < 1e-3)
        True
    """
    options = options or Options()
    unknowns = unknowns_of(measurements, arm, options)
    warnings = list(check_measurements(measurements, arm, len(unknowns)))
    fitted = np.flatnonzero(without_copies(measurements) & measurements.train)
    training = measurements.rows(fitted).with_known_distances()
    ours = options.variant != "paper"
    warnings += doubt_distances(training, arm, options.seed)
    coarse = start or coarse_start(training, arm, options.base_fixed, options.seed).cell
    fit = _fitted(coarse, arm, unknowns, training, options)
    if measurements.fixtures:
        fit = replace(fit, cell=place_unseen_fixtures(fit.cell, measurements, training))
        coarse = place_unseen_fixtures(coarse, measurements, training)
    warnings += check_fit(coarse, fit.cell, measurements, fitted, fit.kept, options.base_fixed, options.seed)
    dropped = tuple(int(row) for row in fitted[~fit.kept])
    warnings += _judged(fit, arm, unknowns, training, ours) + _named(fit.cell, dropped, measurements, *LEFT_OUT)
    if not measurements.train.all():
        warnings += _judge_test_rows(fit, unknowns, training, measurements)
    used = training.rows(fit.kept)
    findings: tuple[Finding, ...] = ()
    beyond = None
    white = whitened_jacobian(fit.cell, unknowns, used, fit.sigmas)
    knowledge = analyse(white, unknowns.names, unit_sizes(used, unknowns), options.worst_std)
    load = options.load or uniform_load(arm, options.down)
    error = model_error(fit.cell, arm, unknowns, used, fit.sigmas, load, ours and options.diagnose)
    if ours and options.diagnose:
        looked_at = measurements.rows(np.union1d(fitted[fit.kept], np.flatnonzero(~measurements.train)))
        findings = _findings(fit, arm, unknowns, looked_at, load, knowledge, error)
        warnings += sentences_of(findings)
    if ours and options.beyond_geometry and unknowns.table:
        kinds = kinds_of_terms(load, used.q_rad, options.gear_ratios)
        beyond = choose_terms(fit.cell, arm, unknowns, used, fit.sigmas, kinds, options.seed)
    return Calibration(
        fit.cell, coarse, unknowns, _change(coarse, fit.cell, unknowns), honest_covariance(error, findings), knowledge,
        fit.sigmas, measurements, dropped, fit.iterations, fit.converged, tuple(dict.fromkeys(warnings)), findings,
        error, beyond,
    )  # fmt: skip


def _fitted(coarse: ScannerOnArm, arm: MdhArm, unknowns: Unknowns, training: Measurements, options: Options) -> Fit:
    """The fit of the variant asked for; where nothing near the nominal arm fits, the start with every row."""
    if options.variant == "paper":
        return linear_step(coarse, unknowns, training, options.tolerance)
    try:
        return iterated_fit(coarse, arm, unknowns, training, options)
    except UnitError:  # an angle ran beyond a turn; ``check_fit`` says why
        return Fit(coarse, Sigmas(0.1, 0.0, 1.0, 2e-3), np.ones(len(training), dtype=bool), 0, False)


def _judged(fit: Fit, arm: MdhArm, unknowns: Unknowns, training: Measurements, ours: bool) -> list[str]:
    """What the rows that the fit left out, and its iteration, say against it."""
    said = []
    if not fit.kept.all() and ours and fit.kept.mean() > 0.5:
        said += judge_dropped(fit.cell, arm, unknowns, training, fit.kept, fit.sigmas)
    if not fit.converged:
        said.append("the iteration did not converge: look at the residuals before you use the result")
    typical = 0.0 if unknowns.table else median_error(fit.cell, training.rows(fit.kept))
    if typical > HELD_ARM_MM:
        said.append(
            f"with the robot table held as it is, {typical:.2g} mm are left in the median: the arm itself is off by"
            " about as much; calibrate it too, with more poses (--free offsets, or without --free)"
        )
    return said


def _findings(
    fit: Fit,
    arm: MdhArm,
    unknowns: Unknowns,
    looked_at: Measurements,
    load: GravityLoad,
    knowledge: Identifiability,
    error: ModelError,
) -> tuple[Finding, ...]:
    """Structure in the residuals, and a wrong scale of the tracker that the table took up whole."""
    findings = structure_in(fit.cell, unknowns, looked_at, fit.sigmas, load)
    if any(finding.kind == "tracker scale" for finding in findings):
        return findings
    std = np.sqrt(np.diag(error.covariance)[: len(unknowns)])
    return findings + length_scale(fit.cell.arm, arm, unknowns, knowledge.known, std)


def unknowns_of(measurements: Measurements, arm: MdhArm, options: Options) -> Unknowns:
    """What a calibration of these measurements seeks.

    Raises:
        InputError: a name in ``free`` that is no entry of the table.
    """
    return unknowns_for(measurements, table_entries(arm, options.free), options.base_fixed)


#: What a held arm may leave in the median (mm): factory-calibrated ones leave less.
HELD_ARM_MM = 0.5

#: Test rows whose errors are so many times what the fit predicts make its statement doubtful.
WORSE_THAN_PREDICTED = 1.6


def _judge_test_rows(fit: Fit, unknowns: Unknowns, training: Measurements, measurements: Measurements) -> list[str]:
    """Name test rows that contradict the calibration, and say where they all lie further off than it predicts."""
    test = measurements.rows(~measurements.train)
    expected = expected_covariance(fit, unknowns, training, test, np.zeros(len(test), dtype=bool))
    residuals = residuals_of(fit.cell, test)
    odd = np.flatnonzero(~measurements.train)[~consistent_rows(residuals, expected, test.directions)]
    told = _named(fit.cell, odd, measurements, "a test row contradicts", "test rows contradict", "the calibration")
    predicted = np.sqrt(np.median(np.trace(expected, axis1=1, axis2=2)))
    found = np.sqrt(np.median((residuals**2).sum(axis=1)) * 3 / 2.366)
    if found > WORSE_THAN_PREDICTED * predicted and len(test) >= 6:
        told.append(
            f"the test rows are {found:.2g} mm off (typical rms) where the training rows predict {predicted:.2g} mm:"
            " something changed between the two, or the training rows do not reach there"
        )
    return told


def _named(
    cell: ScannerOnArm,
    rows: Sequence[int] | NDArray[np.int64],
    measurements: Measurements,
    one: str,
    many: str,
    what: str,
) -> list[str]:
    """Rows that contradict the others: a sentence each, or one for all of them where they are many."""
    off = np.linalg.norm(residuals_of(cell, measurements.rows(list(rows))), axis=1) if len(rows) else np.zeros(0)
    labels = [f"{measurements.label(row)}, {size:.2g} mm off" for row, size in zip(rows, off, strict=True)]
    if len(rows) <= MAX_NAMED:
        return [f"{one} {what}: {label}" for label in labels]
    return [f"{len(rows)} {many} {what}, {off.min():.2g} to {off.max():.2g} mm: {'; '.join(labels[:MAX_NAMED])}; ..."]


def _change(coarse: ScannerOnArm, cell: ScannerOnArm, unknowns: Unknowns) -> Floats:
    values = deviations(cell, coarse.arm, unknowns)
    values[unknowns.in_reflectors] = cell.reflectors_mm.ravel()
    if len(cell.fixtures_mm):
        values[unknowns.in_fixtures] = (cell.fixtures_mm - coarse.fixtures_mm)[:, :3].ravel()
    scanner = _twist(cell.T_joint_scanner @ inverse(coarse.T_joint_scanner))
    base = _twist(inverse(coarse.T_tracker_base) @ cell.T_tracker_base)
    values[: unknowns.scanner] = scanner[: unknowns.scanner]
    values[len(values) - unknowns.base :] = base[: unknowns.base]
    return values


def _twist(motion: Floats) -> Floats:
    return np.concatenate([motion[:3, 3], Rotation.from_matrix(motion[:3, :3]).as_rotvec()])
