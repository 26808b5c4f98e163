"""Hand-eye calibration without a tracker: where a camera sits on an arm, or beside it, from controller poses alone.

A target that does not move is seen from N poses. With ``carrier`` poses C_i (T_base_flange of a camera on the arm,
T_flange_base of a camera beside it, the target on the flange) the unknown X = T_flange_camera (T_base_camera) obeys
C_i X p_i = Y for every pose: p_i is the target in the camera's frame, as a point (3,) or as a pose (4, 4), and Y its
place in the base (flange). Two poses give A X = X B.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.calibration.hand_eye_average import LOST_WEIGHT
from grindvision.calibration.hand_eye_fit import LEVER_MM, FitOptions, averaged, fit, left_out_mm
from grindvision.calibration.hand_eye_noise import PoseErrors
from grindvision.calibration.hand_eye_starts import rotation_rms, starts_from_points, starts_from_poses
from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import inverse
from grindvision.lazy import renamed_property
from grindvision.records import by_content

Floats = NDArray[np.float64]

MOUNTINGS = ("on-arm", "fixed")

#: Fewest poses: points give three equations a pose for nine unknowns, and one pose is wanted over; poses give six.
FEWEST_POINTS, FEWEST_POSES = 4, 3

#: The poses must turn about a second axis by so much (deg, root mean square about their mean).
MIN_SECOND_AXIS_DEG = 2.0

#: From so many poses on a wrong one can be told from the rest, and loses its weight.
ROBUST_FROM = 6


@by_content
@dataclass(frozen=True)
class HandEyeOptions:
    """Settings of ``hand_eye``: ``mounted`` ``on-arm``, the camera on the flange and the target beside the arm, or
    ``fixed``, the camera beside the arm and the target on the flange."""

    mounted: str = "on-arm"


@by_content
@dataclass(frozen=True)
class HandEye:
    """A camera's place with all that says how good it is.

    ``T_parent_camera`` (4, 4), mm: T_flange_camera on the arm, T_base_camera beside it. ``target`` (4, 4) is the
    target's pose (a point: with the identity as rotation) in the base frame (flange frame). ``covariance`` (6, 6):
    translation (mm), then rotation (rad), both along the axes of the parent frame. ``residuals_mm`` (N, 3): where a
    pose puts the target, less where it is; ``residuals_rad`` (N, 3) its rotation (NaN for points); ``left_out_mm`` (N,)
    how far off a pose puts the target when it took no part in the fit. ``weights`` (N,) in 0..1: near zero, the pose
    does not fit the others. ``starts_differ``: degrees and mm between two closed-form solutions (NaN: only one).
    ``rotation_rms_deg`` (3,): how far the poses turn about their mean along three axes, largest first.
    ``errors``: of arm and camera, from ``ROBUST_FROM`` poses of a target on; None for points. ``shared_errors``: the
    probability that poses near each other share errors of the arm.
    """

    T_parent_camera: Floats
    target: Floats
    mounted: str
    covariance: Floats
    residuals_mm: Floats
    residuals_rad: Floats
    left_out_mm: Floats
    weights: Floats
    starts_differ: tuple[float, float]
    rotation_rms_deg: Floats
    errors: PoseErrors | None = None
    shared_errors: float = np.nan

    spread_deg = renamed_property("spread_deg", "rotation_rms_deg")

    @property
    def rms_mm(self) -> float:
        """Root mean square over the poses of how far the target's places lie from their mean."""
        return float(np.sqrt((self.residuals_mm**2).sum(axis=1).mean()))

    @property
    def fitting(self) -> NDArray[np.bool_]:
        """Marks (N,) of the poses that fit the others."""
        return self.weights >= LOST_WEIGHT

    @property
    def sigma_mm(self) -> Floats:
        """Standard deviation (3,) of the camera's place along the axes of the parent frame."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def sigma_deg(self) -> Floats:
        """Standard deviation (3,) of the camera's rotation about the axes of the parent frame."""
        return np.degrees(np.sqrt(np.diag(self.covariance)[3:]))

    def __str__(self) -> str:
        n, fit = len(self.residuals_mm), self.fitting
        poses = f"{n} poses" if fit.all() else f"{fit.sum()} of {n} poses (the others do not fit)"
        size, left_out = (
            np.sqrt(np.mean(one[fit] ** 2)) for one in (np.linalg.norm(self.residuals_mm, axis=1), self.left_out_mm)
        )
        return (
            f"hand-eye from {poses}: the target's places meet within {size:.2f} mm rms, left out"
            f" {left_out:.2f} mm; camera known to +- {self.sigma_mm.max():.2f} mm,"
            f" +- {self.sigma_deg.max():.3f} deg"
        )


def carriers(T_base_flange: ArrayLike, mounted: str) -> Floats:
    """Poses (N, 4, 4) that carry the camera: as they are on the arm, inverted where the camera stands beside it.

    Raises:
        InputError: another mounting than ``MOUNTINGS``.
    """
    if mounted not in MOUNTINGS:
        raise InputError(f"mounted {mounted!r} is unknown; use {' or '.join(MOUNTINGS)}")
    poses = np.asarray(T_base_flange, dtype=float)
    return poses if mounted == "on-arm" else inverse(poses)


