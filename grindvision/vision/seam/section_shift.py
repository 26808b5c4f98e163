"""How far a groove's points lie off its smooth sections as a whole: a section keeps its shape and moves with them.

Depth and width of a groove change slowly, and are smoothed as stiffly as their noise allows. Where the surface, or the
camera that measured it, is wavy over some groove widths, the section moves without changing its shape: the two numbers
of that shift are known much better, from all points of both walls, than depth and edges station by station.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from grindvision.vision.seam.groove_profile import LEFT, RIGHT, ROOT, Corners, profile_height
from grindvision.vision.seam.seam_curve import Strip
from grindvision.vision.seam.seam_smoothing import MAD_TO_STD

Floats = NDArray[np.float64]

#: Standard deviation of the Gaussian window along the seam and reach to both sides of the root, in groove widths.
WINDOW_WIDTHS, REACH_WIDTHS = 0.4, 0.5
#: Residuals beyond so many standard deviations count linearly (Huber), beyond so many not at all.
LINEAR_BEYOND, NOT_BEYOND = 2.5, 6.0
#: Points on a floor say nothing about a shift to the side: it is held down as by this fraction of them on a slope of 1.
SIDE_PRIOR = 0.05
#: Slopes of a section are differences over this fraction of the width.
SLOPE_STEP = 0.005


def section_shifts(strip: Strip, sections: Floats, corners: Corners, step_mm: float) -> tuple[Floats, Floats]:
    """Shift of every section to the side and up, (S,) each in mm, that brings it onto the points around.

    Args:
        strip: the points beside the seam.
        sections: smooth parameters (S, 7) of the sections, ``step_mm`` apart.
        corners: their rounding and floor.
        step_mm: distance of the stations.
    """
    count = len(sections)
    width = float(np.median(sections[:, RIGHT] - sections[:, LEFT]))
    place = strip.along / step_mm
    root = np.interp(place, np.arange(count), sections[:, ROOT])
    near = (np.abs(strip.across - root) < REACH_WIDTHS * width) & (place > -0.5) & (place < count - 0.5)
    if not near.any():
        return np.zeros(count), np.zeros(count)
    place, across = place[near], strip.across[near, None]
    here = np.stack([np.interp(place, np.arange(count), column) for column in sections.T], axis=1)
    off = strip.up[near] - profile_height(across, here, corners)[:, 0]
    half = SLOPE_STEP * width / 2
    slope = (profile_height(across + half, here, corners) - profile_height(across - half, here, corners))[:, 0]
    slope /= 2 * half
    size = np.abs(off) / max(float(MAD_TO_STD * np.median(np.abs(off))), 1e-9)
    weight = np.where(size < NOT_BEYOND, 1 / np.maximum(size / LINEAR_BEYOND, 1), 0.0)
    station = np.clip((place + 0.5).astype(int), 0, count - 1)
    sums = [np.bincount(station, weight * value, count) for value in (1 + 0 * off, slope, slope**2, off, off * slope)]
    total, first, second, up, side = gaussian_filter1d(np.stack(sums), WINDOW_WIDTHS * width / step_mm, axis=1)
    # A section moved by (a, b) has the heights b - slope a at the same places.
    second = second + SIDE_PRIOR * total
    determinant = np.maximum(total * second - first**2, 1e-9)
    return (first * up - total * side) / determinant, (second * up - first * side) / determinant
