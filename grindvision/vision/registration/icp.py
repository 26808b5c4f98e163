"""Iterative closest points (section 3.4): point to point as the paper stops it, and generalised ICP by small_gicp.

Detection uses ``plane_icp``. A result carries ``T_target_source``, the rms of what was matched, the overlap, and the
covariance of the pose. Here the covariance holds for independent noise; ``bending`` looks at the residuals' correlation
and at smooth distortion.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.extras import extra
from grindvision.geometry import check_points, check_rigid, fit_rigid, motion_columns, move_points, skew
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content

Floats = NDArray[np.float64]


@by_content
@dataclass(frozen=True)
class FineRegistration:
    """A pose refined by ICP.

    ``rms_mm`` of the matched residuals (along the normal where planes are used); ``overlap``: matched share of the
    source; ``information`` (6, 6): sum of the Jacobians' squares for a translation (mm) followed by a rotation (rad)
    about ``centre_mm``, target frame; ``covariance`` its inverse times the residuals' variance, NaN where singular;
    ``hidden_covariance`` (6, 6): what distortion may add that looks like a motion and so shows in no residual;
    ``mean_squares_mm2``: the mean squared residual after each iteration. ``by_rims``: planes and curvature leave a
    motion hardly known, and the rims of faces hold it.
    """

    T_target_source: Floats
    rms_mm: float
    overlap: float
    iterations: int
    converged: bool
    centre_mm: Floats
    information: Floats
    covariance: Floats
    mean_squares_mm2: Floats
    hidden_covariance: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    by_rims: bool = False

    @property
    def total_covariance(self) -> Floats:
        """Covariance (6, 6) of the pose between the parts; ``covariance`` is that of the pose between their scans."""
        return self.covariance + self.hidden_covariance

    def __str__(self) -> str:
        state = "converged" if self.converged else "stopped"
        return f"ICP {state} after {self.iterations} iterations: rms {self.rms_mm:.3g} mm, overlap {self.overlap:.0%}"


@one_blas_thread()
def icp_points(
    source: ArrayLike,
    target: ArrayLike,
    T_start: ArrayLike | None = None,
    max_mm: float = np.inf,
    keep: float = 1.0,
    tolerance_mm2: float = 1e-6,
    iterations: int = 500,
) -> FineRegistration:
    """Point-to-point ICP, steps 1-4 of section 3.4.

    Args:
        source: points (N, 3) to be moved.
        target: points (M, 3) they are to meet.
        T_start: first guess of T_target_source, identity when left out.
        max_mm: pairs farther apart are not used.
        keep: share of the closest pairs that is used (trimming for partial overlap); 1 as in the paper.
        tolerance_mm2: the paper's tau: stop when the mean squared distance falls by less.
        iterations: most iterations.

    Raises:
        DegenerateError: fewer than three pairs are left.
    """
    from scipy.spatial import cKDTree

    source, target = check_points(source, "source points", 3), check_points(target, "target points", 3)
    transform = np.eye(4) if T_start is None else check_rigid(T_start, "T_start")
    if not 0 < keep <= 1:
        raise InputError(f"keep is {keep}; it is a share above 0 and at most 1")
    tree = cKDTree(target)
    errors: list[float] = []
    converged = False
    while len(errors) < iterations and not converged:
        distances, indices = tree.query(move_points(transform, source))
        used = distances <= max_mm
        if keep < 1 and used.any():
            used &= distances <= np.quantile(distances[used], keep)
        if used.sum() < 3:
            raise DegenerateError(
                f"only {int(used.sum())} pairs of points within {max_mm:.3g} mm; start closer or allow more"
            )
        fit = fit_rigid(source[used], target[indices[used]])
        transform = fit.T_target_source
        errors.append(fit.rms_mm**2)
        converged = len(errors) > 1 and errors[-2] - errors[-1] < tolerance_mm2
    moved = move_points(transform, source[used])
    centre = moved.mean(axis=0)
    jacobian = motion_columns(moved - centre)
    information = np.einsum("nij,nik->jk", jacobian, jacobian)
    covariance = pose_covariance(information, 3 * int(used.sum()), np.sqrt(errors[-1] / 3))
    return FineRegistration(
        transform, float(np.sqrt(errors[-1])), float(used.mean()), len(errors), converged, centre, information,
        covariance, np.array(errors),
    )  # fmt: skip


def icp_generalised(
    source: ArrayLike,
    target: ArrayLike,
    T_start: ArrayLike | None = None,
    max_mm: float = 1.0,
    neighbours: int = 20,
    threads: int = 1,
) -> FineRegistration:
    """Generalised ICP (plane to plane) by small_gicp; ``rms_mm`` is the root mean squared Mahalanobis distance.

    Raises:
        MissingExtraError: small_gicp is not installed.
    """
    with extra("gicp"):
        import small_gicp

    source, target = check_points(source, "source points", 12), check_points(target, "target points", 12)
    transform = np.eye(4) if T_start is None else check_rigid(T_start, "T_start")
    clouds = []
    for points in (target, source):
        cloud = small_gicp.PointCloud(points)
        small_gicp.estimate_covariances(cloud, num_neighbors=neighbours, num_threads=threads)
        clouds.append(cloud)
    result = small_gicp.align(
        clouds[0], clouds[1], small_gicp.KdTree(clouds[0], num_threads=threads), transform,
        registration_type="GICP", max_correspondence_distance=max_mm, num_threads=threads,
    )  # fmt: skip
    if result.num_inliers < 12:
        raise DegenerateError(f"only {result.num_inliers} points of the scans meet within {max_mm:.3g} mm")
    error = 2 * result.error / result.num_inliers
    # small_gicp moves the source: rotation first, then translation, in its frame; ours is translation, then rotation
    # about the centre
    back = result.T_target_source[:3, :3].T
    change = np.block([[np.zeros((3, 3)), back], [back, skew(source.mean(axis=0)) @ back]])
    information = change.T @ result.H @ change
    return FineRegistration(
        result.T_target_source, float(np.sqrt(error)), result.num_inliers / len(source), int(result.iterations),
        bool(result.converged), move_points(result.T_target_source, source.mean(axis=0)), information,
        pose_covariance(information, result.num_inliers, 1.0), np.array([error]),
    )  # fmt: skip


def pose_covariance(information: Floats, number: float, sigma: float) -> Floats:
    """Covariance (6, 6) of a pose from the information of ``number`` residuals of standard deviation ``sigma``; NaN
    where they do not hold every motion."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(scale, scale)
    if number > 6 and np.linalg.cond(scaled) < 1e12:
        return np.asarray(sigma**2 * number / (number - 6) * np.linalg.inv(scaled) / np.outer(scale, scale))
    return np.full((6, 6), np.nan)
