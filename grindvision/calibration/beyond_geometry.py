"""Joint terms beyond the table's geometry, chosen by the error of rows that were held out, never by those fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm
from grindvision.calibration.estimate import Sigmas, estimate_sigmas, gauss_newton, residuals_of
from grindvision.calibration.joint_terms import (
    GravityLoad,
    JointCorrections,
    JointTerm,
    coupling_terms,
    sag_terms,
    wave_pair,
    wave_terms,
)
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm
from grindvision.calibration.statistics import ErrorStatistics, error_statistics
from grindvision.calibration.unknowns import Unknowns
from grindvision.calibration.wave_search import find_waves
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Folds that the choice is made on, and rows at most that it is made with.
FOLDS, MAX_ROWS = 4, 1200

#: Terms are taken only where the squared error of held-out poses falls by so many standard errors of that fall.
STANDARD_ERRORS = 2.0

#: Searches for waves, each with the noise that the waves found before leave.
SEARCHES = 4

GEOMETRY_ALONE, WAVES_FOUND = "geometry alone", "gear waves found"


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

    @property
    def waves(self) -> dict[int, tuple[float, ...]]:
        """Waves a turn of every joint (from 0) that has some."""
        orders: dict[int, set[float]] = {}
        for term in self.unknowns.terms:
            if term.kind in ("cos", "sin"):
                orders.setdefault(term.joint, set()).add(term.order)
        return {joint: tuple(sorted(found)) for joint, found in sorted(orders.items())}

    def __str__(self) -> str:
        first, chosen = self.tried[GEOMETRY_ALONE].rms, self.tried[self.kind].rms
        told = ""
        if self.kind.startswith(WAVES_FOUND):
            told = " (a turn of " + ", ".join(
                f"q{joint + 1}: {' '.join(f'{order:g}' for order in orders)}" for joint, orders in self.waves.items()
            )
            told += ")"
        return f"{self.kind}{told}: rms of held-out poses {chosen:.3f} mm instead of {first:.3f} mm"


@dataclass(frozen=True)
class TermKind:
    """Joint terms that are tried together; ``search``: with waves whose number a turn is looked for in the data."""

    terms: tuple[JointTerm, ...] = ()
    search: bool = False


def kinds_of_terms(load: GravityLoad, q_rad: Floats, gear_ratios: tuple[float, ...] = ()) -> dict[str, TermKind]:
    """The sets of joint terms that are tried; ``gear_ratios`` (one a joint) add one wave a turn of every motor."""
    arm = load.arm
    waves, sag, coupling = wave_terms(arm), sag_terms(load, q_rad), coupling_terms(arm)
    if gear_ratios:
        waves += tuple(
            term
            for joint, ratio in enumerate(gear_ratios)
            if ratio and not arm.prismatic[joint]
            for term in wave_pair(joint, abs(ratio))
        )
    kinds = {"gear waves": waves, "sag": sag, "gear waves and sag": waves + sag, "couplings": coupling}
    found = {kind: TermKind(terms) for kind, terms in kinds.items() if terms}
    if waves:
        found[WAVES_FOUND] = TermKind(search=True)
        if sag:
            found[f"{WAVES_FOUND}, and sag"] = TermKind(sag, search=True)
    return found


def choose_terms(
    cell: ScannerOnArm,
    nominal: MdhArm,
    unknowns: Unknowns,
    used: Measurements,
    sigmas: Sigmas,
    kinds: dict[str, TermKind],
    seed: int = 0,
) -> BeyondGeometry | None:
    """Fit every kind of terms on part of the poses, score it on the others, and return the best; None: geometry alone.

    Waves that are looked for are looked for in the fitted part alone.

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
    every = {GEOMETRY_ALONE: TermKind(), **kinds}
    squares: dict[str, Floats] = {}
    tried: dict[str, ErrorStatistics] = {}
    for kind, terms in every.items():
        left = np.empty((len(rows), 3))
        for out in range(FOLDS):
            fit, *_ = _fitted(cell, terms, nominal, unknowns, rows.rows(fold != out), sigmas)
            left[fold == out] = residuals_of(fit, rows.rows(fold == out))
        tried[kind] = error_statistics(left)
        squares[kind] = np.bincount(number, (left**2).sum(axis=1)) / np.bincount(number)
    best = min(every, key=lambda kind: (round(tried[kind].rms, 9), len(every[kind].terms)))
    fall = squares[GEOMETRY_ALONE] - squares[best]
    if best == GEOMETRY_ALONE or fall.mean() < STANDARD_ERRORS * fall.std(ddof=1) / np.sqrt(len(fall)):
        return None
    fitted, learnt, final = _fitted(cell, every[best], nominal, unknowns, used, sigmas)
    return BeyondGeometry(best, fitted, final, learnt, tried)


def _with_terms(cell: ScannerOnArm, terms: tuple[JointTerm, ...]) -> ScannerOnArm:
    return replace(cell, corrections=JointCorrections(terms, (0.0,) * len(terms)))


def _fitted(
    start: ScannerOnArm, kind: TermKind, nominal: MdhArm, unknowns: Unknowns, rows: Measurements, sigmas: Sigmas
) -> tuple[ScannerOnArm, Sigmas, Unknowns]:
    """The cell with terms of this kind that fits the rows, the noise found, and the unknowns with the terms."""
    learnt, wider = sigmas, replace(unknowns, terms=kind.terms)
    cell = _with_terms(start, kind.terms)
    for _ in range(2 if kind.terms else 1):
        cell, learnt = _refitted(cell, nominal, wider, rows, learnt)
    for _ in range(SEARCHES if kind.search else 0):
        found = find_waves(cell, nominal, wider, rows, learnt)
        if not found:
            break
        wider = replace(wider, terms=wider.terms + found)
        cell = _with_terms(start, wider.terms)
        for _ in range(2):
            cell, learnt = _refitted(cell, nominal, wider, rows, learnt)
    return cell, learnt, wider


def _refitted(
    start: ScannerOnArm, nominal: MdhArm, unknowns: Unknowns, rows: Measurements, sigmas: Sigmas
) -> tuple[ScannerOnArm, Sigmas]:
    learnt = estimate_sigmas(start, nominal, unknowns, rows, sigmas, iterations=20)
    return gauss_newton(start, nominal, unknowns, rows, learnt, iterations=8)[0], learnt
