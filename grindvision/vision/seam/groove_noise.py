"""Whether a groove stands out of the noise of the surface beside it.

The deepest of the thousand places at which a groove might lie is several standard deviations deep by chance, and a line
through such places wanders from one to the next. What counts is the noise over patches of the groove's own size: a
camera's errors are alike over several pixels, and no more points make them smaller.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import unit_vectors
from grindvision.vision.seam.groove_diagnostics import MIN_WALL_FRACTION, Judged
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.seam_curve import beside_stations, in_frames

Floats = NDArray[np.float64]

#: A groove is so many standard deviations of its patches deep: those in the noise of flat plates (0.5 mm, alike over 1
#: to 3 mm) reach 7 where they seem to have edges and 10 where not; V-grooves 6 mm wide in the same noise have 11.
MIN_DEVIATIONS, MIN_DOUBTFUL_DEVIATIONS = 8.5, 11.0
#: Patches per width of the groove; a patch is at least so many spacings wide.
PATCHES, MIN_PATCH_SPACINGS = 4, 1.5
#: The surface begins so far from the root, in widths; of a square of patches at least so many must hold points.
BESIDE_WIDTHS, MIN_PATCHES = 0.65, 8
#: So many widths in the middle of a groove tell the noise.
LOOKED_AT_WIDTHS = 6.0


def stands_out(judged: Judged, cloud: Floats, spacing_mm: float) -> bool:
    """Whether a groove is too deep for the noise of the cloud (N, 3) beside it; true where nothing tells the noise.

    A gap between two things, whose walls nobody saw, is none of noise.
    """
    if judged.on_walls < MIN_WALL_FRACTION:
        return True
    noise = patch_noise_mm(judged.groove, cloud, spacing_mm)
    least = MIN_DEVIATIONS if judged.is_sure else MIN_DOUBTFUL_DEVIATIONS
    return noise is None or float(np.median(judged.groove.depth_mm)) > least * noise


def patch_noise_mm(groove: DetectedGroove, cloud: Floats, spacing_mm: float) -> float | None:
    """Standard deviation, mm, of the mean heights of patches of the surface beside a groove in its cloud (N, 3).

    On the side that is the rougher one; the plane through each square of patches is taken off. None where too little of
    the surface is seen.
    """
    width = float(np.median(groove.width_mm))
    patch = max(width / PATCHES, MIN_PATCH_SPACINGS * spacing_mm)
    first = BESIDE_WIDTHS * width
    reach = first + PATCHES * patch
    half, middle = int(LOOKED_AT_WIDTHS * width / groove.step_mm / 2) + 2, len(groove.root) // 2
    here = slice(max(middle - half, 0), middle + half)
    root, normals = groove.root[here], groove.normals[here]
    along = unit_vectors(np.gradient(root, axis=0))
    near, station, _ = beside_stations(cloud, root, along, reach, groove.step_mm)
    across = unit_vectors(np.cross(normals, along))
    ahead, aside, height = in_frames(cloud[near], station, root, (along, across, normals)).T
    place = station * groove.step_mm + ahead
    found = []
    for side in (-1.0, 1.0):
        beside = (side * aside > first) & (side * aside < reach)
        squares = _squares(place[beside], side * aside[beside] - first, height[beside], patch)
        if squares:
            found.append(float(np.median(squares)))
    return max(found, default=None)


def _squares(place: Floats, aside: Floats, height: Floats, patch: float) -> list[float]:
    """Standard deviation of the patches' mean heights about their plane, square by square along the groove."""
    if not len(place):
        return []
    row = np.floor((place - place.min()) / patch).astype(int)
    column = np.minimum((aside / patch).astype(int), PATCHES - 1)
    rows = (int(row.max()) // PATCHES + 1) * PATCHES
    counts = np.bincount(row * PATCHES + column, minlength=rows * PATCHES)
    means = np.bincount(row * PATCHES + column, height, minlength=rows * PATCHES) / np.maximum(counts, 1)
    squares = []
    for first in range(0, rows * PATCHES, PATCHES**2):
        held = np.flatnonzero(counts[first : first + PATCHES**2])
        if len(held) < MIN_PATCHES:
            continue
        plane = np.column_stack([np.ones(len(held)), held // PATCHES, held % PATCHES])
        values = means[first + held]
        off = values - plane @ np.linalg.lstsq(plane, values, rcond=None)[0]
        squares.append(float(np.sqrt((off**2).sum() / (len(held) - 3))))
    return squares
