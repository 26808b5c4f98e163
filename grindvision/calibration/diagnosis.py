"""A fit that leaves, drops or moves too much: which mistake in the columns or the table explains it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import PARAMETERS, MdhArm
from grindvision.calibration.estimate import residuals_of
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm, entry_name
from grindvision.calibration.starts import closed_form_errors, median_error, unit_factors
from grindvision.errors import DegenerateError, GrindvisionError, InputError, UnitError

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Change = Callable[[Measurements], Measurements]

#: A fit that leaves more than this is looked at twice; real arms and sphere scans leave a tenth of it.
SUSPICIOUS_MM = 1.5

#: No sound machine deviates more than this from its drawing.
FAR_MM, FAR_RAD = 15.0, 0.05

#: A table whose lengths moved by more than this fraction of the arm's reach describes another arm.
OTHER_ARM = 0.25

#: Lengths by the factor that turns them into millimetres.
UNIT_NAMES = {
    1000.0: "metres", 304.8: "feet", 100.0: "decimetres", 25.4: "inches", 10.0: "centimetres", 914.4: "yards",
    0.0254: "mils", 0.001: "micrometres",
}  # fmt: skip

#: A factor this near to a unit's is that unit; this far from 1 it is no error of scale.
UNIT_TOLERANCE, LEAST_FACTOR = 0.04, 0.05

#: Mistakes that may come together, and how many candidates for the first are followed.
MAX_MISTAKES, FOLLOWED = 2, 2


@dataclass(frozen=True)
class Mistake:
    """One mistake: a sentence, the error to raise, what to mend, and the data or the table without it."""

    reason: str
    kind: type[GrindvisionError]
    change: Change = lambda m: m
    arm: MdhArm | None = None


def check_fit(
    coarse: ScannerOnArm,
    cell: ScannerOnArm,
    measurements: Measurements,
    fitted: NDArray[np.int64],
    kept: Flags,
    base_fixed: bool,
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
        _explain(measurements, fitted, coarse, base_fixed)
    reach = float(np.hypot(coarse.arm.table[:, 1], coarse.arm.table[:, 2]).sum())
    change = np.abs(cell.arm.table - coarse.arm.table)[:, 1:3]
    if change.max() > max(OTHER_ARM * reach, 4 * FAR_MM):
        joint, column = np.unravel_index(int(np.argmax(change)), change.shape)
        name = entry_name(5 * int(joint) + 1 + int(column))
        raise InputError(
            f"the fit moved {name} by {change.max():.4g} mm, which no arm of this table does; check the table, the unit"
            " of every column (mm, m, inches?) and which joint carries the scanner"
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
            " (modified, not standard DH), the joints' directions and zeros, which joint carries the scanner, and"
            " whether the arm stands on a track or a turntable that the table leaves out"
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
    for mistake in _shifted(measurements):
        then = agreeing(mistake.change(measurements).rows(fitted))
        if then > max(0.95, agree, kept.mean()):
            raise InputError(f"{mistake.reason}: then {then:.0%} of the rows agree instead of {agree:.0%}; mend it")


def _explain(measurements: Measurements, fitted: NDArray[np.int64], coarse: ScannerOnArm, base_fixed: bool) -> None:
    """Refuse with the mistakes, up to two at once, that explain the data best, if they explain them far better.

    Raises:
        InputError, UnitError: see ``check_fit``.
    """

    def errors(changed: Measurements, arm: MdhArm) -> Floats:
        try:
            return closed_form_errors(changed.rows(fitted), arm, base_fixed)
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
            for mistake in _mistakes(data, arm, fitted, single=depth == 0):
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
    if after < 0.2 * before or median_after < 0.2 * median_before:
        others = [one[1][0].reason for one in chains[1:] if len(one[1]) == len(chain) and one[0] < 1.1 * best[0]]
        same = [reason for reason in dict.fromkeys(others) if reason != chain[0].reason]
        doubt = f" (or, as good: {same[0]})" if same and len(chain) == 1 else ""
        rest = ""
        if after > 5 * max(median_after, 1.0):
            rest = f"; yet {(left > 5 * max(median_after, 1.0)).mean():.0%} of the rows stay off, so it is not all"
        shown = (median_before, median_after) if median_after < 0.5 * median_before else (before, after)
        what = "table" if chain[0].arm is not None else "columns"
        raise chain[0].kind(
            f"{' and '.join(mistake.reason for mistake in chain)}{doubt}: then the nominal arm leaves"
            f" {shown[1]:.2f} mm instead of {shown[0]:.1f} mm{rest}; mend the {what}"
        )


def _score(lengths: Floats) -> float:
    """Geometric mean of errors, with 0.3 mm for good: falls with every row that a change mends."""
    return float(np.exp(np.log(np.minimum(lengths, 1e9) + 0.3).mean()))


def _mistakes(measurements: Measurements, arm: MdhArm, fitted: NDArray[np.int64], single: bool) -> Iterator[Mistake]:
    """Every mistake that is looked for; ``single``: those too that never come on top of another."""
    if single:
        yield from _shifted(measurements)
        yield from _in_metres(measurements)
        yield Mistake(
            "the robot table is a standard DH table: move alpha and a one row down, with 0 in the first row",
            InputError,
            arm=_from_standard(arm),
        )
    yield from _other_units(measurements, arm, fitted)
    yield from _joint_mistakes(measurements)
    for column, name in (("tracker_mm", "b"), ("scanner_mm", "s"))[: 1 if measurements.on_tool else 2]:
        yield Mistake(
            f"columns {name}x_mm to {name}z_mm are mirrored (two swapped, or one with the wrong sign)",
            InputError,
            _changing(column, partial(np.multiply, [1.0, -1.0, 1.0])),
        )
    yield from _couplings(measurements)


def _changing(column: str, change: Callable[[Floats], Floats]) -> Change:
    def changed(measurements: Measurements) -> Measurements:
        changes: dict[str, Any] = {column: change(getattr(measurements, column))}
        return replace(measurements, **changes)

    return changed


def _mixed(angles: Floats, mixing: Floats) -> Floats:
    return angles @ mixing


def _shifted(measurements: Measurements) -> list[Mistake]:
    columns = [("tracker_mm", "tracker readings"), ("q_rad", "joint angles"), ("scanner_mm", "scans")]
    return [
        Mistake(
            f"the rows of {what} are shifted by {shift} against the other columns",
            InputError,
            _changing(column, partial(np.roll, shift=-shift, axis=0)),
        )
        for column, what in columns[: 2 if measurements.on_tool else 3]
        for shift in (1, -1)
    ]


def _in_metres(measurements: Measurements) -> Iterator[Mistake]:
    for column, name in (("tracker_mm", "b"), ("scanner_mm", "s"))[: 1 if measurements.on_tool else 2]:
        for axes in ([0], [1], [2], [0, 1, 2]):
            yield Mistake(
                f"{', '.join(name + 'xyz'[axis] + '_mm' for axis in axes)} in metres, by the look of it",
                UnitError,
                _changing(column, partial(np.multiply, np.where(np.isin(np.arange(3), axes), 1000.0, 1.0))),
            )


def _other_units(measurements: Measurements, arm: MdhArm, fitted: NDArray[np.int64]) -> Iterator[Mistake]:
    """Lengths of the tracker, the scanner or the table that are all too large or too small by one factor."""
    tracker, scanner = unit_factors(measurements.rows(fitted), arm)
    columns = [("tracker_mm", "bx_mm to bz_mm", tracker), ("scanner_mm", "sx_mm to sz_mm", scanner)]
    for column, names, found in columns:
        if np.isfinite(found) and found > 0 and abs(np.log(found)) > LEAST_FACTOR:
            factor, unit = _named_factor(found)
            hint = f": {unit}?" if unit else ""
            against = " (or the robot table the other way)" if measurements.on_tool else ""
            yield Mistake(
                f"columns {names} are {_times(factor)} for the robot table{hint}{against}",
                UnitError,
                _changing(column, partial(np.multiply, factor)),
            )
    if np.isfinite(scanner) and scanner > 0 and abs(np.log(tracker / scanner)) < 0.1:
        factor, unit = _named_factor(1 / tracker)
        if abs(np.log(factor)) > LEAST_FACTOR:
            table = arm.table * [1.0, factor, factor, 1.0, 1.0]
            hint = f": {unit}?" if unit else ""
            yield Mistake(
                f"the robot table's lengths are {_times(factor)} for the measured points{hint}",
                UnitError,
                arm=arm.with_table(table),
            )


def _named_factor(found: float) -> tuple[float, str]:
    for factor, name in UNIT_NAMES.items():
        if abs(np.log(found / factor)) < UNIT_TOLERANCE:
            return factor, name
        if abs(np.log(found * factor)) < UNIT_TOLERANCE:
            return 1 / factor, f"{name} taken for millimetres on the other side"
    return found, ""


def _times(factor: float) -> str:
    return f"{factor:.4g} times too small" if factor > 1 else f"{1 / factor:.4g} times too large"


def _joint_mistakes(measurements: Measurements) -> Iterator[Mistake]:
    joints = measurements.q_rad.shape[1]
    numbers = np.arange(joints)
    for one, other in combinations(range(joints), 2):
        order = numbers.copy()
        order[[one, other]] = other, one
        yield Mistake(
            f"columns q{one + 1} and q{other + 1} are swapped",
            InputError,
            _changing("q_rad", partial(np.take, indices=order, axis=1)),
        )
    for joint in range(joints):
        yield Mistake(
            f"column q{joint + 1}_rad looks like degrees",
            UnitError,
            _changing("q_rad", partial(np.multiply, np.where(numbers == joint, np.pi / 180, 1.0))),
        )
    for first in range(joints):
        for last in range(first, joints):
            names = f"column q{first + 1}_rad counts" if first == last else f"columns q{first + 1} to q{last + 1} count"
            yield Mistake(
                f"{names} the other way round than the robot table",
                InputError,
                _changing("q_rad", partial(np.multiply, np.where((numbers >= first) & (numbers <= last), -1.0, 1.0))),
            )


def _couplings(measurements: Measurements) -> Iterator[Mistake]:
    """A joint whose motor is counted against the base or against another link: one angle is added to another's."""
    joints = measurements.q_rad.shape[1]
    for source, joint in combinations(range(joints), 2):
        for factor, sign in ((1.0, "+"), (-1.0, "-")):
            name, mixing = f"q{joint + 1}", np.eye(joints)
            mixing[source, joint] = factor
            yield Mistake(
                f"joint {joint + 1} is coupled to joint {source + 1} ({name} = {name} {sign} q{source + 1})",
                InputError,
                _changing("q_rad", partial(_mixed, mixing=mixing)),
            )


def _from_standard(arm: MdhArm) -> MdhArm:
    """The arm, but for its tool, whose standard DH table (alpha and a behind the joint) was given as a modified one."""
    table = arm.table.copy()
    table[:, :2] = np.roll(table[:, :2], 1, axis=0)
    table[0, :2] = 0.0
    return arm.with_table(table)


def far_from_nominal(arm: MdhArm, nominal: MdhArm) -> list[str]:
    """Warn of table entries that no machine tolerance explains; the fit may be right, the nominal table is not."""
    change = np.abs(arm.table - nominal.table)
    sizes = np.where([name.endswith("_mm") for name in PARAMETERS], change / FAR_MM, change / FAR_RAD).ravel()
    worst = int(np.argmax(sizes))
    if sizes[worst] < 1:
        return []
    changed = f"{change.ravel()[worst]:.4g}"
    return [f"{entry_name(worst)} moved by {changed} from the robot table, more than machines deviate: check the table"]
