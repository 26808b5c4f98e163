"""Errors on measurements that the fit has not seen: the test rows, or cross-validation where there are none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.calibration.accurate import Calibration, Options, calibrate
from grindvision.calibration.estimate import residuals_of
from grindvision.calibration.statistics import ErrorStatistics, error_statistics
from grindvision.errors import DegenerateError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class HeldOut:
    """Residuals (H, 3) in mm of the unseen ``rows`` (H,), before and after; ``how`` says what was unseen."""

    rows: NDArray[np.int64]
    before_mm: Floats
    after_mm: Floats
    how: str

    @property
    def before(self) -> ErrorStatistics:
        """Statistics before calibration."""
        return error_statistics(self.before_mm)

    @property
    def after(self) -> ErrorStatistics:
        """Statistics after calibration."""
        return error_statistics(self.after_mm)

    def __str__(self) -> str:
        return f"unseen: {self.after}; before: mean {self.before.mean:.3f} mm; {self.how}"


def on_test_rows(calibration: Calibration) -> HeldOut:
    """Errors of a calibration on the test rows of its own measurements."""
    rows = np.flatnonzero(~calibration.measurements.train)
    test = calibration.measurements.rows(rows)
    before, after = residuals_of(calibration.coarse, test), residuals_of(calibration.cell, test)
    return HeldOut(rows, before, after, f"{len(rows)} test rows as the file marks them")


def cross_validated(calibration: Calibration, options: Options, folds: int = 5, seed: int = 0) -> HeldOut:
    """Errors of fits that left out one fold after the other, for a calibration whose measurements have no test rows.

    Whole spheres stay out together, or whole poses where there are fewer spheres than ``folds``. Rows that the
    calibration dropped stay out of it. Where the rows are so few that a fold could not be spared, each group is one.

    Raises:
        DegenerateError: one sphere and one pose only.
    """
    measurements = calibration.measurements
    rows = np.setdiff1d(np.arange(len(measurements)), calibration.dropped)
    labels, kind = measurements.sphere[rows], "spheres"
    if len(np.unique(labels)) < folds:
        labels, kind = measurements.pose[rows], "poses"
    groups = np.unique(labels)
    spared = len(rows) - len(calibration.unknowns) // 3 - 1
    folds = min(folds, len(groups)) if spared >= len(rows) / folds else len(groups)
    if folds < 2:
        raise DegenerateError("all rows carry one sphere and one pose label; label them, so that some can be held out")
    part = dict(zip(np.random.default_rng(seed).permutation(groups), np.arange(len(groups)) % folds, strict=True))
    fold = np.array([part[label] for label in labels])
    before, after = np.empty((len(rows), 3)), np.empty((len(rows), 3))
    for number in range(folds):
        out = fold == number
        train = np.zeros(len(measurements), dtype=bool)
        train[rows[~out]] = True
        fit = calibrate(replace(measurements, train=train), calibration.coarse.arm, options)
        unseen = measurements.rows(rows[out])
        before[out], after[out] = residuals_of(fit.coarse, unseen), residuals_of(fit.cell, unseen)
    return HeldOut(rows, before, after, f"{folds}-fold cross-validation, whole {kind} left out together, seed {seed}")
