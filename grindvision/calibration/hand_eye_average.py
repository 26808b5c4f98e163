"""A hand-eye fit to poses averaged over what the errors of arm and camera may be.

Nine poses do not say which of several kinds of errors they have: errors of the place, of the arm's rotation or of the
camera's explain the residuals almost alike, and each asks for other weights. So the camera is not taken by the
likeliest kind but by all of them, each with its probability given the residuals, and its covariance is that of the
whole mixture. Small changes of the data then move the camera by little, and what is not known of the errors is part of
what is said.

Some kinds have errors of the arm's rotation that poses near each other share: an arm's wrong lengths and zeros make
errors that change with its joint angles as sines do. Such errors do not average out over poses close together.

A point has no rotation of its own, so that its residuals say less of the kinds. Its camera stays the one of least
squares, with the covariance that this one has over all kinds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.calibration.hand_eye_noise import arm_columns, components
from grindvision.geometry import rigid
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Angles (rad) over which errors of the arm's rotation resemble each other: none; one radian, as a sine of one joint
#: does; half of it, where the joint turns twice as far as the flange.
LENGTHS_RAD = (0.0, 0.5, 1.0)

#: Sizes that are tried in units of the error of the place: of the rotations, times the distance from the flange to the
#: target; of the camera's error along its axis. A smaller one cannot be told from none, a larger one from it alone.
ARM, CAMERA, DEPTH = np.geomspace(1 / 16, 32, 10), np.geomspace(1 / 32, 16, 7), np.array([0.0, 2.0])

#: A pose of less weight does not fit the others.
LOST_WEIGHT = 0.1

#: Shared errors are sums of independent ones, fewer than poses: parts of their variance below this are left out.
LEFT_OUT = 1e-6


@by_content
@dataclass(frozen=True)
class Averaged:
    """Change (K,) of X and Y, as ``fit`` counts them, that the mixture asks for, and its covariance (K, K); ``shared``:
    the probability that the arm's errors are shared by poses near each other."""

    change: Floats
    covariance: Floats
    shared: float


@by_content
@dataclass(frozen=True)
class Linear:
    """A linearised fit: residuals (N, 6), their derivatives (N, 6, 12), the columns (N, 6, 3) of the arm's errors, and
    white covariances (2, N, 3, 3) of place and of depth; weights (N,); angles between the poses (N, N) in rad. Of a
    point, which has no rotation: (N, 3), (N, 3, 9) and (N, 3, 3), and ``solution`` (9, N, 3): the change of X and Y
    that least squares makes of unit residuals."""

    rows: Floats
    J: Floats
    arm: Floats
    white: Floats
    weights: Floats
    apart_rad: Floats
    lever_mm: float
    solution: Floats | None = None


def linear(
    carrier: Floats, target: Floats, X: Floats, on_arm: bool, rows: Floats, J: Floats, weights: Floats
) -> Linear:
    """Gather what ``average`` needs of poses (N, 4, 4), the target (N, 3) or (N, 4, 4), and the residuals at X."""
    solution: Floats | None = None
    if target.ndim == 2:
        target, J = np.array([rigid(translation_mm=point) for point in target]), J[..., :9]
        root = np.sqrt(weights)[:, None]
        solution = np.asarray(np.linalg.pinv((root[..., None] * J).reshape(-1, 9)).reshape(9, *rows.shape) * root)
        # weights that fall with the residuals make these look smaller than they are: who fits counts in full
        weights = np.where(weights >= LOST_WEIGHT, 1.0, weights)
    arm = arm_columns(carrier, target, X, on_arm)
    lever_mm = float(np.median(np.linalg.norm(arm[:, :3], axis=(1, 2)))) / np.sqrt(2)
    quaternions = Rotation.from_matrix(carrier[:, :3, :3]).as_quat()
    apart = 2 * np.arccos(np.clip(np.abs(quaternions @ quaternions.T), 0.0, 1.0))
    white = components(carrier, target, X, on_arm)[:2, :, :3, :3]
    weights = np.maximum(weights, 1e-6)
    return Linear(rows, J, arm[:, : rows.shape[1]], white, weights, apart, max(lever_mm, 1.0), solution)


def average(fit: Linear) -> Averaged:
    """The change of X and Y in the mean of all kinds of errors, each weighted by its restricted likelihood.

    The common size of the errors is integrated out, so that few poses have the wide tails of Student's distribution.
    """
    parts = [_family(fit, length) for length in LENGTHS_RAD]
    log_likelihood, change, covariance = (np.concatenate(one) for one in zip(*parts, strict=True))
    probability = np.exp(log_likelihood - log_likelihood.max())
    probability /= probability.sum()
    mean = probability @ change
    spread = change - mean
    total = np.einsum("g,gij->ij", probability, covariance) + (probability[:, None] * spread).T @ spread
    return Averaged(mean, total, float(probability[len(parts[0][0]) :].sum()))


