"""Axis-aligned bounds of points, in their own frame or another one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.kernels import njit

Floats = NDArray[np.float64]


def diagonal_mm(points: Floats) -> float:
    """Length of the diagonal of the bounds of points (N, 3)."""
    low, high = bounds(points)
    return float(np.linalg.norm(high - low))


@njit(cache=True, nogil=True)
def bounds(points: Floats) -> tuple[Floats, Floats]:
    """Lowest and highest coordinates (3,), (3,) of points (N, 3)."""
    x = x_low = points[0, 0]
    y = y_low = points[0, 1]
    z = z_low = points[0, 2]
    for p in range(len(points)):
        x_low, y_low, z_low = min(x_low, points[p, 0]), min(y_low, points[p, 1]), min(z_low, points[p, 2])
        x, y, z = max(x, points[p, 0]), max(y, points[p, 1]), max(z, points[p, 2])
    return np.array([x_low, y_low, z_low]), np.array([x, y, z])


@njit(cache=True, nogil=True)
def bounds_in_frame(points: Floats, frame: Floats) -> tuple[Floats, Floats]:
    """Lowest and highest coordinates (3,) of points (N, 3) in another frame, into which ``frame`` (4, 4) takes
    them."""
    x_low = y_low = z_low = np.inf
    x_high = y_high = z_high = -np.inf
    for p in range(len(points)):
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        x = frame[0, 0] * px + frame[0, 1] * py + frame[0, 2] * pz + frame[0, 3]
        y = frame[1, 0] * px + frame[1, 1] * py + frame[1, 2] * pz + frame[1, 3]
        z = frame[2, 0] * px + frame[2, 1] * py + frame[2, 2] * pz + frame[2, 3]
        x_low, y_low, z_low = min(x_low, x), min(y_low, y), min(z_low, z)
        x_high, y_high, z_high = max(x_high, x), max(y_high, y), max(z_high, z)
    return np.array([x_low, y_low, z_low]), np.array([x_high, y_high, z_high])
