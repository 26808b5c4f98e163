"""Points in an order that their places alone decide, so that no result moves with their order in a file."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.bounds import bounds
from grindvision.kernels import njit

Floats = NDArray[np.float64]

AXIS_STEPS = (1 << 21) - 1
"""Steps along the longest axis: three axes share one 63-bit code."""


def in_order(points: Floats) -> Floats:
    """The points (N, 3) along a Z-order curve (Morton 1966): neighbours in space stand near one another in the array.

    Any order of the same points gives the same array, bit by bit.
    """
    if len(points) == 0:
        return points
    points = np.ascontiguousarray(points, dtype=float)
    low, high = bounds(points)
    codes = _codes(points, low, AXIS_STEPS / max(float((high - low).max()), 1e-300))
    order = np.argsort(codes)
    sorted_codes = codes[order]
    same = sorted_codes[1:] == sorted_codes[:-1]
    if same.any():
        tied = np.flatnonzero(np.append(same, False) | np.append(False, same))
        x, y, z = points[order[tied]].T
        order[tied] = order[tied[np.lexsort((z, y, x, sorted_codes[tied]))]]
    return points[order]


@njit(cache=True, nogil=True)
def _codes(points: Floats, low: Floats, per_mm: float) -> NDArray[np.int64]:
    """Codes (N,) whose bits are those of the points' steps along x, y and z in turn."""
    codes = np.empty(len(points), dtype=np.int64)
    for p in range(len(points)):
        code = np.int64(0)
        for axis in range(3):
            code = (code << 1) | _spread(np.int64((points[p, axis] - low[axis]) * per_mm))
        codes[p] = code
    return codes


@njit(cache=True, nogil=True, inline="always")
def _spread(step: np.int64) -> np.int64:
    """The 21 bits of a step with two zeros before each."""
    step = (step | step << 32) & 0x1F00000000FFFF
    step = (step | step << 16) & 0x1F0000FF0000FF
    step = (step | step << 8) & 0x100F00F00F00F00F
    step = (step | step << 4) & 0x10C30C30C30C30C3
    return (step | step << 2) & 0x1249249249249249