def _family(fit: Linear, length_rad: float) -> tuple[Floats, Floats, Floats]:
    """Log-likelihoods (G,), changes (G, K) and covariances (G, K, K) of the kinds with one way in which poses share
    errors of the arm: all sizes of these, of the camera's and of the depth's.

    The arm's errors are M unknowns with a prior. Only their size differs between kinds, so that their part of the
    normal equations is diagonalised once, and what they leave of the others' follows for every size.
    """
    errors = _errors(fit, length_rad)
    known = np.concatenate([fit.rows[..., None], fit.J], axis=2) * np.sqrt(fit.weights)[:, None, None]
    grams, logs = _grams(fit, np.concatenate([known, errors], axis=2))
    count = known.shape[2]
    values, vectors = np.linalg.eigh(grams[:, count:, count:])
    cross = grams[:, :count, count:] @ vectors
    variances = (ARM[:, None, None] / fit.lever_mm) ** 2
    grown = 1 + variances * np.maximum(values, 0.0)
    left = grams[:, :count, :count] - (cross * (variances / grown)[:, :, None]) @ cross.swapaxes(1, 2)
    freedom = fit.rows.shape[1] * fit.weights.sum() - fit.J.shape[2]
    log_likelihood, change, covariance, variance = _solved(left, logs + np.log(grown).sum(axis=2), freedom)
    if fit.solution is not None:
        plain = _of_least_squares(fit, fit.solution, _errors(replace(fit, weights=np.ones(len(fit.rows))), length_rad))
        change, covariance = np.zeros_like(change), variance[..., None, None] * plain
    unknowns = fit.J.shape[2]
    return log_likelihood.ravel(), change.reshape(-1, unknowns), covariance.reshape(-1, unknowns, unknowns)


def _errors(fit: Linear, length_rad: float) -> Floats:
    """What unit errors of the arm do to the residuals (N, S, M): of every pose for itself without a length."""
    count, size = fit.rows.shape
    if length_rad == 0:
        return np.einsum("nia,nk->nika", fit.arm, np.eye(count)).reshape(count, size, -1)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * (fit.apart_rad / length_rad) ** 2))
    kept = values > LEFT_OUT * values[-1]
    shared = vectors[:, kept] * np.sqrt(values[kept] * fit.weights[:, None])
    return np.einsum("nia,nk->nika", fit.arm, shared).reshape(count, size, -1)


def _grams(fit: Linear, columns: Floats) -> tuple[Floats, Floats]:
    """Products (P, M, M) of columns (N, S, M) in units of every size of depth and camera, and the logs (P,) of the
    determinants of their covariances."""
    grams, logs = [], []
    for depth in DEPTH:
        root = np.linalg.cholesky(fit.white[0] + depth**2 * fit.white[1])
        whitened = np.linalg.solve(root, columns[:, :3]).reshape(-1, columns.shape[2])
        grams.append(whitened.T @ whitened)
        logs.append(2 * float(np.log(np.einsum("nii->ni", root)).sum()))
    if fit.solution is not None:
        return np.array(grams), np.array(logs)
    turned = columns[:, 3:].reshape(-1, columns.shape[2])
    camera = np.tile(CAMERA / fit.lever_mm, len(DEPTH))
    places = np.repeat(grams, len(CAMERA), axis=0)
    return (
        places + (turned.T @ turned) / camera[:, None, None] ** 2,
        np.repeat(logs, len(CAMERA)) + 2 * len(turned) * np.log(camera),
    )


def _of_least_squares(fit: Linear, solution: Floats, errors: Floats) -> Floats:
    """Covariances (sizes of the arm's errors, of depth, K, K), in units of the place's, of what least squares gives."""
    place, depth = np.einsum("ani,knij,bnj->kab", solution, fit.white, solution, optimize=True)
    white = place + DEPTH[:, None, None] ** 2 * depth
    arm = np.einsum("ani,nik->ak", solution, errors)
    return white + (ARM[:, None, None, None] / fit.lever_mm) ** 2 * (arm @ arm.T)


def _solved(grams: Floats, logs: Floats, freedom: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Log-likelihoods (...), changes (..., K), covariances (..., K, K) and the place's variances (...) from products
    (..., 1 + K, 1 + K) of residuals and J."""
    normal, right = grams[..., 1:, 1:], grams[..., 1:, 0]
    inverted = np.linalg.inv(normal)
    found = np.einsum("...ij,...j->...i", inverted, right)
    left = np.maximum(grams[..., 0, 0] - np.einsum("...i,...i->...", right, found), 1e-300)
    log_likelihood = -0.5 * (logs + np.linalg.slogdet(normal)[1] + freedom * np.log(left))
    variance = left / max(freedom - 2, 1.0)
    return log_likelihood, -found, variance[..., None, None] * inverted, variance
