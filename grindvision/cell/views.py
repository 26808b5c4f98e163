"""Poses from which a scanner looks at a point."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry import rigid, rotation_about

Floats = NDArray[np.float64]


def view_from(
    target_mm: ArrayLike, distance_mm: float, tilt_rad: float = 0.0, azimuth_rad: float = 0.0, roll_rad: float = 0.0
) -> Floats:
    """Pose T_world_scanner (4, 4) that looks down at ``target_mm`` (3,) from ``distance_mm``.

    The scanner stands ``tilt_rad`` off the world's z axis, towards ``azimuth_rad`` from x; ``roll_rad`` turns it
    about its own line of sight. Without tilt and roll its x axis is the world's.
    """
    down = np.diag([1.0, -1.0, -1.0])
    tilt_axis = [-np.sin(azimuth_rad), np.cos(azimuth_rad), 0.0]
    rotation = rotation_about(tilt_axis, tilt_rad) @ down @ rotation_about([0.0, 0.0, 1.0], roll_rad)
    return rigid(rotation, np.asarray(target_mm, dtype=float) - distance_mm * rotation[:, 2])
