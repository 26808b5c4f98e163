"""A sphere of known diameter in a cloud that shows other things too: found by neighbouring points, then fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.calibration.sphere_centres import find_sphere, noise_clumping, patch_means
from grindvision.errors import DegenerateError
from grindvision.geometry import SphereFit, check_points, fit_sphere
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Trials, how many of them share a neighbourhood, and points that judge a trial.
TRIALS, SHARING, JUDGES = 1500, 10, 4000

#: How far points may stand off the sphere, in radii and in mm: a camera's noise, and no plane's.
THRESHOLD_RADII, THRESHOLDS_MM = 0.0125, (0.3, 1.5)

#: Where none is found, points of a noisier camera may stand so many times farther off, up to so many radii, if what
#: patches of them have in common does not: noise differs from point to point, another shape does not.
NOISIER, MOST_RADII = (1, 2, 4, 8), 0.1

#: The radius of a trial may differ from the stated one by this share, that of the points found by this one.
TRIAL_TOLERANCE, RADIUS_TOLERANCE = 0.15, 0.04

#: Points of a sphere at least, how far (radii) the cap must reach across, and the share of points there that lie on it.
FEWEST_POINTS, MIN_REACH, MIN_FRACTION = 60, 0.5, 0.85

#: A stated diameter is doubted where the spheres' own fits differ from it by so many standard deviations, and it puts
#: their centres so far (mm) off: a fifth of what a camera of use is known to.
DOUBTED_SIGMAS, DOUBTED_MM = 3.0, 0.3

#: Rounds in which a sphere's points are chosen by its own diameter.
OWN_ROUNDS = 4


@by_content
@dataclass(frozen=True)
class OwnDiameter:
    """Diameter of a sphere by its points alone, its standard deviation, and by how much its centre is then farther from
    the camera than with the stated one; mm."""

    diameter_mm: float
    sigma_mm: float
    farther_mm: float


def cut_out_sphere(points_camera: ArrayLike, diameter_mm: float, rng: np.random.Generator, name: str) -> SphereFit:
    """The sphere of a diameter in a cloud (N, 3), mm, whatever else it shows; the radius of the result is the stated,
    its ``inliers`` mark points of the cloud.

    Raises:
        DegenerateError: no such sphere in it, with the diameter of another one that is there.
    """
    points = check_points(points_camera, name, min_points=FEWEST_POINTS)
    radius = diameter_mm / 2
    threshold = float(np.clip(THRESHOLD_RADII * radius, *THRESHOLDS_MM))
    for times in NOISIER:
        if times > 1 and times * threshold > MOST_RADII * radius:
            break
        found = _found(points, radius, times * threshold, rng)
        if found is None:
            continue
        used = points[found.inliers]
        if times > 1 and np.sqrt(np.mean(patch_means(used, found)[0] ** 2)) > threshold:
            continue
        free = fit_sphere(used)
        if abs(free.radius_mm - radius) <= 4 * free.rms_mm + RADIUS_TOLERANCE * radius:
            return found
        raise DegenerateError(
            f"{name}: the sphere in it has a diameter of {2 * free.radius_mm:.1f} mm, not {diameter_mm:g} mm; mend"
            " --target sphere:DIAMETER_MM"
        )
    raise DegenerateError(
        f"{name}: no sphere of diameter {diameter_mm:g} mm in it; is that the diameter in mm, is the sphere in view?"
    )


def own_diameter(points_camera: ArrayLike, fit: SphereFit) -> OwnDiameter:
    """What the points (N, 3) of a sphere that was cut out say of its diameter themselves.

    Points within a threshold of the stated sphere are those that agree with it: they are chosen anew by their own one.
    """
    points = np.asarray(points_camera, dtype=float)
    used, free = fit.inliers, fit
    for _ in range(OWN_ROUNDS):
        free = fit_sphere(points[used])
        rays = points - free.centre_mm
        along = rays @ rays[used].mean(axis=0) / np.linalg.norm(rays, axis=1)
        left = free.distance(points)
        scatter = 1.4826 * float(np.median(np.abs(left[used])))
        used = (along >= along[used].min()) & (np.abs(left) <= max(4 * scatter, 1e-9))
    rays = points[used] - free.centre_mm
    columns = np.column_stack([rays / np.linalg.norm(rays, axis=1)[:, None], np.ones(len(rays))])
    clumping = noise_clumping(points[used], free)
    variance = np.linalg.pinv(columns.T @ columns)[3, 3] * float((left[used] ** 2).mean()) * clumping
    farther = (free.centre_mm - fit.centre_mm) @ fit.centre_mm / np.linalg.norm(fit.centre_mm)
    return OwnDiameter(2 * free.radius_mm, 2 * float(np.sqrt(variance)), float(farther))


def doubt_diameter(seen: Sequence[OwnDiameter], diameter_mm: float) -> str:
    """In words, that views of a sphere have another diameter than the stated one; nothing where they do not.

    What one view says of it may be off by more than its noise, as by the camera's scale: their scatter counts, too.
    """
    own, sigmas = (np.array([getattr(one, name) for one in seen]) for name in ("diameter_mm", "sigma_mm"))
    weights = 1 / np.maximum(sigmas, 1e-9) ** 2
    mean = float(np.average(own, weights=weights))
    scatter = float((weights * (own - mean) ** 2).sum()) / max(len(own) - 1, 1)
    sigma = float(np.sqrt(max(scatter, 1.0) / weights.sum()))
    farther = float(np.median([one.farther_mm for one in seen]))
    if abs(mean - diameter_mm) <= DOUBTED_SIGMAS * sigma or abs(farther) <= DOUBTED_MM:
        return ""
    return (
        f"by its own points the sphere has a diameter of {mean:.2f} +- {sigma:.2g} mm, not the stated {diameter_mm:g}"
        f" mm, which puts its centres {abs(farther):.2g} mm too {'near to' if farther > 0 else 'far from'} the camera:"
        f" mend --target, or the camera's scale is off by {abs(mean / diameter_mm - 1):.1%}"
    )


def _found(points: Floats, radius: float, threshold: float, rng: np.random.Generator) -> SphereFit | None:
    """The sphere of this radius with the points that lie on it, of all (N,); None without one."""
    centre = _search(points, radius, threshold, rng)
    if centre is None:
        return None
    near = np.flatnonzero(np.linalg.norm(points - centre, axis=1) < 1.6 * radius)
    crop = points[near]
    try:
        fit = find_sphere(crop, rng, radius, threshold)
    except DegenerateError:
        return None
    if not _is_a_cap(crop, fit):
        return None
    used = np.zeros(len(points), dtype=bool)
    used[near[fit.inliers]] = True
    return replace(fit, inliers=used)


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
