"""Columns of a measurement file that nobody uses, yet that explain why nothing fits: a track left out of the table."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.starts import track_direction

Floats = NDArray[np.float64]

#: A column explains what is left where it brings it down to this fraction, and its unit is this near to one in mm.
EXPLAINED, UNIT_TOLERANCE = 0.25, 0.02

#: Lengths in mm of the units that a track is written in.
UNITS_MM = {"mm": 1.0, "m": 1000.0, "cm": 10.0, "inch": 25.4}


def track_left_out(measurements: Measurements, arm: MdhArm, columns: Mapping[str, Floats]) -> str:
    """Name the column along which the arm's base rode, in words and with what to do; empty where none explains it.

    Args:
        measurements: rows that no arm of the table fits.
        arm: the table.
        columns: numbers (M,) of the columns that were not used, by their names.
    """
    if not measurements.tracked.all() or any(arm.prismatic):
        return ""
    best, found = EXPLAINED, ""
    for name, travel in columns.items():
        if len(travel) != len(measurements) or np.ptp(travel) < 1e-9:
            continue
        direction, without, left = track_direction(measurements, arm, travel)
        length = float(np.linalg.norm(direction))
        unit = next((unit for unit, mm in UNITS_MM.items() if abs(np.log(length / mm)) < UNIT_TOLERANCE), "")
        if unit and left < best * without:
            best = left / without
            x, y, z = direction / length
            found = (
                f"the arm rides on a track, column {name}: it moves the base by 1 {unit} a unit along"
                f" ({x:.2f}, {y:.2f}, {z:.2f}) of its frame, and with it {left:.1f} mm are left instead of"
                f" {without:.0f} mm; {_rows(arm, direction / length)} and its readings as"
                f" q1: --columns q1_{unit if unit == 'm' else 'mm'}={name} q2_deg=..."
            )
    return found


def _rows(arm: MdhArm, direction: Floats) -> str:
    """What to put into the robot table for a slide along a direction (3,) of the base frame, in words."""
    first = "give the track as a first row of the robot table, all 0, type prismatic"
    if abs(direction[2]) > 0.1 or np.abs(arm.table[0, [0, 1]]).max() > 1e-9:
        return first
    theta = np.degrees(arm.table[0, 3] - np.pi / 2 - np.arctan2(direction[1], direction[0]))
    return f"{first}, joint 1 behind it with alpha -90 and theta {round((theta + 180) % 360 - 180)} deg,"
