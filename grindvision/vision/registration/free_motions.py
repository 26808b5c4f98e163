"""Motions in words, for those who are told that one is free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import angle_between, inverse, move_points, rotation_axis

Floats = NDArray[np.float64]


def motion_name(pose: Floats, reference: Floats, centre_mm: Floats, extent_mm: float) -> str:
    """In words, the motion in the target's frame that leads from ``reference`` to ``pose`` (4, 4), of a source whose
    points lie about ``centre_mm`` (3,) within ``extent_mm`` in the mean (rms)."""
    motion = pose @ inverse(reference)
    angle = angle_between(motion, np.eye(4))
    centre = move_points(reference, centre_mm)
    shift = move_points(motion, centre) - centre
    if angle * extent_mm > 0.3 * np.linalg.norm(shift):
        axis = rotation_axis(motion[:3, :3])
        pivot = centre + np.linalg.pinv(np.eye(3) - motion[:3, :3], rcond=1e-6) @ shift
        x, y, z, a, b, c = *axis, *pivot
        return (
            f"a turn (here by {np.degrees(angle):.0f} deg) about the axis ({x:.2f}, {y:.2f}, {z:.2f})"
            f" through ({a:.0f}, {b:.0f}, {c:.0f}) mm"
        )
    x, y, z = shift / np.linalg.norm(shift)
    return f"a shift (here by {np.linalg.norm(shift):.1f} mm) along ({x:.2f}, {y:.2f}, {z:.2f})"


def motion_names(twists: Floats, extent: float, centre: Floats) -> list[str]:
    """In words, a basis of the motions that columns of ``twists`` (6, k) span: pure shifts first, then turns.

    A twist is a shift in mm and a rotation vector in rad about ``centre`` (3,).
    """
    scaled = twists / np.array([1, 1, 1, 1 / extent, 1 / extent, 1 / extent])[:, None] / extent
    _, turning, mix = np.linalg.svd(scaled[3:])
    turning = np.pad(turning, (0, max(scaled.shape[1] - len(turning), 0)))[: scaled.shape[1]]
    basis = scaled @ mix.T
    shifts = basis[:3, turning < 0.3]
    names = ["a shift along ({:.2f}, {:.2f}, {:.2f})".format(*(shift / np.linalg.norm(shift))) for shift in shifts.T]
    along = np.linalg.qr(shifts)[0] if shifts.size else np.zeros((3, 0))
    for column in basis[:, turning >= 0.3].T:
        rotation = column[3:]
        shift = (column[:3] - along @ (along.T @ column[:3])) * extent
        pivot = centre + np.cross(rotation, shift) / (rotation @ rotation)
        axis = rotation / np.linalg.norm(rotation)
        names.append(
            "a turn about the axis ({:.2f}, {:.2f}, {:.2f}) through ({:.0f}, {:.0f}, {:.0f}) mm".format(*axis, *pivot)
        )
    return names
