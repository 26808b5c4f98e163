"""Bad measurements, found before and after the fit: wrong units, copies, one pose only, shifted rows, mirrored axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import PARAMETERS, MdhArm
from grindvision.calibration.estimate import residuals_of
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm, entry_name
from grindvision.calibration.starts import closed_form_error, median_error
from grindvision.errors import DegenerateError, GrindvisionError, InputError, UnitError

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Change = Callable[[Measurements], Measurements]

#: A fit that leaves more than this is looked at twice; real arms and sphere scans leave a tenth of it.
SUSPICIOUS_MM = 1.5

#: No sound machine deviates more than this from its drawing.
FAR_MM, FAR_RAD = 15.0, 0.05

#: No tracker and no scanner measures so far from the origin of its frame.
FARTHEST_MM = 1e6


def check_measurements(measurements: Measurements, arm: MdhArm, unknowns: int) -> tuple[str, ...]:
    """Refuse what cannot be calibrated with, and return warnings in words about what can but should be known.

    Raises:
        InputError: joints do not fit the arm. UnitError: degrees or metres. DegenerateError: too few rows, one pose
        only.
    """
    if measurements.q_rad.shape[1] != arm.n:
        raise InputError(f"measurements of {measurements.q_rad.shape[1]} joints for an arm of {arm.n}")
    _check_units(measurements, arm)
    good = measurements.rows(without_copies(measurements) & measurements.train)
    if 3 * len(good) <= unknowns:
        raise DegenerateError(
            f"{len(good)} different training measurements give {3 * len(good)} equations for {unknowns} unknowns;"
            f" measure at least {unknowns // 3 + 1}, better {unknowns}, or hold some parameters"
        )
    moved = np.ptp(good.q_rad, axis=0)
    if moved.max() < 1e-3:
        raise DegenerateError(
            f"all {len(good)} training rows have the same joint angles (within {np.degrees(moved.max()):.2g} deg);"
            " nothing about the arm can be learnt from one pose: measure in many"
        )
    warnings = []
    copies = len(measurements) - int(without_copies(measurements).sum())
    if copies:
        row = int(np.argmin(without_copies(measurements)))
        warnings.append(
            f"{copies} rows are copies of earlier ones and were not counted twice, first {measurements.label(row)}"
        )
    still = [f"q{i + 1}" for i in np.flatnonzero(moved < 1e-3)]
    if still:
        warnings.append(
            f"joint {', '.join(still)} never moves in the training rows: its parameters cannot be told apart"
        )
    if 3 * len(good) < 2 * unknowns:
        warnings.append(f"only {3 * len(good)} equations for {unknowns} unknowns: the errors on training rows flatter")
    return tuple(warnings)


def without_copies(measurements: Measurements) -> Flags:
    """Flags (M,) of the rows that are no exact copy of an earlier row."""
    rows = np.hstack([measurements.q_rad, measurements.scanner_mm, measurements.tracker_mm])
    flags = np.zeros(len(rows), dtype=bool)
    flags[np.unique(rows, axis=0, return_index=True)[1]] = True
    return flags


def check_fit(
    coarse: ScannerOnArm,
    cell: ScannerOnArm,
    measurements: Measurements,
    fitted: NDArray[np.int64],
    kept: Flags,
    base_fixed: bool,
) -> list[str]:
    """Look at a fit that leaves or drops too much, find the reason, and return what stays unexplained as a warning.

    Args:
        coarse, cell: before and after the fit.
        measurements: all rows; ``fitted`` numbers those the fit was given, ``kept`` marks which of these it kept.
        fitted, kept: see above.
        base_fixed: whether the tracker's frame was taken as the base.

    Raises:
        UnitError, InputError: degrees, metres, a joint that counts the other way, two joints swapped, a shifted
            pairing, a mirrored frame or a standard DH table explains the data far better; or nothing does.
        DegenerateError: a third of the rows or more contradict the rest.
    """
    training = measurements.rows(fitted)
    typical = median_error(cell, training)
    if typical <= SUSPICIOUS_MM and kept.mean() > 0.95:
        return []
    if typical <= SUSPICIOUS_MM:

        def agreeing(rows: Measurements) -> float:
            return float((np.linalg.norm(residuals_of(cell, rows), axis=1) < 6 * typical).mean())

        agree = agreeing(training)
        for reason, changed in _shifts(measurements):
            then = agreeing(changed(measurements).rows(fitted))
            if then > max(0.95, agree, kept.mean()):
                raise InputError(f"{reason}: then {then:.0%} of the rows agree instead of {agree:.0%}; mend it")
    _explain(measurements, fitted, coarse, base_fixed)
    if typical <= SUSPICIOUS_MM and kept.mean() > 0.7:
        return []
    if kept.mean() <= 0.7:
        raise DegenerateError(
            f"{int((~kept).sum())} of {len(kept)} training rows contradict the rest;"
            " check the pairing of scans and spheres"
        )
    reach = np.hypot(coarse.arm.table[:, 1], coarse.arm.table[:, 2]).sum()
    if typical > max(10.0, 0.01 * reach):
        raise InputError(
            f"no arm of this structure fits: {typical:.1f} mm are left in the median; check the robot table"
            " (modified, not standard DH), the joints' directions and zeros, and which joint carries the scanner"
        )
    return [f"the fit leaves {typical:.2f} mm in the median, much for a sphere scan: check table, units and pairing"]


def _explain(measurements: Measurements, fitted: NDArray[np.int64], coarse: ScannerOnArm, base_fixed: bool) -> None:
    """Refuse with the one mistake that explains the data best, if one explains them far better than none.

    Raises:
        InputError, UnitError: see ``check_fit``.
    """
    as_given = median_error(coarse, measurements.rows(fitted))

    def left(changed: Change, arm: MdhArm = coarse.arm) -> float:
        try:
            return closed_form_error(changed(measurements).rows(fitted), arm, base_fixed)
        except GrindvisionError:
            return np.inf

    found: list[tuple[float, str, type[GrindvisionError], str]] = [
        (left(changed), reason, kind, "columns") for reason, kind, changed in _explanations(measurements)
    ]
    standard = left(lambda m: m, _from_standard(coarse.arm))
    reason = "the robot table is a standard DH table: move alpha and a one row down, with 0 in the first row"
    found.append((standard, reason, InputError, "table"))
    least, reason, kind, what = min(found, key=lambda one: one[0])
    if least < 0.2 * as_given:
        raise kind(
            f"{reason}: then the nominal arm leaves {least:.2f} mm instead of {as_given:.1f} mm; mend the {what}"
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


def _check_units(measurements: Measurements, arm: MdhArm) -> None:
    largest = np.abs(measurements.q_rad).max(axis=0)
    joint = int(np.argmax(largest))
    if largest[joint] > 2 * np.pi + 0.01:
        raise UnitError(
            f"column q{joint + 1}_rad reaches {largest[joint]:.4g}: these look like degrees; give radians, or name it"
            f" q{joint + 1}_deg"
        )
    reach = np.hypot(arm.table[:, 1], arm.table[:, 2]).sum()
    if 0 < reach < 10:
        raise UnitError(
            f"the arm's links add up to {reach:.4g} mm: the robot table looks like metres; give millimetres"
        )
    for name, points in (("s", measurements.scanner_mm), ("b", measurements.tracker_mm)):
        if name == "s" and measurements.on_tool:
            continue
        size = np.abs(points).max(axis=0)
        if size.max() < 20:
            raise UnitError(f"columns {name}x_mm to {name}z_mm reach only {size.max():.4g}: metres? give millimetres")
        if size.max() > FARTHEST_MM:
            row = int(np.abs(points).max(axis=1).argmax())
            raise UnitError(
                f"{measurements.label(row)}: {name}x_mm to {name}z_mm reach {size.max():.4g} mm, where nothing is"
                " measured; mend or drop it, or give millimetres"
            )


def _changing(column: str, change: Callable[[Floats], Floats]) -> Change:
    def changed(measurements: Measurements) -> Measurements:
        changes: dict[str, Any] = {column: change(getattr(measurements, column))}
        return replace(measurements, **changes)

    return changed


def _shifts(measurements: Measurements) -> list[tuple[str, Change]]:
    columns = [("tracker_mm", "tracker readings"), ("q_rad", "joint angles"), ("scanner_mm", "scans")]
    return [
        (
            f"the rows of {what} are shifted by {shift} against the other columns",
            _changing(column, partial(np.roll, shift=-shift, axis=0)),
        )
        for column, what in columns[: 2 if measurements.on_tool else 3]
        for shift in (1, -1)
    ]


def _explanations(measurements: Measurements) -> list[tuple[str, type[GrindvisionError], Change]]:
    found: list[tuple[str, type[GrindvisionError], Change]] = [
        (reason, InputError, changed) for reason, changed in _shifts(measurements)
    ]
    joints = measurements.q_rad.shape[1]
    for one, other in combinations(range(joints), 2):
        order = np.arange(joints)
        order[[one, other]] = other, one
        found.append(
            (
                f"columns q{one + 1} and q{other + 1} are swapped",
                InputError,
                _changing("q_rad", partial(np.take, indices=order, axis=1)),
            )
        )
    for joint in range(joints):
        for factor, reason, kind in (
            (np.pi / 180, "looks like degrees", UnitError),
            (-1.0, "counts the other way round than the robot table", InputError),
        ):
            found.append(
                (
                    f"column q{joint + 1}_rad {reason}",
                    kind,
                    _changing("q_rad", partial(np.multiply, np.where(np.arange(joints) == joint, factor, 1.0))),
                )
            )
    for column, name in (("tracker_mm", "b"), ("scanner_mm", "s"))[: 1 if measurements.on_tool else 2]:
        found.append(
            (
                f"columns {name}x_mm to {name}z_mm are mirrored (two swapped, or one with the wrong sign)",
                InputError,
                _changing(column, partial(np.multiply, [1.0, -1.0, 1.0])),
            )
        )
        for axes in ([0], [1], [2], [0, 1, 2]):
            found.append(
                (
                    f"{', '.join(name + 'xyz'[axis] + '_mm' for axis in axes)} in metres, by the look of it",
                    UnitError,
                    _changing(column, partial(np.multiply, np.where(np.isin(np.arange(3), axes), 1000.0, 1.0))),
                )
            )
    return found
