"""Errors of the arm told apart from those of the camera: variance components of a hand-eye fit to poses.

An error of the arm's rotation moves the target over the lever from the flange to it, one of the camera turns what it
sees on the spot; a camera errs along its axis more than across. So the four sizes leave different traces in the
residuals, and restricted maximum likelihood finds them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import skew
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Rounds of the estimate; few, so that few poses do not drive a component to zero.
ROUNDS = 12

#: No component is less than this fraction of what place, or rotation, shows in the median.
MIN_FRACTION = 1e-4


@by_content
@dataclass(frozen=True)
class PoseErrors:
    """Standard deviations per axis: ``place_mm`` of the target's place, arm and camera together; ``depth_mm`` of the
    camera along its axis beyond that; ``arm_rad`` and ``camera_rad`` of the flange's and of the seen rotation."""

    place_mm: float
    depth_mm: float
    arm_rad: float
    camera_rad: float

    def __str__(self) -> str:
        return (
            f"errors of a pose: place {self.place_mm:.2g} mm, along the camera's axis {self.depth_mm:.2g} mm more,"
            f" rotation of the arm {np.degrees(self.arm_rad):.2g} deg, of the camera"
            f" {np.degrees(self.camera_rad):.2g} deg"
        )


def components(carrier: Floats, target: Floats, X: Floats, on_arm: bool) -> Floats:
    """Covariances (4, N, 6, 6) of place and rotation that each error of unit size makes, in the frame in which the
    target rests: the base with the camera ``on_arm``, else the flange."""
    axis = (carrier[:, :3, :3] @ X[:3, :3])[:, :, 2]
    arm = arm_columns(carrier, target, X, on_arm)
    made = np.zeros((4, len(carrier), 6, 6))
    made[0, :, :3, :3] = np.eye(3)
    made[1, :, :3, :3] = axis[:, :, None] * axis[:, None, :]
    made[2] = arm @ arm.swapaxes(1, 2)
    made[3, :, 3:, 3:] = np.eye(3)
    return made


def arm_columns(carrier: Floats, target: Floats, X: Floats, on_arm: bool) -> Floats:
    """What a small rotation of the arm at its flange does to place and rotation (N, 6, 3), see ``components``."""
    seen = (carrier @ X @ target)[:, :3, 3]
    lever = seen - carrier[:, :3, 3] if on_arm else seen
    arm = np.zeros((len(carrier), 6, 3))
    arm[:, :3], arm[:, 3:] = -skew(lever), np.eye(3)
    return arm


def estimate(rows: Floats, J: Floats, made: Floats, weights: Floats, sizes: Floats | None) -> Floats:
    """Variances (4,) of ``components`` by restricted maximum likelihood.

    Each round multiplies a variance by the root of what the residuals show of it over what is expected (the
    minorise-maximise steps of Zhou and others, 2019): it stays positive and the likelihood grows.

    Args:
        rows: residuals (N, 6); J: their derivatives (N, 6, K).
        made: see ``components``.
        weights: of the poses (N,); one without weight says nothing.
        sizes: variances (4,) to start from; of the median residuals when None.
    """
    place, turn = (max(float(np.median((part**2).sum(axis=1))) / 3, 1e-24) for part in (rows[:, :3], rows[:, 3:]))
    usual = np.array([place, place, turn / 2, turn / 2])
    sizes = usual.copy() if sizes is None else sizes.copy()
    flat = made.reshape(len(made), -1)
    for _ in range(ROUNDS):
        inverse = np.linalg.inv((sizes @ flat).reshape(made.shape[1:])) * weights[:, None, None]
        weighted = inverse @ J
        stacked = weighted.reshape(-1, J.shape[2])
        information = np.linalg.pinv(J.reshape(stacked.shape).T @ stacked, hermitian=True)
        change = information @ (stacked.T @ rows.ravel())
        shown = (inverse @ (rows - J @ change)[..., None])[..., 0]
        projector = inverse - weighted @ information @ weighted.swapaxes(1, 2)
        seen = flat @ (shown[:, :, None] * shown[:, None, :]).ravel()
        expected = flat @ projector.ravel()
        sizes = np.maximum(sizes * np.sqrt(seen / np.maximum(expected, 1e-300)), MIN_FRACTION * usual)
    return sizes