def hand_eye(T_base_flange: ArrayLike, target_camera: ArrayLike, options: HandEyeOptions | None = None) -> HandEye:
    """Where a camera sits on an arm or beside it, from the controller's poses and a target that rests.

    Closed forms give the starts; one least squares on the group gives the answer, with poses that do not fit the others
    weighted down from ``ROBUST_FROM`` poses on. Poses of a target are weighted by what the errors of arm and camera may
    be, and the answer is the mean over that; the covariance of either allows for all of them.

    Args:
        T_base_flange: poses (N, 4, 4) of the controller, mm.
        target_camera: the target in the camera's frame at every pose: points (N, 3) or poses (N, 4, 4), mm.
        options: how the camera is mounted.

    Returns:
        The camera's place with its covariance, and every pose's error with and without a part in the fit.

    Raises:
        InputError: shapes that do not belong together.
        DegenerateError: too few poses, or motions that leave a direction unknown; the message names it.

    Example:
        >>> import numpy as np
        >>> from grindvision import hand_eye
        >>> from grindvision.geometry import inverse, move_points, rigid, rotation_about
        >>> T_flange_camera, sphere = rigid(translation_mm=[0, 50, 80]), [500, 0, 100]
        >>> axes = np.random.default_rng(1).normal(size=(8, 3))
        >>> poses = [rigid(rotation_about(axis, 0.6), 100 * axis) for axis in axes]
        >>> seen = [move_points(inverse(pose @ T_flange_camera), sphere) for pose in poses]
        >>> np.round(hand_eye(poses, seen).T_parent_camera[:3, 3]) + 0.0
        array([ 0., 50., 80.])
    """
    mounted = (HandEyeOptions() if options is None else options).mounted
    carrier, target = _checked(T_base_flange, target_camera, mounted)
    spread, axes = rotation_rms(carrier)
    refuse_motions(spread, axes, mounted)
    points = target.ndim == 2
    starts, differ = starts_from_points(carrier, target) if points else starts_from_poses(carrier, target)
    fits = [fit(carrier, target, start, FitOptions(iterations=12)) for start in starts]
    start = min(fits, key=lambda one: one.cost)
    many = len(carrier) >= ROBUST_FROM
    on_arm = mounted == "on-arm"
    found = fit(carrier, target, start.X, FitOptions(on_arm, many, many))
    left_out = left_out_mm(carrier, target, found, on_arm)
    found = averaged(carrier, target, found, on_arm)
    return HandEye(
        found.X, found.Y, mounted, found.covariance, found.place, found.rotation, left_out, found.weights, differ,
        np.degrees(spread), None if found.sizes is None else PoseErrors(*np.sqrt(found.sizes)), found.shared,
    )  # fmt: skip


def quick_rms_mm(carrier: Floats, target: Floats) -> float:
    """What the best fit leaves of a target's places, mm rms with the unknowns counted, for comparing conventions."""
    starts, _ = starts_from_points(carrier, target) if target.ndim == 2 else starts_from_poses(carrier, target)
    fits = [fit(carrier, target, start, FitOptions(iterations=8)) for start in starts]
    best = min(fits, key=lambda one: one.cost)
    n = len(carrier)
    free = max(n - 3, 1) if target.ndim == 2 else max(n - 2, 1)
    rms = (best.place**2).sum() / free
    if target.ndim == 3:
        rms += LEVER_MM**2 * (best.rotation**2).sum() / free
    return float(np.sqrt(rms))


def refuse_motions(rms_rad: Floats, axes: Floats, mounted: str) -> None:
    """Refuse poses whose rotations (root mean squares (3,) along ``axes`` (3, 3)) leave a direction unknown.

    Raises:
        DegenerateError: names the direction.
    """
    frame = "flange" if mounted == "on-arm" else "base"
    first, second = np.degrees(rms_rad[:2])
    if first < MIN_SECOND_AXIS_DEG:
        raise DegenerateError(
            f"the poses hardly turn ({first:.2f} deg rms about their mean): the camera's translation is free in every"
            " direction; add poses that turn by 20 deg and more about two axes"
        )
    if second < MIN_SECOND_AXIS_DEG:
        axis = ", ".join(f"{value:.2f}" for value in axes[0])
        raise DegenerateError(
            f"all motions turn about one axis, ({axis}) in the {frame} frame, within {second:.2f} deg: the camera's"
            " translation along it is free; add poses that turn by 20 deg and more about another axis"
        )


def rotation_rms_of(carrier: Floats) -> Floats | None:
    """How far poses (N, 4, 4) turn, see ``rotation_rms``; None where they leave a direction unknown."""
    spread, axes = rotation_rms(carrier)
    try:
        refuse_motions(spread, axes, "on-arm")
    except DegenerateError:
        return None
    return spread


def _checked(T_base_flange: ArrayLike, target_camera: ArrayLike, mounted: str) -> tuple[Floats, Floats]:
    carrier = carriers(T_base_flange, mounted)
    target = np.asarray(target_camera, dtype=float)
    if carrier.ndim != 3 or carrier.shape[1:] != (4, 4):
        raise InputError(f"poses have shape {carrier.shape}; expected (N, 4, 4)")
    if target.shape not in ((len(carrier), 3), (len(carrier), 4, 4)):
        raise InputError(
            f"{len(carrier)} poses and targets of shape {target.shape}; expected as many points (N, 3) or poses"
            " (N, 4, 4)"
        )
    if not (np.isfinite(carrier).all() and np.isfinite(target).all()):
        raise InputError("poses or targets hold NaN or infinity; take those poses out")
    fewest = FEWEST_POINTS if target.ndim == 2 else FEWEST_POSES
    if len(carrier) < fewest:
        raise DegenerateError(
            f"{len(carrier)} poses; hand-eye needs at least {fewest}, turned about two axes, and 8 or more to find a"
            " wrong one"
        )
    return carrier, target
