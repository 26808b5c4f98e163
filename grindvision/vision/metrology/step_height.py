"""Height of a step between two parallel faces in a cloud: RANSAC finds the planes, least squares places them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import PlaneFit, check_points, fit_plane
from grindvision.geometry.ransac import ransac_plane

Floats = NDArray[np.float64]

#: Points farther from a face than this many robust standard deviations are not its own.
CLIP = 3.0

#: Planes that enclose more than this are not the two faces of one step, deg.
PARALLEL_DEG = 3.0


@dataclass(frozen=True)
class StepHeight:
    """Distance ``height_mm`` of the smaller face's middle from the plane of the larger one.

    ``fit_std_mm`` is what the scatter about both planes alone makes of it, as if every point erred independently: it
    knows nothing of errors that neighbouring points share. ``larger`` and ``smaller`` are the planes, normals alike.
    """

    height_mm: float
    fit_std_mm: float
    larger: PlaneFit
    smaller: PlaneFit

    def __str__(self) -> str:
        return f"step of {self.height_mm:.4f} mm, standard deviation of the fits alone {self.fit_std_mm * 1000:.2f} um"


def measure_step(points: ArrayLike, rng: np.random.Generator, threshold_mm: float = 0.2) -> StepHeight:
    """Find the two largest parallel faces in a cloud (N, 3) and the distance between them.

    Args:
        points: cloud in mm that holds both faces and little else.
        rng: for RANSAC.
        threshold_mm: distance within which RANSAC counts a point to a plane; several times the scanner's noise.

    Raises:
        DegenerateError: no second face parallel to the first. InputError: NaN points or bad threshold.
    """
    points = check_points(points, "step points", min_points=6)
    if not threshold_mm > 0:
        raise InputError(f"threshold_mm is {threshold_mm}; it must be above zero")
    larger = _face(points, threshold_mm, rng)
    rest = points[np.abs(larger.distance(points)) > 5 * threshold_mm]
    if len(rest) < 6:
        raise DegenerateError("there is one face only; a step needs a second one beside it")
    smaller = _face(rest, threshold_mm, rng)
    tilt = float(np.degrees(np.arccos(min(1.0, abs(float(larger.normal @ smaller.normal))))))
    if tilt > PARALLEL_DEG:
        raise DegenerateError(
            f"the two largest faces enclose {tilt:.1f} deg; a step's faces are parallel, crop the cloud"
        )
    lever = smaller.centre_mm - larger.centre_mm
    # The larger plane's offset and tilts, carried to the middle of the smaller face, and that face's own offset.
    slope = np.array([*np.cross(larger.axes, larger.normal) @ lever, 1.0])
    variance = slope @ larger.covariance @ slope + smaller.covariance[2, 2]
    return StepHeight(float(abs(larger.normal @ lever)), float(np.sqrt(variance)), larger, smaller)


def _face(points: Floats, threshold_mm: float, rng: np.random.Generator) -> PlaneFit:
    """Largest plane, refined on the points within ``CLIP`` robust standard deviations until they stay the same."""
    used = points[ransac_plane(points, threshold_mm, rng).inliers]
    for _ in range(30):
        plane = fit_plane(used)
        off = np.abs(plane.distance(used))
        kept = off <= max(CLIP * 1.4826 * np.median(off), 1e-9)
        if kept.all() or kept.sum() < 6:
            return plane
        used = used[kept]
    return fit_plane(used)
