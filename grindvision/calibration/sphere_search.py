"""A sphere of known diameter in a cloud that shows other things too: found by neighbouring points, then fitted."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.calibration.sphere_centres import find_sphere
from grindvision.errors import DegenerateError
from grindvision.geometry import SphereFit, check_points, fit_sphere

Floats = NDArray[np.float64]

#: Trials, how many of them share a neighbourhood, and points that judge a trial.
TRIALS, SHARING, JUDGES = 1500, 10, 4000

#: How far points may stand off the sphere, in radii and in mm: a camera's noise, and no plane's.
THRESHOLD_RADII, THRESHOLDS_MM = 0.0125, (0.3, 1.5)

#: The radius of a trial may differ from the stated one by this share, that of the points found by this one.
TRIAL_TOLERANCE, RADIUS_TOLERANCE = 0.15, 0.04

#: Points of a sphere at least, how far (radii) the cap must reach across, and the share of points there that lie on it.
FEWEST_POINTS, MIN_REACH, MIN_FRACTION = 60, 0.5, 0.85


def cut_out_sphere(points_camera: ArrayLike, diameter_mm: float, rng: np.random.Generator, name: str) -> SphereFit:
    """The sphere of a diameter in a cloud (N, 3), mm, whatever else it shows; the radius of the result is the stated.

    Raises:
        DegenerateError: no such sphere in it, with the diameter of another one that is there.
    """
    points = check_points(points_camera, name, min_points=FEWEST_POINTS)
    radius = diameter_mm / 2
    threshold = float(np.clip(THRESHOLD_RADII * radius, *THRESHOLDS_MM))
    centre = _search(points, radius, threshold, rng)
    if centre is not None:
        crop = points[np.linalg.norm(points - centre, axis=1) < 1.6 * radius]
        try:
            found = find_sphere(crop, rng, radius, threshold)
        except DegenerateError:
            found = None
        if found is not None and _is_a_cap(crop, found):
            free = fit_sphere(crop[found.inliers])
            tolerance_mm = 4 * free.rms_mm + RADIUS_TOLERANCE * radius
            if abs(free.radius_mm - radius) <= tolerance_mm:
                return found
            raise DegenerateError(
                f"{name}: the sphere in it has a diameter of {2 * free.radius_mm:.1f} mm, not {diameter_mm:g} mm; mend"
                " --target sphere:DIAMETER_MM"
            )
    raise DegenerateError(
        f"{name}: no sphere of diameter {diameter_mm:g} mm in it; is that the diameter in mm, is the sphere in view?"
    )


def _search(points: Floats, radius: float, threshold: float, rng: np.random.Generator) -> Floats | None:
    """Centre (3,) of the sphere of about this radius with the most points near it; None where there is none.

    Four points are drawn within a radius of each other: in clutter they lie on one thing far more often than four
    points of the whole cloud.
    """
    tree = cKDTree(points)
    judges = points if len(points) <= JUDGES else points[rng.choice(len(points), JUDGES, replace=False)]
    best, max_count = None, 0
    for seed in rng.integers(len(points), size=TRIALS // SHARING):
        near = np.asarray(tree.query_ball_point(points[seed], 0.9 * radius), dtype=np.int64)
        if len(near) < FEWEST_POINTS // 4:
            continue
        drawn = points[rng.choice(np.sort(near), (SHARING, 4))]
        for centre in _centres(drawn, radius):
            off = np.abs(np.linalg.norm(judges - centre, axis=1) - radius)
            count = int(np.count_nonzero(off <= threshold))
            if count > max_count:
                best, max_count = centre, count
    return best


def _centres(drawn: Floats, radius: float) -> Floats:
    """Centres (K, 3) of those spheres through four points (M, 4, 3) that have about this radius."""
    edges = drawn[:, 1:] - drawn[:, :1]
    proper = np.abs(np.linalg.det(edges)) > 1e-4 * radius**3
    edges, first = edges[proper], drawn[proper, 0]
    if len(edges) == 0:
        return np.empty((0, 3))
    offset = np.linalg.solve(2 * edges, (edges**2).sum(axis=2)[..., None])[..., 0]
    fits = np.abs(np.linalg.norm(offset, axis=1) / radius - 1) < TRIAL_TOLERANCE
    return np.asarray(first[fits] + offset[fits])


def _is_a_cap(points: Floats, fit: SphereFit) -> bool:
    """Whether enough points reach far enough over the sphere, and few stand off it there.

    A small disc fits any flat thing; a head or a fruit has a sphere's size and points beside its surface.
    """
    if fit.inliers.sum() < FEWEST_POINTS:
        return False
    rays = (points - fit.centre_mm) / fit.radius_mm
    distance = np.linalg.norm(rays, axis=1)
    pole = rays[fit.inliers].mean(axis=0) / np.linalg.norm(rays[fit.inliers].mean(axis=0))
    along = rays @ pole / np.maximum(distance, 1e-9)
    inside = (along > np.quantile(along[fit.inliers], 0.2)) & (distance > 0.5) & (distance < 1.3)
    across = np.sqrt(np.maximum(1 - along[fit.inliers] ** 2, 0.0))
    return bool(np.quantile(across, 0.95) > MIN_REACH and fit.inliers[inside].mean() > MIN_FRACTION)
