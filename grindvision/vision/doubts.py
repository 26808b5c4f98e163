"""Mistakes that a comparison of two scans can tell by itself: other units, a mirrored scan, sample and test swapped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, GrindvisionError, InputError, UnitError
from grindvision.geometry import inverse, move_points
from grindvision.geometry.neighbours import bounds
from grindvision.vision.difference import find_difference
from grindvision.vision.icp import FineRegistration
from grindvision.vision.scan import Scan

Floats = NDArray[np.float64]

#: Scans whose extents differ by more than this factor do not show the same part in the same unit.
MOST_TIMES_LARGER = 5.0


def check_same_unit(sample: Floats, test: Floats) -> None:
    """Refuse two scans (N, 3) and (M, 3) of which one is so much larger that its numbers have another unit.

    Raises:
        UnitError: the diagonals differ by more than ``MOST_TIMES_LARGER``.
    """
    sizes = [float(np.linalg.norm(np.subtract(*bounds(points)))) for points in (sample, test)]
    if max(sizes) > MOST_TIMES_LARGER * min(sizes) > 0:
        raise UnitError(
            f"the sample is {sizes[0]:.4g} mm across, the test {sizes[1]:.4g} mm: one of the files has another unit, or"
            " shows more than the part; export both in one unit, cropped to the part"
        )


def mirrored_refusal(
    test: Floats,
    viewpoint_mm: ArrayLike | None,
    register: Callable[[Floats, ArrayLike | None], object],
    refusal: DegenerateError,
) -> GrindvisionError:
    """The reason for a refused registration: ``refusal`` itself, or that ``test`` (M, 3) fits as its mirror image.

    Args:
        register: registers a test scan seen from a viewpoint; raises ``DegenerateError`` where it does not fit.
    """
    mirror = np.array([1.0, -1.0, 1.0])
    try:
        register(test * mirror, None if viewpoint_mm is None else viewpoint_mm * mirror)
    except DegenerateError:
        return refusal
    return InputError(
        "the test scan fits the sample only as its mirror image: one of the two was exported left-handed (two axes"
        " swapped, or one with the wrong sign); export it again"
    )


def missing_material(sample: Scan, test: Scan, registration: FineRegistration) -> str:
    """In words, where the sample stands out of the test part: material is missing, or the two scans were swapped.

    Empty where nothing does. ``registration`` is T_sample_test.
    """
    back = inverse(registration.T_target_source)
    turn = np.kron(np.eye(2), back[:3, :3])
    backwards = replace(
        registration,
        T_target_source=back,
        covariance=turn @ registration.covariance @ turn.T,
        centre_mm=move_points(back, registration.centre_mm),
    )
    try:
        pieces = find_difference(test, sample, backwards).clusters
    except DegenerateError:
        return ""
    if not pieces:
        return ""
    return (
        f"nothing stands out of the good part, but in {len(pieces)} place(s) material is missing (the largest:"
        f" {pieces[0].area_mm2:.3g} mm2, {pieces[0].peak_mm:.2f} mm deep); if that is the bead, SAMPLE and TEST were"
        " swapped"
    )
