"""A hand-eye fit to poses averaged over what the errors of arm and camera may be.

Nine poses do not say which of several kinds of errors they have: errors of the place, of the arm's rotation or of the
camera's explain the residuals almost alike, and each asks for other weights. So the camera is not taken by the
likeliest kind but by all of them, each with its probability given the residuals, and its covariance is that of the
whole mixture. Small changes of the data then move the camera by little, and what is not known of the errors is part of
what is said.

Some kinds have errors of the arm's rotation that poses near each other share: an arm's wrong lengths and zeros make
errors that change with its joint angles as sines do. Such errors do not average out over poses close together.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.calibration.hand_eye_noise import arm_columns, components
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Angles (rad) over which errors of the arm's rotation resemble each other: none; one radian, as a sine of one joint
#: does; half of it, where the joint turns twice as far as the flange.
LENGTHS_RAD = (0.0, 0.5, 1.0)

#: Sizes that are tried in units of the error of the place: of the rotations, times the distance from the flange to the
#: target; of the camera's error along its axis. A smaller one cannot be told from none, a larger one from it alone.
ARM, CAMERA, DEPTH = np.geomspace(1 / 16, 32, 10), np.geomspace(1 / 32, 16, 7), np.array([0.0, 2.0])

#: Shared errors are sums of independent ones, fewer than poses: parts of their variance below this are left out.
LEFT_OUT = 1e-6


@by_content
@dataclass(frozen=True)
class Averaged:
    """Change (12,) of X and Y, as ``fit`` counts them, that the mixture asks for, and its covariance (12, 12);
    ``shared``: the probability that the arm's errors are shared by poses near each other."""

    change: Floats
    covariance: Floats
    shared: float


@by_content
@dataclass(frozen=True)
class Linear:
    """A linearised fit: residuals (N, 6), their derivatives (N, 6, 12), the columns (N, 6, 3) of the arm's errors, and
    white covariances (2, N, 6, 6) of place and of depth; weights (N,); angles between the poses (N, N) in rad."""

    rows: Floats
    J: Floats
    arm: Floats
    white: Floats
    weights: Floats
    apart_rad: Floats
    lever_mm: float


def linear(
    carrier: Floats, target: Floats, X: Floats, on_arm: bool, rows: Floats, J: Floats, weights: Floats
) -> Linear:
    """Gather what ``average`` needs of poses (N, 4, 4), the target's (N, 4, 4) and the linearised residuals at X."""
    arm = arm_columns(carrier, target, X, on_arm)
    lever_mm = float(np.median(np.linalg.norm(arm[:, :3], axis=(1, 2)))) / np.sqrt(2)
    quaternions = Rotation.from_matrix(carrier[:, :3, :3]).as_quat()
    apart = 2 * np.arccos(np.clip(np.abs(quaternions @ quaternions.T), 0.0, 1.0))
    white = components(carrier, target, X, on_arm)[:2]
    return Linear(rows, J, arm, white, np.maximum(weights, 1e-6), apart, max(lever_mm, 1.0))


def average(fit: Linear) -> Averaged:
    """The change of X and Y in the mean of all kinds of errors, each weighted by its restricted likelihood.

    The common size of the errors is integrated out, so that few poses have the wide tails of Student's distribution.
    """
    parts = [
        _of_kind(fit, length, depth, camera)
        for length, depth, camera in product(LENGTHS_RAD, DEPTH, CAMERA / fit.lever_mm)
    ]
    log_likelihood, change, covariance = (np.concatenate(one) for one in zip(*parts, strict=True))
    probability = np.exp(log_likelihood - log_likelihood.max())
    probability /= probability.sum()
    mean = probability @ change
    spread = change - mean
    total = np.einsum("g,gij->ij", probability, covariance) + (probability[:, None] * spread).T @ spread
    alone = len(probability) // len(LENGTHS_RAD)
    return Averaged(mean, total, float(probability[alone:].sum()))


def _of_kind(fit: Linear, length_rad: float, depth: float, camera: float) -> tuple[Floats, Floats, Floats]:
    """Log-likelihoods (S,), changes (S, 12) and covariances (S, 12, 12) for the sizes ``ARM`` of the arm's errors.

    Errors shared between poses are unknowns with a prior (S of them beside the 12), so the matrices stay small.
    """
    count, root = len(fit.rows), np.sqrt(fit.weights)
    covariance = fit.white[0] + depth**2 * fit.white[1]
    covariance[:, 3:, 3:] += camera**2 * np.eye(3)
    sizes = ARM / fit.lever_mm
    known = np.concatenate([fit.rows[..., None], fit.J], axis=2)
    freedom = 6 * fit.weights.sum() - 12
    if length_rad == 0:
        alone = covariance + sizes[:, None, None, None] ** 2 * (fit.arm @ fit.arm.swapaxes(1, 2))
        pairs = [_gram(one, known * root[:, None, None]) for one in alone]
        return _solved(np.array([one for one, _ in pairs]), np.array([log for _, log in pairs]), freedom)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * (fit.apart_rad / length_rad) ** 2))
    kept = values > LEFT_OUT * values[-1]
    shared = vectors[:, kept] * np.sqrt(values[kept])
    columns = np.einsum("nia,nk->nika", fit.arm, shared).reshape(count, 6, -1)
    gram, log = _gram(covariance, np.concatenate([known, columns], axis=2) * root[:, None, None])
    scale = np.ones((len(sizes), len(gram)))
    scale[:, 13:] = sizes[:, None]
    grams = scale[:, :, None] * gram * scale[:, None, :]
    grams[:, np.arange(13, len(gram)), np.arange(13, len(gram))] += 1
    return _solved(grams, np.full(len(sizes), log), freedom)


def _gram(covariance: Floats, columns: Floats) -> tuple[Floats, float]:
    """Products of columns (N, 6, K) in units of their covariances (N, 6, 6), and the log of its determinant."""
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, columns).reshape(-1, columns.shape[2])
    return whitened.T @ whitened, 2 * float(np.log(np.einsum("nii->ni", root)).sum())


def _solved(grams: Floats, logs: Floats, freedom: float) -> tuple[Floats, Floats, Floats]:
    """Log-likelihoods, changes and covariances from the products (S, K, K) of residuals, J and shared errors."""
    normal, right = grams[:, 1:, 1:], grams[:, 1:, 0]
    inverted = np.linalg.inv(normal)
    found = np.einsum("sij,sj->si", inverted, right)
    left = np.maximum(grams[:, 0, 0] - np.einsum("si,si->s", right, found), 1e-300)
    log_likelihood = -0.5 * (logs + np.linalg.slogdet(normal)[1] + freedom * np.log(left))
    variance = left / max(freedom - 2, 1.0)
    return log_likelihood, -found[:, :12], variance[:, None, None] * inverted[:, :12, :12]
