"""Joint terms beyond the table's geometry, chosen by the error of rows that were held out, never by those fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm
from grindvision.calibration.estimate import Sigmas, estimate_sigmas, gauss_newton, residuals_of
from grindvision.calibration.joint_terms import (
    DOWN,
    JointCorrections,
    JointTerm,
    coupling_terms,
    sag_terms,
    uniform_load,
    wave_terms,
)
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm
from grindvision.calibration.statistics import ErrorStatistics, error_statistics
from grindvision.calibration.unknowns import Unknowns
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Folds that the choice is made on, and rows at most that it is made with.
FOLDS, MAX_ROWS = 4, 1200

#: Terms are taken only where the squared error of held-out poses falls by so many standard errors of that fall.
STANDARD_ERRORS = 2.0


@by_content
@dataclass(frozen=True)
class BeyondGeometry:
    """A cell with joint terms: its ``kind`` in words, the unknowns and noise it was fitted with.

    ``tried`` holds the held-out error of every kind tried, geometry alone first.
    """

    kind: str
    cell: ScannerOnArm
    unknowns: Unknowns
    sigmas: Sigmas
    tried: dict[str, ErrorStatistics]

    def __str__(self) -> str:
        first, chosen = self.tried["geometry alone"].rms, self.tried[self.kind].rms
        return f"{self.kind}: rms of held-out poses {chosen:.3f} mm instead of {first:.3f} mm"


def kinds_of_terms(
    arm: MdhArm, q_rad: Floats, down: tuple[float, float, float] = DOWN, gear_ratios: tuple[float, ...] = ()
) -> dict[str, tuple[JointTerm, ...]]:
    """The sets of joint terms that are tried; ``gear_ratios`` (one a joint) add one wave a turn of every motor."""
    waves, sag, coupling = wave_terms(arm), sag_terms(uniform_load(arm, down), q_rad), coupling_terms(arm)
    if gear_ratios:
        waves += tuple(
            JointTerm(joint, kind, abs(ratio))
            for joint, ratio in enumerate(gear_ratios)
            if ratio and not arm.prismatic[joint]
            for kind in ("cos", "sin")
        )
    kinds = {"gear waves": waves, "sag": sag, "gear waves and sag": waves + sag, "couplings": coupling}
    return {kind: terms for kind, terms in kinds.items() if terms}


def choose_terms(
    cell: ScannerOnArm,
    nominal: MdhArm,
    unknowns: Unknowns,
    used: Measurements,
    sigmas: Sigmas,
    kinds: dict[str, tuple[JointTerm, ...]],
    seed: int = 0,
) -> BeyondGeometry | None:
    """Fit every kind of terms on part of the poses, score it on the others, and return the best; None: geometry alone.

    Args:
        cell, unknowns, sigmas: the geometric fit of all rows of ``used``, where every fit starts.
        nominal: the arm as its maker has it.
        used: the training rows that the fit kept.
        kinds: see ``kinds_of_terms``.
        seed: chooses which poses are held out together.
    """
    rows = used
    if len(rows) > MAX_ROWS:
        order = np.lexsort([*rows.tracker_mm.T, *rows.q_rad.T])
        rows = rows.rows(order[np.linspace(0, len(order) - 1, MAX_ROWS).astype(int)])
    poses, number = np.unique(rows.pose, return_inverse=True)
    if len(poses) < max(2 * FOLDS, 12) or rows.equations < 1.5 * len(unknowns):
        return None
    fold_of_pose = np.random.default_rng(seed).permutation(len(poses)) % FOLDS
    fold = fold_of_pose[number]
    every: dict[str, tuple[JointTerm, ...]] = {"geometry alone": (), **kinds}
    squares: dict[str, Floats] = {}
    tried: dict[str, ErrorStatistics] = {}
    for kind, terms in every.items():
        left = np.empty((len(rows), 3))
        for out in range(FOLDS):
            start = _with_terms(cell, terms)
            fit = _fitted(start, nominal, replace(unknowns, terms=terms), rows.rows(fold != out), sigmas)[0]
            left[fold == out] = residuals_of(fit, rows.rows(fold == out))
        tried[kind] = error_statistics(left)
        squares[kind] = np.bincount(number, (left**2).sum(axis=1)) / np.bincount(number)
    best = min(every, key=lambda kind: (round(tried[kind].rms, 9), len(every[kind])))
    fall = squares["geometry alone"] - squares[best]
    if best == "geometry alone" or fall.mean() < STANDARD_ERRORS * fall.std(ddof=1) / np.sqrt(len(fall)):
        return None
    final = replace(unknowns, terms=every[best])
    fitted, learnt = _fitted(_with_terms(cell, every[best]), nominal, final, used, sigmas)
    return BeyondGeometry(best, fitted, final, learnt, tried)


def _with_terms(cell: ScannerOnArm, terms: tuple[JointTerm, ...]) -> ScannerOnArm:
    return replace(cell, corrections=JointCorrections(terms, (0.0,) * len(terms)))


def _fitted(
    start: ScannerOnArm, nominal: MdhArm, unknowns: Unknowns, rows: Measurements, sigmas: Sigmas
) -> tuple[ScannerOnArm, Sigmas]:
    learnt = sigmas
    for _ in range(2 if unknowns.terms else 1):
        learnt = estimate_sigmas(start, nominal, unknowns, rows, learnt, iterations=20)
        start, *_ = gauss_newton(start, nominal, unknowns, rows, learnt, iterations=8)
    return start, learnt
