"""Rows that a fit left out: single slips are outliers, a whole sweep, pose, sphere or stretch of the session is not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm
from grindvision.calibration.diagnosis import SUSPICIOUS_MM
from grindvision.calibration.estimate import Sigmas, gauss_newton, residuals_of
from grindvision.calibration.joint_terms import JointCorrections, JointTerm, coupling_terms
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm
from grindvision.calibration.unknowns import Unknowns
from grindvision.errors import DegenerateError, GrindvisionError, InputError

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: A region is said to be dropped where so much of it is, and so much of what was dropped lies in it.
WHOLE, INSIDE = 0.75, 0.75

#: A row that a coupling brings this near agrees with it: the table is not free to follow yet.
AGREES_MM = 1.0

#: A coupling explains rows that were left out where it brings the errors of all rows down to this fraction.
BETTER = 0.7

#: Rows and poses that make a region; fewer are slips.
MIN_ROWS, MIN_POSES = 4, 3


@dataclass(frozen=True)
class DroppedGroup:
    """Rows that belong together and were dropped together: what they are, in words, and how many rows."""

    what: str
    rows: int
    is_sweep: bool


def dropped_groups(training: Measurements, kept: Flags) -> tuple[DroppedGroup, ...]:
    """Whole poses, spheres, ranges of a joint and stretches of the session among the dropped rows, largest first."""
    dropped = ~kept
    if dropped.sum() < 2:
        return ()
    groups = []
    session = _region(np.arange(len(training), dtype=float), dropped, training.pose)
    if session is not None:
        low, high, count = session
        groups.append(DroppedGroup(f"rows {int(low) + 1} to {int(high) + 1} of the training rows", count, False))
    for joint in range(training.q_rad.shape[1]):
        q = training.q_rad[:, joint]
        values, counts = np.unique(np.round(q, 3), return_counts=True)
        rest = float(values[np.argmax(counts)]) if counts.max() > 0.2 * len(q) else float(np.median(q))
        away = _region(np.abs(q - rest), dropped, training.pose)
        side = _region(q, dropped, training.pose)
        if away is not None and counts.max() > 0.2 * len(q):
            groups.append(
                DroppedGroup(f"every pose in which joint {joint + 1} moves away from its rest", away[2], True)
            )
        elif side is not None:
            low, high = np.degrees(side[:2])
            groups.append(DroppedGroup(f"every pose with q{joint + 1} from {low:.0f} to {high:.0f} deg", side[2], True))
    for labels, name in ((training.pose, "pose"), (training.sphere, "sphere")):
        if name == "sphere" and (training.sphere == training.pose).all():
            continue
        found, number, counts = np.unique(labels, return_inverse=True, return_counts=True)
        lost = np.bincount(number, dropped) / counts
        whole = np.flatnonzero((lost >= WHOLE) & (counts >= 2))
        if len(whole) and counts[whole].sum() >= 0.5 * dropped.sum():
            listed = ", ".join(map(str, found[whole][:6])) + (" and others" if len(whole) > 6 else "")
            plural = f"all rows of {name}{'s' if len(whole) > 1 else ''} {listed}"
            groups.append(DroppedGroup(plural, int(counts[whole].sum()), False))
    return tuple(sorted(groups, key=lambda group: -group.rows))


def _region(feature: Floats, dropped: Flags, pose: NDArray[np.str_]) -> tuple[float, float, int] | None:
    """The end of a feature's range that was dropped as a whole: the limits and the number of the dropped rows in it."""
    best = None
    for sign in (1.0, -1.0):
        order = np.argsort(-sign * feature, kind="stable")
        inside = np.cumsum(dropped[order])
        count = np.arange(1, len(order) + 1)
        edge = np.append(np.diff(feature[order]) != 0, True)
        good = edge & (inside >= WHOLE * count) & (inside >= INSIDE * dropped.sum()) & (inside >= MIN_ROWS)
        for last in np.flatnonzero(good)[::-1]:
            rows = order[: last + 1][dropped[order[: last + 1]]]
            if last + 1 < 0.6 * len(order) and len(np.unique(pose[rows])) >= MIN_POSES:
                found = (float(feature[rows].min()), float(feature[rows].max()), int(inside[last]))
                best = found if best is None or found[2] > best[2] else best
                break
    return best


