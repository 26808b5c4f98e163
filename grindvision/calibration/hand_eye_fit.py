"""One least squares on the group for hand-eye calibration: the camera's place and the target's, from a start."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.calibration.hand_eye_average import average, linear
from grindvision.calibration.hand_eye_noise import components, estimate
from grindvision.geometry import mean_rigid, move_points, nearest_rotation, rigid, rotation_about, skew
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Distance (mm) at which an error of rotation counts as one of place, until their sizes are known.
LEVER_MM = 100.0

#: Steps to the mean over the kinds of errors: it is linear but for rotations of a degree or two.
AVERAGED = 2

#: Steps in which the sizes of the errors are estimated.
ESTIMATED = range(3, 10)


@by_content
@dataclass(frozen=True)
class HandEyeFit:
    """``X`` and ``Y`` (4, 4) with what they leave: ``place`` (N, 3) mm, ``rotation`` (N, 3) rad (NaN for points).

    ``sizes`` (4,): variances of ``hand_eye_noise.components``; None where they were not estimated. ``shared``: see
    ``hand_eye_average.Averaged``; NaN where it was not found.
    """

    X: Floats
    Y: Floats
    place: Floats
    rotation: Floats
    weights: Floats
    covariance: Floats
    cost: float
    sizes: Floats | None = None
    shared: float = np.nan


@by_content
@dataclass(frozen=True)
class FitOptions:
    """Settings of ``fit``: ``robust`` weights poses down and ``noise`` estimates the sizes of the errors of poses;
    ``keep`` (N,) are fixed weights and ``sizes`` (4,) fixed variances. ``on_arm``: see ``components``."""

    on_arm: bool = True
    robust: bool = False
    noise: bool = False
    iterations: int = 40
    keep: Floats | None = None
    sizes: Floats | None = None


def fit(carrier: Floats, target: Floats, start: Floats, options: FitOptions) -> HandEyeFit:
    """Gauss-Newton on X and Y of C_i X p_i = Y from a start for X; see ``hand_eye``."""
    X, Y = start.copy(), _place_of_target(carrier, target, start)
    columns = slice(0, 9) if target.ndim == 2 else slice(0, 12)
    weights = np.ones(len(carrier)) if options.keep is None else options.keep
    sizes = options.sizes
    for step in range(options.iterations):
        rows, J = _linearised(carrier, target, X, Y)
        if target.ndim == 3 and options.noise and step in ESTIMATED:
            made = components(carrier, target, X, options.on_arm)
            sizes = estimate(rows, J, made, weights, sizes)
        rows, J = _whitened(carrier, target, X, rows, J, replace(options, sizes=sizes))
        if options.robust and options.keep is None:
            weights = _weights(np.linalg.norm(rows, axis=1), columns.stop)
        root = np.sqrt(weights)
        A = (root[:, None, None] * J)[..., columns].reshape(-1, columns.stop)
        change = np.zeros(12)
        change[columns] = np.linalg.lstsq(A, -(root[:, None] * rows).ravel(), rcond=1e-10)[0]
        X, Y = _moved(X, change[:6]), _moved(Y, change[6:])
        settled = np.abs(change[[0, 1, 2, 6, 7, 8]]).max() < 1e-7 and np.abs(change[[3, 4, 5, 9, 10, 11]]).max() < 1e-10
        if settled and (not options.noise or step >= ESTIMATED.stop):
            break
    place, turn = residuals(carrier, target, X, Y)
    rows, _ = _whitened(carrier, target, X, *_linearised(carrier, target, X, Y), replace(options, sizes=sizes))
    left = float((weights[:, None] * rows**2).sum())
    free = max(weights.sum() * rows.shape[1] - columns.stop, 1.0)
    covariance = np.linalg.pinv(A.T @ A, hermitian=True)[:6, :6] * left / free
    return HandEyeFit(X, Y, place, turn, weights, covariance, left, sizes)


def averaged(carrier: Floats, target: Floats, found: HandEyeFit, on_arm: bool) -> HandEyeFit:
    """A fit taken on to the mean over what its errors may be, see ``hand_eye_average``; of a point, its covariance.

    The target's place is then the mean of where the poses put it: errors that all poses share cannot be told from it.
    """
    X, Y = found.X, found.Y
    for _ in range(AVERAGED):
        rows, J = _linearised(carrier, target, X, Y)
        mixed = average(linear(carrier, target, X, on_arm, rows, J, found.weights))
        if target.ndim == 2:
            return replace(found, covariance=mixed.covariance[:6, :6], shared=mixed.shared)
        X, Y = _moved(X, mixed.change[:6]), _moved(Y, mixed.change[6:])
    seen, weights = carrier @ X @ target, found.weights / found.weights.sum()
    Y = rigid(nearest_rotation(np.tensordot(weights, seen[:, :3, :3], 1)), weights @ seen[:, :3, 3])
    place, turn = residuals(carrier, target, X, Y)
    covariance = mixed.covariance[:6, :6]
    return replace(found, X=X, Y=Y, place=place, rotation=turn, covariance=covariance, shared=mixed.shared)


def residuals(carrier: Floats, target: Floats, X: Floats, Y: Floats) -> tuple[Floats, Floats]:
    """Place (N, 3) in mm and rotation (N, 3) in rad of C_i X p_i against Y."""
    if target.ndim == 2:
        camera = target @ X[:3, :3].T + X[:3, 3]
        place = np.einsum("nij,nj->ni", carrier[:, :3, :3], camera) + carrier[:, :3, 3] - Y[:3, 3]
        return place, np.full_like(place, np.nan)
    seen = carrier @ X @ target
    turn = Rotation.from_matrix(seen[:, :3, :3] @ Y[:3, :3].T).as_rotvec()
    return seen[:, :3, 3] - Y[:3, 3], turn


def weighted_jacobian(
    carrier: Floats, target: Floats, X: Floats, Y: Floats, weights: Floats, options: FitOptions
) -> Floats:
    """Derivatives (K, 9) of points' residuals, (K, 12) of poses', by X and Y as ``fit`` weights them."""
    _, J = _whitened(carrier, target, X, *_linearised(carrier, target, X, Y), options)
    columns = 9 if target.ndim == 2 else 12
    return (np.sqrt(weights)[:, None, None] * J)[..., :columns].reshape(-1, columns)


def left_out_mm(carrier: Floats, target: Floats, found: HandEyeFit, on_arm: bool) -> Floats:
    """How far off (N,), mm, each pose puts the target by the place of camera and target that the others give.

    For poses of a target it is one step of the least squares, from the fit to all, without the pose's part of the
    normal equations. A point tells the camera's rotation poorly, so that one pose less may turn it far: it is fitted.
    """
    if target.ndim == 2:
        return np.array([_left_out(carrier, target, found, row, on_arm) for row in range(len(carrier))])
    options = FitOptions(on_arm, sizes=found.sizes)
    rows, J = _whitened(carrier, target, found.X, *_linearised(carrier, target, found.X, found.Y), options)
    weighted = np.maximum(found.weights, 1e-9)[:, None, None] * J
    normal = weighted.swapaxes(1, 2) @ J
    right = np.einsum("nik,ni->nk", weighted, rows)
    inverted = np.linalg.pinv(normal.sum(axis=0) - normal, hermitian=True)
    changes = -np.einsum("nij,nj->ni", inverted, right.sum(axis=0) - right)
    left = np.empty(len(carrier))
    for row, change in enumerate(changes):
        X, Y = _moved(found.X, change[:6]), _moved(found.Y, change[6:])
        left[row] = np.linalg.norm(residuals(carrier[row : row + 1], target[row : row + 1], X, Y)[0])
    return left


def _left_out(carrier: Floats, target: Floats, found: HandEyeFit, row: int, on_arm: bool) -> float:
    keep = np.maximum(found.weights, 1e-9)
    keep[row] = 0.0
    left = fit(carrier, target, found.X, FitOptions(on_arm, iterations=8, keep=keep, sizes=found.sizes))
    return float(np.linalg.norm(left.place[row]))


def _linearised(carrier: Floats, target: Floats, X: Floats, Y: Floats) -> tuple[Floats, Floats]:
    """Residuals (N, 3 or 6) and their derivatives (N, ., 12) by X (translation, rotation, parent frame) and Y alike."""
    rotation = carrier[:, :3, :3]
    points = target.ndim == 2
    place, turn = residuals(carrier, target, X, Y)
    J = np.zeros((len(carrier), 6, 12))
    J[:, :3, :3] = rotation
    J[:, :3, 3:6] = -rotation @ skew((target if points else target[:, :3, 3]) @ X[:3, :3].T)
    J[:, :3, 6:9] = -np.eye(3)
    J[:, 3:, 3:6] = rotation
    J[:, 3:, 9:] = -np.eye(3)
    return (place, J[:, :3]) if points else (np.concatenate([place, turn], axis=1), J)


def _whitened(
    carrier: Floats, target: Floats, X: Floats, rows: Floats, J: Floats, options: FitOptions
) -> tuple[Floats, Floats]:
    """Residuals and derivatives in units of their errors: mm for points, and for poses whose errors are not known."""
    if target.ndim == 2:
        return rows, J
    if options.sizes is None:
        scale = np.repeat([1.0, LEVER_MM], 3)
        return rows * scale, J * scale[:, None]
    covariance = np.einsum("k,knij->nij", options.sizes, components(carrier, target, X, options.on_arm))
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, np.concatenate([rows[..., None], J], axis=2)).astype(np.float64)
    return whitened[..., 0], whitened[..., 1:]


def _weights(sizes: Floats, unknowns: int) -> Floats:
    """Tukey's weights (N,) by a scale from the median; the floor keeps exact data from weighting rounding.

    The fit takes up a part of the errors, of few points a large one: so much larger they were.
    """
    taken_up = min(unknowns / (3 * len(sizes)), 0.5) if unknowns == 9 else 0.0
    scale = max(float(np.median(sizes)) / 1.54 / np.sqrt(1 - taken_up), 1e-6)
    return np.clip(1 - (sizes / (6.0 * scale)) ** 2, 0.0, 1.0) ** 2


def _moved(transform: Floats, change: Floats) -> Floats:
    """A transform whose translation moves by change[:3] and whose rotation turns by change[3:], parent frame."""
    size = float(np.linalg.norm(change[3:]))
    turn = rotation_about(change[3:], size) if size > 0 else np.eye(3)
    return rigid(nearest_rotation(turn @ transform[:3, :3]), transform[:3, 3] + change[:3])


def _place_of_target(carrier: Floats, target: Floats, X: Floats) -> Floats:
    if target.ndim == 2:
        places = [move_points(pose @ X, point) for pose, point in zip(carrier, target, strict=True)]
        return rigid(translation_mm=np.median(places, axis=0))
    return mean_rigid(carrier @ X @ target)
