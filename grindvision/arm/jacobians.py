"""Derivatives of the arm's pose by its joint angles and by its MDH parameters, in closed form.

A column is a twist in the base frame: ``shift`` (mm) of the point that currently lies at the base's origin, then the
``rotation`` vector (rad), so that a point p of the last link moves by ``shift + rotation x p``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm.mdh import PARAMETERS, MdhArm, joint_transforms
from grindvision.geometry import skew

Floats = NDArray[np.float64]


def joint_twists(arm: MdhArm, q_rad: ArrayLike, frames: Floats | None = None) -> Floats:
    """Twists (..., 6, n) of the last link per radian (prismatic: per mm) of each joint, at joint angles (..., n).

    ``frames`` are the ``joint_transforms`` there, where they are known already.
    """
    frames = joint_transforms(arm, q_rad) if frames is None else frames
    after = frames[..., 1:, :, :]
    twists = _rotation_about(after[..., :3, 2], after[..., :3, 3])
    if any(arm.prismatic):
        twists = np.where(np.array(arm.prismatic), _translation_along(after[..., :3, 2]), twists)
    return twists


def parameter_twists(arm: MdhArm, q_rad: ArrayLike, frames: Floats | None = None) -> Floats:
    """Twists (..., 6, 5 n) of the last link per unit of each MDH parameter; columns joint by joint as ``PARAMETERS``.

    They are the columns of Q_i M_i in Eqs 12-14 of the first paper. ``frames`` are the ``joint_transforms`` there,
    where they are known already.
    """
    frames = joint_transforms(arm, q_rad) if frames is None else frames
    before, after = frames[..., :-1, :, :], frames[..., 1:, :, :]
    x_axis = before[..., :3, 0]
    # The tilted frame between Tx(a) and Ry(beta) has its y axis where Rx(alpha) leaves it and its origin behind Tx(a).
    alpha, a = arm.table[:, 0], arm.table[:, 1]
    y_axis = before[..., :3, 1] * np.cos(alpha)[:, None] + before[..., :3, 2] * np.sin(alpha)[:, None]
    tilt_origin = before[..., :3, 3] + a[:, None] * x_axis
    z_axis = after[..., :3, 2]
    columns = np.empty((*after.shape[:-3], 6, arm.n, len(PARAMETERS)))
    columns[..., 0] = _rotation_about(x_axis, before[..., :3, 3])
    columns[..., 1] = _translation_along(x_axis)
    columns[..., 2] = _translation_along(z_axis)
    columns[..., 3] = _rotation_about(z_axis, after[..., :3, 3])
    columns[..., 4] = _rotation_about(y_axis, tilt_origin)
    return columns.reshape(*columns.shape[:-2], -1)


def moved_by_twist(twists: ArrayLike, points_base: ArrayLike) -> Floats:
    """Velocities (..., 3, K) that twists (..., 6, K) give to points (..., 3) of the last link, in the base frame."""
    twists = np.asarray(twists, dtype=float)
    return twists[..., :3, :] - skew(points_base) @ twists[..., 3:, :]


def _rotation_about(axes: Floats, origins: Floats) -> Floats:
    x, y, z = (axes[..., k] for k in range(3))
    from_x, from_y, from_z = (origins[..., k] for k in range(3))
    shifts = (from_y * z - from_z * y, from_z * x - from_x * z, from_x * y - from_y * x)
    return np.stack([*shifts, x, y, z], axis=-2)


def _translation_along(axes: Floats) -> Floats:
    return np.swapaxes(np.concatenate([axes, np.zeros_like(axes)], axis=-1), -1, -2)
