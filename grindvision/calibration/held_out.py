"""Errors on measurements that the fit has not seen: the test rows, or cross-validation where there are none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.calibration.accurate import Calibration, calibrate
from grindvision.calibration.estimate import residuals_of
from grindvision.calibration.options import Options
from grindvision.calibration.statistics import ErrorStatistics, error_statistics
from grindvision.errors import DegenerateError
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content

Floats = NDArray[np.float64]


@by_content
@dataclass(frozen=True)
class HeldOut:
    """Residuals (H, 3) in mm of the held-out ``rows`` (H,), before and after; ``how`` says what was held out.

    Every row counts, also those that contradict the others: nothing about a row decides whether it is judged.
    ``beyond_mm`` are residuals of the cells with joint terms, where the calibration has them.
    """

    rows: NDArray[np.int64]
    before_mm: Floats
    after_mm: Floats
    how: str
    beyond_mm: Floats | None = None

    @property
    def before(self) -> ErrorStatistics:
        """Statistics before calibration."""
        return error_statistics(self.before_mm)

    @property
    def after(self) -> ErrorStatistics:
        """Statistics after calibration."""
        return error_statistics(self.after_mm)

    @property
    def beyond(self) -> ErrorStatistics | None:
        """Statistics after calibration with joint terms; None without them."""
        return None if self.beyond_mm is None else error_statistics(self.beyond_mm)

    @property
    def improved(self) -> bool:
        """Whether held-out rows are nearer after calibration than before."""
        return self.after.mean < self.before.mean

    def part(self, chosen: NDArray[np.bool_]) -> HeldOut:
        """The held-out rows marked by ``chosen`` (H,) alone."""
        beyond = None if self.beyond_mm is None else self.beyond_mm[chosen]
        return HeldOut(self.rows[chosen], self.before_mm[chosen], self.after_mm[chosen], self.how, beyond)

    def __str__(self) -> str:
        return f"unseen: {self.after}; before: mean {self.before.mean:.3f} mm; {self.how}"


def evaluate(calibration: Calibration, options: Options) -> tuple[Calibration, HeldOut]:
    """Errors on held-out rows: the test rows of the measurements, or by cross-validation where all are training rows.

    Returns:
        The calibration, without joint terms that do not lower the held-out error, and the errors.

    Raises:
        DegenerateError: no test rows, and too few rows to hold some out (``cross_validated``).
    """
    if calibration.measurements.train.all():
        errors = cross_validated(calibration, options, seed=options.seed)
    else:
        errors = on_test_rows(calibration)
    if errors.beyond is not None and errors.beyond.mean >= errors.after.mean:
        return replace(calibration, beyond=None), replace(errors, beyond_mm=None)
    return calibration, errors


@one_blas_thread()
def on_test_rows(calibration: Calibration) -> HeldOut:
    """Errors of a calibration on the test rows of its own measurements."""
    rows = np.flatnonzero(~calibration.measurements.train)
    test = calibration.measurements.rows(rows)
    before, after = residuals_of(calibration.coarse, test), residuals_of(calibration.cell, test)
    beyond = None if calibration.beyond is None else residuals_of(calibration.beyond.cell, test)
    return HeldOut(rows, before, after, f"{len(rows)} test rows as the file marks them", beyond)


@one_blas_thread()
def cross_validated(calibration: Calibration, options: Options, folds: int = 5, seed: int = 0) -> HeldOut:
    """Errors of fits that left out one fold after the other, for a calibration whose measurements have no test rows.

    Whole spheres stay out together, or whole poses where there are fewer spheres than ``folds``. Each fold decides by
    itself which of its rows to drop and which joint terms to take; all rows are judged, those too that the calibration
    dropped. Where the rows are so few that a fold could not be spared, each group is one.

    Raises:
        DegenerateError: one sphere and one pose only, or so few rows that none can be held out.
    """
    measurements = calibration.measurements
    rows = np.arange(len(measurements))
    labels, kind = measurements.sphere, "spheres"
    if len(np.unique(labels)) < folds:
        labels, kind = measurements.pose, "poses"
    groups = np.unique(labels)
    spared = len(rows) - len(calibration.dropped) - len(calibration.unknowns) // 3 - 1
    folds = min(folds, len(groups)) if spared >= len(rows) / folds else len(groups)
    if folds < 2:
        raise DegenerateError("all rows carry one sphere and one pose label; label them, so that some can be held out")
    if spared < 1:
        raise DegenerateError(
            f"{len(rows)} measurements determine the {len(calibration.unknowns)} unknowns, but then none can be held"
            f" out to say how well; measure at least {len(rows) - spared + 1}, or hold some parameters (--free, --fix)"
        )
    part = dict(zip(np.random.default_rng(seed).permutation(groups), np.arange(len(groups)) % folds, strict=True))
    fold = np.array([part[label] for label in labels])
    quick = replace(options, diagnose=False, beyond_geometry=calibration.beyond is not None)
    before, after = np.empty((len(rows), 3)), np.empty((len(rows), 3))
    beyond = None if calibration.beyond is None else np.empty((len(rows), 3))
    for number in range(folds):
        out = fold == number
        fit = calibrate(replace(measurements, train=~out), calibration.coarse.arm, quick)
        unseen = measurements.rows(out)
        before[out], after[out] = residuals_of(fit.coarse, unseen), residuals_of(fit.cell, unseen)
        if beyond is not None:
            beyond[out] = residuals_of(fit.cell if fit.beyond is None else fit.beyond.cell, unseen)
    how = f"{folds}-fold cross-validation, whole {kind} left out together, seed {seed}"
    return HeldOut(rows, before, after, how, beyond)
