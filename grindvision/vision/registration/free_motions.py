"""Motions in words, for those who are told that one is free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import angle_between, inverse, motion_columns, move_points, rigid, rotation_axis, small_motion
from grindvision.vision.registration.icp import FineRegistration

Floats = NDArray[np.float64]

HARDLY_KNOWN = 0.01
"""Standard deviation of a point's place, as a fraction of the scan's extent, above which it is said."""


def weakest_motion(found: FineRegistration, points: Floats) -> tuple[float, Floats]:
    """How far in mm, by one standard deviation of the pose, any of a source's points (N, 3) may lie off, and the pose
    (4, 4) moved by that deviation. Infinite, and the pose itself, where the covariance is not known."""
    covariance = found.total_covariance
    if not np.isfinite(covariance).all():
        return np.inf, found.T_target_source
    arms = move_points(found.T_target_source, points) - found.centre_mm
    jacobians = motion_columns(arms)
    squares, directions = np.linalg.eigh(jacobians @ covariance @ jacobians.transpose(0, 2, 1))
    worst = int(np.argmax(squares[:, -1]))
    sigma = float(np.sqrt(max(squares[worst, -1], 0.0)))
    twist = covariance @ jacobians[worst].T @ directions[worst, :, -1] / max(sigma, 1e-300)
    to_centre, back = rigid(None, -found.centre_mm), rigid(None, found.centre_mm)
    return sigma, back @ small_motion(twist) @ to_centre @ found.T_target_source


def rms_extent(points: Floats) -> float:
    """Root mean square distance in mm of points (N, 3) from their middle."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def spread_out(points: Floats) -> Floats:
    """Some of a scan's points (N, 3), enough to find the one that a motion moves most."""
    return points[:: max(1, len(points) // 500)]


def is_hardly_known(found: FineRegistration, points: Floats) -> bool:
    """Whether any of a source's points (N, 3) may lie off by more than ``HARDLY_KNOWN`` of their extent, by one
    sigma."""
    some = spread_out(points)
    return weakest_motion(found, some)[0] > HARDLY_KNOWN * rms_extent(some)


def motion_name(pose: Floats, reference: Floats, centre_mm: Floats, extent_mm: float) -> str:
    """In words, the motion in the target's frame that leads from ``reference`` to ``pose`` (4, 4), of a source whose
    points lie about ``centre_mm`` (3,) within ``extent_mm`` in the mean (rms)."""
    motion = pose @ inverse(reference)
    angle = angle_between(motion, np.eye(4))
    centre = move_points(reference, centre_mm)
    translation = move_points(motion, centre) - centre
    if angle * extent_mm > 0.3 * np.linalg.norm(translation):
        axis = rotation_axis(motion[:3, :3])
        pivot = centre + np.linalg.pinv(np.eye(3) - motion[:3, :3], rcond=1e-6) @ translation
        x, y, z, a, b, c = *axis, *pivot
        degrees = float(np.degrees(angle))
        return (
            f"a rotation (here by {degrees:.{0 if degrees >= 1 else 2}f} deg) about the axis"
            f" ({x:.2f}, {y:.2f}, {z:.2f}) through ({a:.0f}, {b:.0f}, {c:.0f}) mm"
        )
    length = float(np.linalg.norm(translation))
    x, y, z = translation / length
    here = f" (here by {length:.1f} mm)" if length < 10 * extent_mm else ""
    return f"a translation{here} along ({x:.2f}, {y:.2f}, {z:.2f})"


def motion_names(twists: Floats, extent: float, centre: Floats) -> list[str]:
    """In words, a basis of the motions that columns of ``twists`` (6, k) span: pure translations first, then rotations.

    A twist is a translation in mm and a rotation vector in rad about ``centre`` (3,).
    """
    scaled = twists / np.array([1, 1, 1, 1 / extent, 1 / extent, 1 / extent])[:, None] / extent
    _, rotating, mix = np.linalg.svd(scaled[3:])
    rotating = np.pad(rotating, (0, max(scaled.shape[1] - len(rotating), 0)))[: scaled.shape[1]]
    basis = scaled @ mix.T
    translations = basis[:3, rotating < 0.3]
    names = [
        "a translation along ({:.2f}, {:.2f}, {:.2f})".format(*(translation / np.linalg.norm(translation)))
        for translation in translations.T
    ]
    along = np.linalg.qr(translations)[0] if translations.size else np.zeros((3, 0))
    for column in basis[:, rotating >= 0.3].T:
        rotation = column[3:]
        translation = (column[:3] - along @ (along.T @ column[:3])) * extent
        pivot = centre + np.cross(rotation, translation) / (rotation @ rotation)
        axis = rotation / np.linalg.norm(rotation)
        names.append(
            "a rotation about the axis ({:.2f}, {:.2f}, {:.2f}) through ({:.0f}, {:.0f}, {:.0f}) mm".format(
                *axis, *pivot
            )
        )
    return names
