"""A fit that leaves, drops or moves too much: which mistake in the columns or the table explains it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import PARAMETERS, MdhArm
from grindvision.calibration.estimate import residuals_of
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.mistakes import Mistake, mistakes, shifted_rows
from grindvision.calibration.model import ScannerOnArm
from grindvision.calibration.starts import closed_form_errors, median_error
from grindvision.calibration.unknowns import entry_name
from grindvision.errors import DegenerateError, GrindvisionError, InputError

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: A fit that leaves more than this is looked at twice; real arms and sphere scans leave a tenth of it.
SUSPICIOUS_MM = 1.5

#: No sound machine deviates more than this from its drawing.
FAR_MM, FAR_RAD = 15.0, 0.05

#: Axes whose angle has a smaller sine are parallel; entries that moved so many times further than machines deviate
#: belong to another arm.
PARALLEL, OTHER_TABLE = 0.02, 2.5

#: A table whose lengths moved by more than this fraction of the arm's reach describes another arm.
OTHER_ARM = 0.25

#: An axis that stands so far from where the table has it (rad) is another axis.
OTHER_AXIS_RAD = 0.35

#: What a mistake must leave at most to explain anything, mm or as a fraction of the arm's reach.
EXPLAINS_MM, EXPLAINS_FRACTION = 15.0, 0.04

#: Mistakes that may come together, and how many candidates for the first are followed.
MAX_MISTAKES, FOLLOWED = 2, 2


def check_fit(
    coarse: ScannerOnArm,
    cell: ScannerOnArm,
    measurements: Measurements,
    fitted: NDArray[np.int64],
    kept: Flags,
    base_fixed: bool,
    seed: int = 0,
) -> list[str]:
    """Look at a fit that leaves, drops or moves too much, find the reason, and return what stays unexplained in words.

    Args:
        coarse, cell: before and after the fit.
        measurements: all rows; ``fitted`` numbers those the fit was given, ``kept`` marks which of these it kept.
        fitted, kept: see above.
        base_fixed: whether the tracker's frame was taken as the base.

    Raises:
        UnitError, InputError: degrees, other units of length, a joint that counts the other way, two joints swapped, a
            coupled joint, a shifted pairing, a mirrored frame or a standard DH table explains the data far better; or
            nothing does.
        DegenerateError: a third of the rows or more contradict the rest.
    """
    training = measurements.rows(fitted)
    typical = median_error(cell, training)
    moved = far_from_nominal(cell.arm, coarse.arm)
    if typical <= SUSPICIOUS_MM and kept.mean() > 0.95 and not moved:
        return []
    if typical <= SUSPICIOUS_MM and kept.mean() <= 0.95:
        _refuse_shifted_pairing(cell, measurements, fitted, kept)
    if measurements.tracked.all():
        _explain(measurements, fitted, coarse, base_fixed, seed)
    reach = _reach(coarse.arm)
    change = np.abs(cell.arm.table - coarse.arm.table)[:, 1:3]
    if change.max() > max(OTHER_ARM * reach, 4 * FAR_MM):
        joint, column = np.unravel_index(int(np.argmax(change)), change.shape)
        name = entry_name(5 * int(joint) + 1 + int(column))
        raise InputError(
            f"the fit moved {name} by {change.max():.4g} mm, which no arm of this table does; check the table, the unit"
            " of every column (mm, m, inches?) and which joint carries the scanner"
        )
    alpha_change = np.abs((cell.arm.table - coarse.arm.table)[:, 0])
    alpha_change = np.minimum(alpha_change, np.abs(2 * np.pi - alpha_change))
    if typical <= SUSPICIOUS_MM and alpha_change.max() > OTHER_AXIS_RAD:
        axis = int(np.argmax(alpha_change))
        raise InputError(
            f"the fit turned {entry_name(5 * axis)} by {np.degrees(alpha_change.max()):.0f} deg, which no arm of this"
            f" table does; check which of q1 to q{max(axis + 1, 2)} count the other way round, and the table"
        )
    if typical <= SUSPICIOUS_MM and kept.mean() > 0.7:
        return moved
    if kept.mean() <= 0.7:
        raise DegenerateError(
            f"{int((~kept).sum())} of {len(kept)} training rows contradict the rest;"
            " check the pairing of scans and spheres"
        )
    if typical > max(10.0, 0.01 * reach):
        raise InputError(
            f"no arm of this structure fits: {typical:.1f} mm are left in the median; check the robot table"
            " (modified, not standard DH; mm), the joints' directions and zeros, the units of all columns, which joint"
            " carries the scanner, whether the arm stands on a track or a turntable that the table leaves out, and that"
            " every row pairs a pose with its own point"
        )
    return [
        *moved,
        f"the fit leaves {typical:.2f} mm in the median, much for a sphere scan: check table, units and pairing",
    ]


def _refuse_shifted_pairing(
    cell: ScannerOnArm, measurements: Measurements, fitted: NDArray[np.int64], kept: Flags
) -> None:
    training = measurements.rows(fitted)
    typical = median_error(cell, training)

    def agreeing(rows: Measurements) -> float:
        return float((np.linalg.norm(residuals_of(cell, rows), axis=1) < 6 * typical).mean())

    agree = agreeing(training)
    for mistake in shifted_rows(measurements):
        then = agreeing(mistake.change(measurements).rows(fitted))
        if then > max(0.95, agree, kept.mean()):
            raise InputError(f"{mistake.reason}: then {then:.0%} of the rows agree instead of {agree:.0%}; mend it")


def _explain(
    measurements: Measurements, fitted: NDArray[np.int64], coarse: ScannerOnArm, base_fixed: bool, seed: int
) -> None:
    """Refuse with the mistakes, up to two at once, that explain the data best, if they explain them far better.

    Raises:
        InputError, UnitError: see ``check_fit``.
    """

    def errors(changed: Measurements, arm: MdhArm) -> Floats:
        try:
            return closed_form_errors(changed.rows(fitted), arm, base_fixed, seed)
        except GrindvisionError:
            return np.array([np.inf])

    given = np.linalg.norm(residuals_of(coarse, measurements.rows(fitted)), axis=1)
    chains: list[tuple[float, tuple[Mistake, ...], Measurements, MdhArm, Floats]] = [
        (_score(given), (), measurements, coarse.arm, given)
    ]
    best = chains[0]
    for depth in range(MAX_MISTAKES):
        longer = []
        for _, chain, data, arm, _ in chains:
            for mistake in mistakes(data, arm, fitted, single=depth == 0, seed=seed):
                if mistake.reason in [earlier.reason for earlier in chain]:
                    continue
                changed, other = mistake.change(data), mistake.arm or arm
                left = errors(changed, other)
                longer.append((_score(left), (*chain, mistake), changed, other, left))
        longer.sort(key=lambda one: one[0])
        if not longer or not (
            longer[0][0] < 0.5 * best[0] or np.quantile(longer[0][4], 0.9) < 0.2 * np.quantile(best[4], 0.9)
        ):
            break
        best, chains = longer[0], longer[:FOLLOWED]
        if np.quantile(best[4], 0.9) < max(0.02 * np.quantile(given, 0.9), SUSPICIOUS_MM):
            break
    _, chain, _, _, left = best
    if not chain:
        return
    before, after = (float(np.quantile(lengths, 0.9)) for lengths in (given, left))
    median_before, median_after = float(np.median(given)), float(np.median(left))
    enough = max(EXPLAINS_MM, EXPLAINS_FRACTION * _reach(coarse.arm))
    if min(after, median_after) < enough and (after < 0.2 * before or median_after < 0.2 * median_before):
        others = [one[1][0].reason for one in chains[1:] if len(one[1]) == len(chain) and one[0] < 1.1 * best[0]]
        same = [reason for reason in dict.fromkeys(others) if reason != chain[0].reason]
        alternative = f" (or, as good: {same[0]})" if same and len(chain) == 1 else ""
        rest = ""
        if after > 5 * max(median_after, 1.0):
            rest = f"; yet {(left > 5 * max(median_after, 1.0)).mean():.0%} of the rows stay off, so it is not all"
        shown = (median_before, median_after) if median_after < 0.5 * median_before else (before, after)
        what = "table" if chain[0].arm is not None else "columns"
        raise chain[0].kind(
            f"{' and '.join(mistake.reason for mistake in chain)}{alternative}: then the nominal arm leaves"
            f" {shown[1]:.2f} mm instead of {shown[0]:.1f} mm{rest}; mend the {what}"
        )


def _reach(arm: MdhArm) -> float:
    return float(np.hypot(arm.table[:, 1], arm.table[:, 2]).sum())


def _score(lengths: Floats) -> float:
    """Geometric mean of errors, with 0.3 mm for good: falls with every row that a change mends."""
    return float(np.exp(np.log(np.minimum(lengths, 1e9) + 0.3).mean()))


def far_from_nominal(arm: MdhArm, nominal: MdhArm) -> list[str]:
    """Warn of table entries that no machine tolerance explains; the fit may be right, the nominal table is not.

    Offsets along axes that are parallel act as their sum, so that this is judged too.
    """
    change = arm.table - nominal.table
    sizes = np.where([name.endswith("_mm") for name in PARAMETERS], np.abs(change) / FAR_MM, np.abs(change) / FAR_RAD)
    worst = int(np.argmax(sizes))
    name, moved, size = entry_name(worst), abs(float(change.ravel()[worst])), float(sizes.ravel()[worst])
    runs = np.split(np.arange(arm.n), np.flatnonzero(np.abs(np.sin(nominal.table[1:, 0])) > PARALLEL) + 1)
    for run in runs:
        total = abs(float(change[run, 2].sum()))
        if len(run) > 1 and total / FAR_MM > size:
            name, moved, size = " + ".join(entry_name(5 * int(joint) + 2) for joint in run), total, total / FAR_MM
    if size < 1:
        return []
    amount = f"{moved:.4g} mm" if name.endswith("_mm") else f"{moved:.4g} rad ({np.degrees(moved):.3g} deg)"
    advice = "more than machines deviate: check the table"
    far = sizes.ravel() > 1
    if name.startswith("theta") and far.sum() == np.count_nonzero(far[3 :: len(PARAMETERS)]):
        advice = (
            "no other length or tilt does: its zero is counted from elsewhere than the table has it; mend that entry,"
            " or the offset that the controller adds"
        )
    elif far.sum() == 1 and name == entry_name(worst):
        advice = "no other entry does: it is mistyped there, by the look of it; mend that entry"
    elif size > OTHER_TABLE:
        advice = "this is another arm's table, by the look of it: give the right one, with its limits and speeds"
    return [f"{name} moved by {amount} from the robot table, {advice}"]
