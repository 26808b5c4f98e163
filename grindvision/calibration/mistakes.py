"""Mistakes in the columns or the robot table that are looked for where nothing fits, each with the data without it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.starts import unit_factors
from grindvision.errors import GrindvisionError, InputError, UnitError

Floats = NDArray[np.float64]
Change = Callable[[Measurements], Measurements]

#: Lengths by the factor that turns them into millimetres.
UNIT_NAMES = {
    1000.0: "metres", 304.8: "feet", 100.0: "decimetres", 25.4: "inches", 10.0: "centimetres", 914.4: "yards",
    0.0254: "mils", 0.001: "micrometres",
}  # fmt: skip

#: Units of joint readings by the factor that turns them into what their column says: angles, and ways of a slide.
ANGLE_UNITS = {np.pi / 180: "degrees", 180 / np.pi: "radians that were taken for degrees", 0.9: "gradians"}
TRAVEL_UNITS = {1000.0: "metres", 10.0: "centimetres", 25.4: "inches", 0.001: "micrometres"}

#: Units that one axis alone may be written in.
AXIS_UNITS = (1000.0, 25.4, 10.0)

#: A factor this near to a unit's is that unit; this far from 1 it is no error of scale.
UNIT_TOLERANCE, MIN_FACTOR = 0.04, 0.05


@dataclass(frozen=True)
class Mistake:
    """One mistake: a sentence, the error to raise, what to mend, and the data or the table without it."""

    reason: str
    kind: type[GrindvisionError]
    change: Change = lambda m: m
    arm: MdhArm | None = None


def mistakes(
    measurements: Measurements, arm: MdhArm, fitted: NDArray[np.int64], single: bool, seed: int = 0
) -> Iterator[Mistake]:
    """Every mistake that is looked for; ``single``: those too that never come on top of another."""
    if single:
        yield from shifted_rows(measurements)
        yield from _other_axes(measurements)
        yield Mistake(
            "the robot table is a standard DH table: move alpha and a one row down, with 0 in the first row",
            InputError,
            arm=_from_standard(arm),
        )
    yield from _other_units(measurements, arm, fitted, seed)
    yield from _joint_units(measurements, arm)
    yield from _joint_order(measurements)
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


def shifted_rows(measurements: Measurements) -> list[Mistake]:
    """Columns of tracker, joints or scanner that stand a row too high or too low against the others."""
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


def _other_axes(measurements: Measurements) -> Iterator[Mistake]:
    """One axis of the tracker or the scanner in another unit than the others, or all of them in metres."""
    for column, name in (("tracker_mm", "b"), ("scanner_mm", "s"))[: 1 if measurements.on_tool else 2]:
        for axes in ([0], [1], [2], [0, 1, 2]):
            names = ", ".join(name + "xyz"[axis] + "_mm" for axis in axes)
            for factor in AXIS_UNITS if len(axes) == 1 else AXIS_UNITS[:1]:
                yield Mistake(
                    f"{names} in {UNIT_NAMES[factor]}, by the look of it",
                    UnitError,
                    _changing(column, partial(np.multiply, np.where(np.isin(np.arange(3), axes), factor, 1.0))),
                )


def _other_units(measurements: Measurements, arm: MdhArm, fitted: NDArray[np.int64], seed: int) -> Iterator[Mistake]:
    """Lengths of the tracker, the scanner or the table that are all too large or too small by one factor."""
    tracker, scanner = unit_factors(measurements.rows(fitted), arm, seed)
    columns = [("tracker_mm", "bx_mm to bz_mm", tracker), ("scanner_mm", "sx_mm to sz_mm", scanner)]
    for column, names, found in columns:
        if np.isfinite(found) and found > 0 and abs(np.log(found)) > MIN_FACTOR:
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
        if abs(np.log(factor)) > MIN_FACTOR:
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


def _joint_units(measurements: Measurements, arm: MdhArm) -> Iterator[Mistake]:
    """One column of joint readings, or all of one kind, in another unit than its name says."""
    prismatic = np.array(arm.prismatic)
    for slides, letter, units in ((False, "rad", ANGLE_UNITS), (True, "mm", TRAVEL_UNITS)):
        joints = np.flatnonzero(prismatic == slides)
        groups = [joints[[i]] for i in range(len(joints))] + ([joints] if len(joints) > 1 else [])
        for group in groups:
            names = [f"q{joint + 1}_{letter}" for joint in group]
            what = f"column {names[0]} looks" if len(group) == 1 else f"columns {names[0]} to {names[-1]} look"
            for factor, unit in units.items():
                yield Mistake(
                    f"{what} like {unit}",
                    UnitError,
                    _changing("q_rad", partial(np.multiply, np.where(np.isin(np.arange(arm.n), group), factor, 1.0))),
                )


def _joint_order(measurements: Measurements) -> Iterator[Mistake]:
    """Two columns of joint angles swapped, or neighbours that count the other way round."""
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
