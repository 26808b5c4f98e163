"""Measurements that cannot be used, found before the fit: wrong units, copies, one pose only, too few rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm
from grindvision.calibration.measurements import Measurements
from grindvision.errors import DegenerateError, InputError, UnitError

Flags = NDArray[np.bool_]

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
    if not measurements.train.any():
        raise InputError(f"none of the {len(measurements)} rows is marked train in column split: nothing to fit to")
    good = measurements.rows(without_copies(measurements) & measurements.train)
    equations = good.equations
    if equations <= unknowns:
        raise DegenerateError(
            f"{len(good)} different training measurements give {equations} equations for {unknowns} unknowns;"
            f" measure at least {unknowns // 3 + 1} and one to hold out, better {unknowns}, or hold some parameters"
            " (--free hand-eye, --fix)"
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
    if equations < 2 * unknowns:
        warnings.append(f"only {equations} equations for {unknowns} unknowns: the errors on training rows flatter")
    return tuple(warnings)


def without_copies(measurements: Measurements) -> Flags:
    """Flags (M,) of the rows that are no exact copy of an earlier row."""
    touched = np.column_stack([measurements.reflector, measurements.fixture, np.nan_to_num(measurements.bar_mm)])
    rows = np.hstack([measurements.q_rad, measurements.scanner_mm, measurements.tracker_mm, touched])
    flags = np.zeros(len(rows), dtype=bool)
    flags[np.unique(rows, axis=0, return_index=True)[1]] = True
    return flags


def _check_units(measurements: Measurements, arm: MdhArm) -> None:
    revolute = ~np.array(arm.prismatic)
    largest = np.where(revolute, np.abs(measurements.q_rad).max(axis=0), 0.0)
    joint = int(np.argmax(largest))
    range_rad = np.ptp(measurements.q_rad[:, joint])
    if largest[joint] > 2 * np.pi + 0.01 and not (largest[joint] < 20 * np.pi and range_rad < 2 * np.pi):
        looks = "these look like degrees; give radians, or name it" if largest[joint] < 800 else "no unit of angle"
        hint = f" q{joint + 1}_deg" if largest[joint] < 800 else " has so many a turn but milliradians; give radians"
        raise UnitError(f"column q{joint + 1}_rad reaches {largest[joint]:.4g}: {looks}{hint}")
    reach = np.hypot(arm.table[:, 1], arm.table[:, 2]).sum()
    if 0 < reach < 10 and arm.n > 3:  # axes of a positioner or a wrist meet within parts of a millimetre
        raise UnitError(
            f"the arm's links add up to {reach:.4g} mm: the robot table looks like metres; give millimetres"
        )
    tracked = measurements.tracker_mm[measurements.tracked]
    for name, points in (("s", measurements.scanner_mm), ("b", tracked)):
        if (name == "s" and measurements.on_tool) or not len(points):
            continue
        size = np.abs(points).max(axis=0)
        if size.max() < 20:
            raise UnitError(
                f"columns {name}x_mm to {name}z_mm reach only {size.max():.4g}: metres, feet? give millimetres"
            )
        if size.max() > FARTHEST_MM:
            row = int(np.abs(points).max(axis=1).argmax())
            raise UnitError(
                f"{measurements.label(row)}: {name}x_mm to {name}z_mm reach {size.max():.4g} mm, where nothing is"
                " measured; mend or drop it, or give millimetres"
            )
