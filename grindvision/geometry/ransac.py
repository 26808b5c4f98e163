"""Plane and sphere among outliers, by RANSAC: the shape that most points lie near, refined by least squares on them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry.fits import PlaneFit, SphereFit, check_points, plane_through, sphere_through
from grindvision.kernels import njit

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


def ransac_plane(points: ArrayLike, threshold_mm: float, rng: np.random.Generator, iterations: int = 500) -> PlaneFit:
    """Plane with the most points within ``threshold_mm``, refined by least squares on them.

    Raises:
        DegenerateError: no three points span a plane.
    """
    points = check_points(points, "plane points", min_points=3)
    inliers = _consensus(points, 3, _near_plane, threshold_mm, rng, iterations)
    fit = plane_through(points, inliers)
    return plane_through(points, np.abs(fit.distance(points)) <= threshold_mm)


def ransac_sphere(
    points: ArrayLike,
    threshold_mm: float,
    rng: np.random.Generator,
    radius_mm: float | None = None,
    iterations: int = 500,
) -> SphereFit:
    """Sphere with the most points within ``threshold_mm`` of its surface, refined by least squares on them.

    With ``radius_mm`` given, only spheres within 20 % of it are tried, and the refined one has exactly that radius.

    Raises:
        DegenerateError: no four points span such a sphere.
    """
    points = check_points(points, "sphere points", min_points=4)
    free = np.nan if radius_mm is None else float(radius_mm)
    inliers = _consensus(points, 4, partial(_near_sphere, radius_mm=free), threshold_mm, rng, iterations)
    for _ in range(3):
        fit = sphere_through(points, inliers, radius_mm)
        inliers = np.abs(fit.distance(points)) <= threshold_mm
    return sphere_through(points, inliers, radius_mm)


def _consensus(
    points: Floats,
    n_drawn: int,
    near: Callable[[Floats, Floats, float], Flags | None],
    threshold_mm: float,
    rng: np.random.Generator,
    iterations: int,
) -> Flags:
    """Points (N,) near the shape through ``n_drawn`` of them that has the most points near it.

    ``near(drawn, points, threshold_mm)`` marks them; None where the drawn points span no such shape.
    """
    if not threshold_mm > 0:
        raise InputError(f"the RANSAC threshold is {threshold_mm} mm; it must be above zero")
    points, threshold_mm = np.ascontiguousarray(points), float(threshold_mm)
    scored = points if len(points) <= 4000 else points[rng.choice(len(points), 4000, replace=False)]
    best, best_drawn = 0, None
    for trial in range(1, iterations + 1):
        drawn = points[rng.choice(len(points), n_drawn, replace=False)]
        flags = near(drawn, scored, threshold_mm)
        if flags is None:
            continue
        count = int(np.count_nonzero(flags))
        if count > best:
            best, best_drawn = count, drawn
        if best and (1 - (best / len(scored)) ** n_drawn) ** trial < 1e-6:
            break
    inliers = None if best_drawn is None else near(best_drawn, points, threshold_mm)
    if inliers is None or inliers.sum() < n_drawn:
        raise DegenerateError(
            f"no model found in {len(points)} points within {threshold_mm} mm; check the threshold, and that the shape"
            " is there"
        )
    return inliers


@njit(cache=True)
def _near_plane(drawn: Floats, points: Floats, threshold_mm: float) -> Flags | None:
    """Points (N,) within the threshold of the plane through three (3, 3)."""
    normal = np.cross(drawn[1] - drawn[0], drawn[2] - drawn[0])
    length = np.sqrt((normal**2).sum())
    if length < 1e-12:
        return None
    near = np.empty(len(points), dtype=np.bool_)
    for i in range(len(points)):
        height = 0.0
        for k in range(3):
            height += (points[i, k] - drawn[0, k]) * normal[k]
        near[i] = abs(height) / length <= threshold_mm
    return near


@njit(cache=True)
def _near_sphere(drawn: Floats, points: Floats, threshold_mm: float, radius_mm: float) -> Flags | None:
    """Points (N,) within the threshold of the sphere through four (4, 3); a radius not NaN replaces the sphere's own,
    which must come within 20 % of it."""
    edges = drawn[1:] - drawn[0]
    across = np.cross(edges[1], edges[2])
    volume = (edges[0] * across).sum()
    if abs(8 * volume) < 1e-9:
        return None
    squares = (edges**2).sum(axis=1)
    from_first = squares[0] * across + squares[1] * np.cross(edges[2], edges[0])
    from_first = (from_first + squares[2] * np.cross(edges[0], edges[1])) / (2 * volume)
    radius = np.sqrt((from_first**2).sum())
    if not np.isnan(radius_mm):
        if abs(radius - radius_mm) > 0.2 * radius_mm:
            return None
        radius = radius_mm
    near = np.empty(len(points), dtype=np.bool_)
    for i in range(len(points)):
        squared = 0.0
        for k in range(3):
            squared += (points[i, k] - drawn[0, k] - from_first[k]) ** 2
        near[i] = abs(np.sqrt(squared) - radius) <= threshold_mm
    return near
