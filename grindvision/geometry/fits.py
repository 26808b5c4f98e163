"""Fits to point sets: rigid motion, plane and sphere, by least squares (by RANSAC: ``ransac``)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry.transforms import rigid
from grindvision.records import by_content

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


@by_content
@dataclass(frozen=True)
class RigidFit:
    """The rigid motion that best maps one point list onto another.

    ``T_target_source`` (4, 4), ``residuals_mm`` (N, 3) = target - moved source, ``rms_mm`` of their lengths.
    """

    T_target_source: Floats
    residuals_mm: Floats
    rms_mm: float

    def __str__(self) -> str:
        return f"rigid fit of {len(self.residuals_mm)} pairs: rms {self.rms_mm:.3g} mm"


@by_content
@dataclass(frozen=True)
class PlaneFit:
    """Plane ``normal . p = offset_mm`` with unit ``normal`` (3,), ``covariance`` (3, 3) of tilt, tilt and offset.

    ``axes`` (2, 3) span the plane; the covariance belongs to the rotations about them (rad) and to the translation
    along the normal at ``centre_mm`` (mm). ``inliers`` (N,) marks the points used.
    """

    normal: Floats
    offset_mm: float
    centre_mm: Floats
    axes: Floats
    covariance: Floats
    rms_mm: float
    inliers: Flags

    def distance(self, points: ArrayLike) -> Floats:
        """Signed distances (N,) in mm of points (N, 3), positive on the side of the normal."""
        return np.asarray(points, dtype=float) @ self.normal - self.offset_mm

    def __str__(self) -> str:
        return f"plane through {int(self.inliers.sum())} points: rms {self.rms_mm:.3g} mm"


@by_content
@dataclass(frozen=True)
class SphereFit:
    """Sphere with ``centre_mm`` (3,) and ``radius_mm``; ``centre_covariance`` (3, 3) in mm squared.

    The covariance follows from the residuals' rms and the points' spread over the sphere: a small cap is uncertain
    along its axis. ``inliers`` (N,) marks the points used.
    """

    centre_mm: Floats
    radius_mm: float
    centre_covariance: Floats
    rms_mm: float
    inliers: Flags

    def distance(self, points: ArrayLike) -> Floats:
        """Signed distances (N,) in mm of points (N, 3) from the surface, positive outside."""
        return np.linalg.norm(np.asarray(points, dtype=float) - self.centre_mm, axis=1) - self.radius_mm

    def __str__(self) -> str:
        x, y, z = self.centre_mm
        return f"sphere at ({x:.3f}, {y:.3f}, {z:.3f}) mm, radius {self.radius_mm:.3f} mm, rms {self.rms_mm:.3g} mm"


def check_points(points: ArrayLike, name: str, min_points: int = 1) -> Floats:
    """Return ``points`` as float64 (N, 3) with N >= ``min_points`` and finite entries.

    Raises:
        InputError: wrong shape or NaN. DegenerateError: fewer points than ``min_points``.
    """
    try:
        array = np.asarray(points, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{name} are not numbers; expected an array of shape (N, 3)") from None
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name} have shape {array.shape}; expected (N, 3)")
    if len(array) < min_points:
        raise DegenerateError(f"{name}: {len(array)} points given, at least {min_points} needed")
    if not np.isfinite(array).all():
        bad = ~np.isfinite(array).all(axis=1)
        raise InputError(f"{name}: {int(bad.sum())} of {len(array)} points hold NaN or infinity; drop them first")
    return array


def fit_rigid(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None) -> RigidFit:
    """Rigid motion that maps ``source`` (N, 3) onto ``target`` (N, 3) with least squared distance; never a reflection.

    Args:
        source: points in the source frame, mm.
        target: the same points in the target frame, same order.
        weights: (N,) non-negative; equal when left out.

    Raises:
        InputError: shapes differ. DegenerateError: fewer than three points, or points on one line.
    """
    source = check_points(source, "source points", min_points=3)
    target = check_points(target, "target points", min_points=3)
    if source.shape != target.shape:
        raise InputError(f"source {source.shape} and target {target.shape} points must come in pairs")
    if weights is None:
        w = np.full(len(source), 1 / len(source))
    else:
        w = np.asarray(weights, dtype=float)
        if w.shape != (len(source),) or not np.isfinite(w).all() or (w < 0).any() or w.sum() == 0:
            raise InputError(f"weights must be {len(source)} non-negative numbers, not all zero")
        w = w / w.sum()
    centre_source, centre_target = w @ source, w @ target
    for name, points, centre in (("source", source, centre_source), ("target", target, centre_target)):
        singular = np.linalg.svd(np.sqrt(w)[:, None] * (points - centre), compute_uv=False)
        if singular[1] <= 1e-9 * max(singular[0], np.abs(points).max() * 1e-6):
            raise DegenerateError(f"the {name} points lie on one line or coincide; the rotation about it is free")
    u, _, vt = np.linalg.svd((target - centre_target).T @ (w[:, None] * (source - centre_source)))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    transform = rigid(rotation, centre_target - rotation @ centre_source)
    residuals = target - (source @ rotation.T + transform[:3, 3])
    return RigidFit(transform, residuals, float(np.sqrt(w @ (residuals**2).sum(axis=1))))


def fit_plane(points: ArrayLike) -> PlaneFit:
    """Total least squares plane through points (N, 3), N >= 3.

    Raises:
        DegenerateError: fewer than three points, or points on one line.
    """
    points = check_points(points, "plane points", min_points=3)
    return plane_through(points, np.ones(len(points), dtype=bool))


def fit_sphere(points: ArrayLike, radius_mm: float | None = None) -> SphereFit:
    """Least squares (geometric distance) sphere through points (N, 3); the radius free, or fixed when given.

    Raises:
        DegenerateError: fewer than four points (three with the radius given), or points on one plane's circle.
    """
    points = check_points(points, "sphere points", min_points=4 if radius_mm is None else 3)
    return sphere_through(points, np.ones(len(points), dtype=bool), radius_mm)


def plane_through(points: Floats, inliers: Flags) -> PlaneFit:
    """Total least squares plane through the points (N, 3) marked as ``inliers`` (N,)."""
    used = points[inliers]
    if len(used) < 3:
        raise DegenerateError(f"only {len(used)} points left on the plane; at least 3 needed")
    centre = np.full(len(used), 1 / len(used)) @ used
    apart = used - centre
    singular, axes = _axes_of(apart)
    if singular[1] <= 1e-9 * max(singular[0], np.abs(used).max() * 1e-6):
        raise DegenerateError("the points lie on one line; a plane needs three that do not")
    normal = axes[2] * np.sign(axes[2][np.argmax(np.abs(axes[2]))])
    residuals = apart @ normal
    variance = residuals @ residuals / max(len(used) - 3, 1)
    covariance = variance * np.diag([1 / singular[1] ** 2, 1 / singular[0] ** 2, 1 / len(used)])
    rms = float(np.sqrt(np.mean(residuals**2)))
    return PlaneFit(normal, float(normal @ centre), centre, axes[:2], covariance, rms, inliers)


def _axes_of(differences: Floats) -> tuple[Floats, Floats]:
    """Singular values (3,), largest first, and right singular vectors (3, 3), in rows, of differences (N, 3).

    From their scatter matrix, which is many times cheaper, where squaring loses nothing: where they are no line.
    """
    squares, axes = np.linalg.eigh(differences.T @ differences)
    if squares[1] > 1e-4 * squares[2]:
        return np.sqrt(np.maximum(squares[::-1], 0.0)), axes.T[::-1]
    _, singular, rows = np.linalg.svd(differences, full_matrices=False)
    return singular, rows


def sphere_through(points: Floats, inliers: Flags, radius_mm: float | None) -> SphereFit:
    """Least squares sphere through the points (N, 3) marked as ``inliers`` (N,), of the radius given or its own."""
    used = points[inliers]
    min_points = 4 if radius_mm is None else 3
    if len(used) < min_points:
        raise DegenerateError(f"only {len(used)} points left on the sphere; at least {min_points} needed")
    origin = used.mean(axis=0)
    p = used - origin
    design = np.column_stack([2 * p, np.ones(len(p))])
    solution, _, rank, _ = np.linalg.lstsq(design, (p**2).sum(axis=1), rcond=1e-9)
    if rank < 4:
        raise DegenerateError("the points lie on one plane; a sphere needs four that do not")
    centre = solution[:3]
    radius = float(np.sqrt(max(solution[3] + centre @ centre, 0))) if radius_mm is None else float(radius_mm)
    for _ in range(50):
        rays = p - centre
        lengths = np.linalg.norm(rays, axis=1)
        jacobian = -rays / lengths[:, None]
        if radius_mm is None:
            jacobian = np.column_stack([jacobian, -np.ones(len(p))])
        step, *_ = np.linalg.lstsq(jacobian.T @ jacobian, jacobian.T @ (radius - lengths), rcond=None)
        centre = centre + step[:3]
        if radius_mm is None:
            radius += float(step[3])
        if np.abs(step).max() < 1e-10:
            break
    residuals = np.linalg.norm(p - centre, axis=1) - radius
    variance = residuals @ residuals / max(len(p) - jacobian.shape[1], 1)
    covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)[:3, :3]
    return SphereFit(centre + origin, radius, covariance, float(np.sqrt(np.mean(residuals**2))), inliers)
