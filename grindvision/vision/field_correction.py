"""Field calibration of a scanner on a flat plate: what the plate seems to bend is the scanner's, and is taken off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry import check_points, fit_plane

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FieldCorrection:
    """Depth error over the measured volume as a Chebyshev polynomial of the ray's slopes x/z, y/z and of the depth.

    ``coefficients`` (D + 1, D + 1, K + 1) in mm; slopes and depth are mapped to +-1 by ``middle`` and ``half`` (3,).
    """

    coefficients: Floats
    middle: Floats
    half: Floats

    def error_mm(self, points: ArrayLike) -> Floats:
        """Expected depth error (N,) at points (N, 3), scanner frame; outside the calibrated volume as at its rim."""
        return chebyshev.chebval3d(*self._unit(np.asarray(points, dtype=float)).T, self.coefficients)

    def apply(self, points: ArrayLike) -> Floats:
        """Corrected points (N, 3), each moved along its ray."""
        points = np.asarray(points, dtype=float)
        return points * (1 - self.error_mm(points) / points[:, 2])[:, None]

    def _unit(self, points: Floats) -> Floats:
        at = np.column_stack([points[:, :2] / points[:, 2:], points[:, 2]])
        return np.clip((at - self.middle) / self.half, -1, 1)

    def __str__(self) -> str:
        return f"field correction of degree {len(self.coefficients) - 1} over {2 * self.half[2]:.0f} mm of depth"


def calibrate_field(plates: Sequence[ArrayLike], steps_mm: Sequence[float], degree: int = 6) -> FieldCorrection:
    """Learn a scanner's depth error from scans of one flat plate that was moved along its normal by known steps.

    The first plate's distance and tilt are free, so an offset and a tilt of the whole field stay unknown. One plate
    shows the bend of the field at its distance; two or more also show the scale in depth and how the bend changes.

    Args:
        plates: clouds (N, 3) of the plate in the scanner frame, mm; each should fill the view.
        steps_mm: how much farther than the first each plate stands; 0 for the first.
        degree: of the polynomial over the field; over the depth it is the number of plates less one.

    Raises:
        InputError: degree below 2, steps that do not belong to the plates or repeat, points behind the scanner.
        DegenerateError: too few points.
    """
    if degree < 2:
        raise InputError(f"degree is {degree}; a bend needs at least 2")
    steps = np.asarray(steps_mm, dtype=float)
    if len(plates) == 0 or steps.shape != (len(plates),) or len(np.unique(steps)) != len(steps):
        raise InputError(f"{len(plates)} plates need as many different steps, got {steps.tolist()}")
    clouds = [check_points(plate, "plate points", least=(degree + 1) ** 2) for plate in plates]
    if any((cloud[:, 2] <= 0).any() for cloud in clouds):
        raise InputError("plate points lie behind the scanner (z <= 0); give them in the scanner frame")
    points = np.concatenate(clouds)
    step = np.repeat(steps, [len(cloud) for cloud in clouds])
    normal = fit_plane(clouds[0]).normal
    normal = normal * np.sign(normal[2])
    for _ in range(3):
        plane = fit_plane(points - step[:, None] * normal)
        normal = plane.normal * np.sign(plane.normal[2])
    rays = points / points[:, 2:]
    residual = points[:, 2] - (plane.offset_mm * np.sign(plane.normal[2]) + step) / (rays @ normal)
    at = np.column_stack([rays[:, :2], points[:, 2]])
    middle, half = (at.max(axis=0) + at.min(axis=0)) / 2, np.ptp(at, axis=0) / 2
    correction = FieldCorrection(np.zeros((degree + 1, degree + 1, len(plates))), middle, half)
    design = chebyshev.chebvander3d(*correction._unit(points).T, [degree, degree, len(plates) - 1])
    solution, *_ = np.linalg.lstsq(design, residual, rcond=None)
    return FieldCorrection(solution.reshape(correction.coefficients.shape), middle, half)
