"""Experiment 1 of diao2018 many times over: the height target measured by many virtual instruments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from grindvision.cell import HEIGHT_MM, Scanner, Sighting, Target, flat_plate, view_from
from grindvision.vision.depth_calibration.field_correction import FieldCorrection, calibrate_field
from grindvision.vision.metrology.step_height import measure_step

Floats = NDArray[np.float64]


def measured_heights(
    scanner: Scanner,
    sightings: Mapping[str, Sighting],
    rng: np.random.Generator,
    correction: FieldCorrection | None = None,
) -> pd.DataFrame:
    """Measure the target at every position with one instrument.

    Args:
        scanner: the instrument with its errors.
        sightings: what it would see without errors, by position; see ``cell.height_sighting``.
        rng: noise and RANSAC.
        correction: field calibration to apply to every scan first.

    Returns:
        position, height_mm, error_mm (signed, against the true height), fit_std_mm.
    """
    rows = []
    for position, sighting in sightings.items():
        points = scanner.measure(sighting, rng).points
        step = measure_step(points if correction is None else correction.apply(points), rng)
        rows.append((position, step.height_mm, step.height_mm - HEIGHT_MM, step.fit_std_mm))
    return pd.DataFrame(rows, columns=["position", "height_mm", "error_mm", "fit_std_mm"])


def height_errors(scanner: Scanner, sightings: Mapping[str, Sighting], serials: Sequence[int]) -> Floats:
    """Signed height errors (S, P) in mm of instruments with these serials at the positions of ``sightings``."""
    return np.array(
        [
            measured_heights(scanner.with_serial(serial), sightings, np.random.default_rng(serial))["error_mm"]
            for serial in serials
        ]
    )


def corrected_height_errors(
    scanner: Scanner, sightings: Mapping[str, Sighting], serials: Sequence[int], steps_mm: Sequence[float]
) -> Floats:
    """As ``height_errors``, each instrument first calibrated on a flat plate ``steps_mm`` from its best distance."""
    plate = Target(flat_plate())
    views = [scanner.sight(plate, view_from(np.zeros(3), scanner.reference_mm + step), every=24) for step in steps_mm]
    errors = []
    for serial in serials:
        instrument, rng = scanner.with_serial(serial), np.random.default_rng(serial)
        clouds = [instrument.measure(view, rng).points for view in views]
        correction = calibrate_field(clouds, [step - steps_mm[0] for step in steps_mm])
        errors.append(measured_heights(instrument, sightings, rng, correction)["error_mm"])
    return np.array(errors)
