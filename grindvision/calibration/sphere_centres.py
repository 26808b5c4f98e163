"""The centre of a scanned sphere: found among outliers, its nest cut away, with an honest covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.errors import DegenerateError
from grindvision.geometry import SphereFit, check_points, fit_sphere

Floats = NDArray[np.float64]


def find_sphere(
    points_scanner: ArrayLike,
    rng: np.random.Generator,
    radius_mm: float | None = None,
    threshold_mm: float = 0.3,
    margin_deg: float = 8.0,
) -> SphereFit:
    """Find the sphere in a scan (N, 3): RANSAC, the rim beside anything that touches it cut away, then least squares.

    Args:
        points_scanner: a partial cap with outliers and the nest it sits on, mm.
        rng: draws the samples.
        radius_mm: fixes the radius; free when left out.
        threshold_mm: how far a point of the sphere may stand off its surface.
        margin_deg: sphere points seen from the centre within this angle of foreign points are not used.

    Raises:
        DegenerateError: no sphere in the cloud, or too little of it left beside the nest.
    """
    from grindvision.geometry.ransac import ransac_sphere

    points = check_points(points_scanner, "scan of the sphere", min_points=4)
    rough = ransac_sphere(points, threshold_mm, rng, radius_mm)
    rays = points - rough.centre_mm
    distance = np.linalg.norm(rays, axis=1)
    directions = rays / distance[:, None]
    near = ~rough.inliers & (distance < 1.6 * rough.radius_mm) & (distance > rough.radius_mm)
    used = rough.inliers.copy()
    crowded = near.copy()
    if near.any():
        # fewer than four have neighbours at infinity: strays, too
        lonely = cKDTree(points[near]).query(points[near], k=4)[0][:, -1] > 0.2 * rough.radius_mm
        crowded[np.flatnonzero(near)[lonely]] = False
    if crowded.any():
        chord = 2 * np.sin(np.radians(margin_deg) / 2)
        gap = cKDTree(directions[crowded]).query(directions[used], distance_upper_bound=chord)[0]
        used[np.flatnonzero(used)[np.isfinite(gap)]] = False
    for _ in range(3):
        if used.sum() < 20:
            raise DegenerateError(
                f"{int(used.sum())} of {len(points)} points are left on the sphere beside its nest; scan more of it"
            )
        fit = fit_sphere(points[used], radius_mm)
        left = fit.distance(points[used])
        sigma = 1.4826 * np.median(np.abs(left - np.median(left)))
        used[np.flatnonzero(used)[np.abs(left) > max(4 * sigma, 1e-9)]] = False
    fit = fit_sphere(points[used], radius_mm)
    covariance = fit.centre_covariance * noise_clumping(points[used], fit)
    return replace(fit, centre_covariance=covariance, inliers=used)


def noise_clumping(points: ArrayLike, fit: SphereFit, cells: int = 40) -> float:
    """How many times neighbouring points share their error: variance of patch means over what independent noise gives.

    A scanner's noise is correlated and its field distorted, so 10,000 points do not average like 10,000 throws. The
    cap is split into about ``cells`` patches of nearest neighbours; at least 1 is returned.
    """
    left = fit.distance(np.asarray(points, dtype=float))
    if left.var() < 1e-24 or min(cells, len(left) // 10) < 8:
        return 1.0
    means, count = patch_means(points, fit, cells)
    observed = (count * means**2).sum() / max(len(means) - 4, 1)
    return float(max(observed / left.var(), 1.0))


def patch_means(points: ArrayLike, fit: SphereFit, cells: int = 40) -> tuple[Floats, Floats]:
    """Mean distances (K,) from a sphere over at most ``cells`` patches of nearest neighbours, of ten points and more in
    the mean, and how many points each has (K,)."""
    points = np.asarray(points, dtype=float)
    left = fit.distance(points)
    cells = max(min(cells, len(points) // 10), 1)
    directions = (points - fit.centre_mm) / fit.radius_mm
    seeds = [0]
    nearest = np.linalg.norm(directions - directions[0], axis=1)
    for _ in range(cells - 1):
        seeds.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(directions - directions[seeds[-1]], axis=1))
    patch = cKDTree(directions[seeds]).query(directions)[1]
    count = np.bincount(patch, minlength=cells).astype(float)
    held = count > 0
    return np.bincount(patch, weights=left, minlength=cells)[held] / count[held], count[held]