def judge_dropped(
    cell: ScannerOnArm, nominal: MdhArm, unknowns: Unknowns, training: Measurements, kept: Flags, sigmas: Sigmas
) -> list[str]:
    """Refuse a fit that left a whole range of a joint out; return doubts in words about other groups left out.

    Raises:
        InputError: one joint driven along by another explains the rows left out. DegenerateError: nothing does.
    """
    groups = dropped_groups(training, kept)
    if not groups:
        return []
    errors = np.linalg.norm(residuals_of(cell, training), axis=1)[~kept]
    size = f"{errors.min():.2g} to {errors.max():.2g} mm off"
    sweep = next((group for group in groups if group.is_sweep), None)
    if sweep is not None and (errors.max() > SUSPICIOUS_MM or sweep.rows > 0.1 * len(training)):
        coupled = _coupling(cell, nominal, unknowns, training, kept, sigmas)
        text = f"{sweep.what} contradicts the others ({sweep.rows} rows, {size})"
        if coupled:
            raise InputError(f"{text}; {coupled}")
        raise DegenerateError(
            f"{text}: that is no slip of single rows; the joint turns otherwise than its column says (coupled to"
            " another, other sign, other ratio or unit): mend the column, or calibrate with --keep-all to see the"
            " residuals"
        )
    return [
        f"{group.what} were left out as if they were slips ({group.rows} rows, {size}): the result knows nothing"
        " of what happened there; look at them before you use it"
        for group in groups[:3]
    ]


def _coupling(
    cell: ScannerOnArm, nominal: MdhArm, unknowns: Unknowns, training: Measurements, kept: Flags, sigmas: Sigmas
) -> str:
    """The pair of joints whose coupling, fitted to all rows, leaves the least: in words, empty where none helps."""
    typical = max(float(np.median(np.linalg.norm(residuals_of(cell, training), axis=1)[kept])), 1e-3)
    loose = replace(sigmas, term_rad=1.0, rest_mm=max(sigmas.rest_mm, typical))

    def fitted(terms: tuple[JointTerm, ...], values: tuple[float, ...]) -> tuple[float, float, ScannerOnArm]:
        """Fraction of the rows that agree, geometric mean of the errors, and the cell."""
        start = replace(cell, corrections=JointCorrections(terms, values))
        wider = replace(unknowns, terms=terms)
        fit, *_ = gauss_newton(start, nominal, wider, training, loose, robust=True, iterations=8)
        errors = np.linalg.norm(residuals_of(fit, training), axis=1)
        agree = float((errors < max(8 * typical, AGREES_MM)).mean())
        return agree, float(np.exp(np.log(errors + 0.1 * typical).mean())), fit

    _, min_error, _ = fitted((), ())
    min_error *= BETTER
    found = ""
    for pair in coupling_terms(cell.arm):
        for term in (pair, replace(pair, joint=pair.source, source=pair.joint)):
            for begin in (0.0, 1.0, -1.0):
                try:
                    agree, error, fit = fitted((term,), (begin,))
                except GrindvisionError:
                    continue
                if agree > 0.95 and error < min_error:
                    min_error, factor = error, fit.corrections.values[0]
                    found = (
                        f"joint {term.joint + 1} is coupled to joint {term.source + 1}: with q{term.joint + 1} ="
                        f" q{term.joint + 1} {factor:+.4g} q{term.source + 1} {agree:.0%} of the rows agree; mend the"
                        f" column, as in --columns q{term.joint + 1}_deg=A{'+' if factor > 0 else '-'}B"
                    )
    return found
