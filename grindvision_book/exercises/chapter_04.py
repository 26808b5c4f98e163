"""Exercises to chapter 04, did calibration help."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision import geometry
from grindvision.calibration import error_statistics
from grindvision_book.exercises.cases import poses
from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def statistics(residuals: Floats) -> Floats:
    """Mean, rms, largest and standard deviation of the lengths."""
    found = error_statistics(residuals)
    return np.array([found.mean, found.rms, found.max, found.std])


def _of(values: Floats, ddof: int = 0) -> Floats:
    return np.array([values.mean(), np.sqrt((values**2).mean()), values.max(), values.std(ddof=ddof)])


def _systems(rng: np.random.Generator) -> list[tuple[Floats, Floats, float]]:
    cases = []
    for spectrum in ([900, 40, 2, 3e-2, 4e-7], [80, 50, 30, 4e-1, 4e-6], [5, 1, 8e-2, 1e-3, 1e-8]):
        left, right = np.linalg.qr(rng.normal(size=(20, 5)))[0], np.linalg.qr(rng.normal(size=(5, 5)))[0]
        cases.append((left * spectrum @ right.T, rng.normal(size=20), 1e-6))
    return cases


def generalised(G: Floats, H: Floats, tolerance: float) -> Floats:
    """Eq 18."""
    return np.linalg.pinv(G, rcond=tolerance) @ H


def _from_svd(G: Floats, H: Floats, least: float, change: str = "") -> Floats:
    U, s, Vt = np.linalg.svd(G, full_matrices=False)
    if change == "kept":
        return Vt.T @ ((U.T @ H) / np.where(s > least, s, s[0]))
    inverted = np.where(s > least, 1 / s, 0)
    if change == "damped":
        inverted = s / (s**2 + least**2)
    return (Vt if change == "V" else Vt.T) @ (inverted * (U.T @ H))


def _held_out(rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    return [(np.array(poses(rng, 12)), rng.normal(0, 0.06, (12, 3))) for _ in range(4)]


def in_scanner(T_base_scanner: Floats, residuals: Floats) -> Floats:
    """Directions turned back, no shift."""
    return np.einsum("mji,mj->mi", T_base_scanner[:, :3, :3], residuals)


def predicted_rms(G: Floats, covariance: Floats) -> Floats:
    """Root of the trace of G covariance G^T, pose by pose."""
    return np.sqrt(np.einsum("mik,kl,mil->m", G, covariance, G))


def _places(rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    cases = []
    for correlation in (0.0, 0.9, -0.9, 0.6):
        root = np.diag(rng.uniform(0.2, 3, 4)) @ (np.eye(4) + correlation * np.tri(4, k=-1))
        cases.append((rng.normal(0, 1, (6, 3, 4)) * np.linspace(0.1, 4, 6)[:, None, None], root @ root.T))
    return cases


def _estimates(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats]]:
    cases = []
    for true_over_stated in (1.0, 1.4, 0.7, 2.0):
        std, truth = rng.uniform(0.01, 0.2, 400), rng.normal(0, 0.3, 400)
        cases.append((truth + rng.normal(0, true_over_stated, 400) * std, truth, std))
    return cases


def coverage(values: Floats, truth: Floats, std: Floats) -> float:
    """Share within one standard deviation."""
    return float(np.mean(np.abs(values - truth) <= std))


def _budgets(rng: np.random.Generator) -> list[tuple[Floats]]:
    return [(rng.uniform(0.005, 0.08, 4),) for _ in range(4)]


EXERCISES = (
    Exercise(
        "04-1",
        "Four numbers of Figure 5",
        statistics,
        lambda rng: [(rng.normal(0.02, [0.05, 0.03, 0.02], (60, 3)),) for _ in range(4)],
        (
            Mistake(
                "coordinates instead of lengths",
                "An error is the distance of two points, one number for each row. Is yours one for each coordinate?",
                lambda residuals: _of(np.abs(residuals)),
            ),
            Mistake(
                "sample for population standard deviation",
                "The first three are right. By n or by n - 1: the paper describes these 60 errors, not a population "
                "that they are drawn from.",
                lambda residuals: _of(np.linalg.norm(residuals, axis=1), ddof=1),
            ),
            Mistake(
                "median for mean",
                "The first number is asked for as a mean.",
                lambda residuals: np.array([np.median(np.linalg.norm(residuals, axis=1)), *statistics(residuals)[1:]]),
            ),
            Mistake(
                "mean residual taken off before the lengths",
                "A mean that all residuals share is an error too, and the worst kind. Where did it go?",
                lambda residuals: statistics(residuals - residuals.mean(axis=0)),
            ),
            Mistake(
                "root missing",
                "Your lengths are squares of lengths, in mm squared.",
                lambda residuals: _of((residuals**2).sum(axis=1)),
            ),
            Mistake(
                "sum of absolute coordinates for the length",
                "Pythagoras: what is added, before the root?",
                lambda residuals: _of(np.abs(residuals).sum(axis=1)),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "04-2",
        "The generalised inverse with a tolerance (Eq 18)",
        generalised,
        _systems,
        (
            Mistake(
                "nothing cut off",
                "One combination in your result is divided by almost zero. What does the tolerance do?",
                lambda G, H, tolerance: np.linalg.pinv(G, rcond=0) @ H,
            ),
            Mistake(
                "absolute tolerance",
                "A singular value is small against the largest one, not against 1 mm.",
                lambda G, H, tolerance: _from_svd(G, H, tolerance),
            ),
            Mistake(
                "squared singular values cut",
                "G^T G squares the singular values, so your tolerance acts on squares: it cuts at its own root.",
                lambda G, H, tolerance: _from_svd(G, H, np.sqrt(tolerance) * np.linalg.norm(G, 2)),
            ),
            Mistake(
                "V transposed",
                "numpy.linalg.svd returns V transposed. Which of the two does G^+ begin with?",
                lambda G, H, tolerance: _from_svd(G, H, tolerance * np.linalg.norm(G, 2), "V"),
            ),
            Mistake(
                "small values replaced instead of left out",
                "What cannot be known gets no correction at all: what is the inverse of a value that is cut off?",
                lambda G, H, tolerance: _from_svd(G, H, tolerance * np.linalg.norm(G, 2), "kept"),
            ),
            Mistake(
                "multiplied by the transpose only",
                "G^T H has the right shape. Which values were to be divided by?",
                lambda G, H, tolerance: G.T @ H,
            ),
        ),
    ),
    Exercise(
        "04-3",
        "Where do the residuals point?",
        in_scanner,
        _held_out,
        (
            Mistake(
                "inverse transform: the wrong frame direction",
                "T_base_scanner takes directions from the scanner to the base. Yours are in the base already.",
                lambda T, residuals: np.einsum("mij,mj->mi", T[:, :3, :3], residuals),
            ),
            Mistake(
                "residuals moved like points",
                "A residual is a difference of two points: does it know where the origin is?",
                lambda T, residuals: np.array(
                    [geometry.move_points(geometry.inverse(t), r) for t, r in zip(T, residuals, strict=True)]
                ),
            ),
            Mistake(
                "one pose for all rows",
                "The scanner was turned otherwise in every row.",
                lambda T, residuals: residuals @ T[0, :3, :3],
            ),
            Mistake(
                "mean rotation",
                "The mean of rotations is no rotation, and no row was measured in it.",
                lambda T, residuals: residuals @ T[:, :3, :3].mean(axis=0),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "04-4",
        "Are the stated uncertainties honest?",
        coverage,
        _estimates,
        (
            Mistake(
                "sign kept",
                "An estimate that lies far below the truth is not within one standard deviation of it.",
                lambda values, truth, std: float(np.mean(values - truth <= std)),
            ),
            Mistake(
                "variance for standard deviation",
                "You compare a length with a square.",
                lambda values, truth, std: float(np.mean(np.abs(values - truth) <= std**2)),
            ),
            Mistake(
                "squared threshold",
                "One side of your comparison is squared, the other is not.",
                lambda values, truth, std: float(np.mean((values - truth) ** 2 <= std)),
            ),
            Mistake(
                "two standard deviations",
                "68 % belong to one standard deviation, 95 % to two.",
                lambda values, truth, std: float(np.mean(np.abs(values - truth) <= 2 * std)),
            ),
            Mistake(
                "one standard deviation for all",
                "Each number has a standard deviation of its own.",
                lambda values, truth, std: float(np.mean(np.abs(values - truth) <= std.mean())),
            ),
            Mistake(
                "share outside instead of inside",
                "You count those that miss.",
                lambda values, truth, std: 1 - coverage(values, truth, std),
            ),
        ),
    ),
    Exercise(
        "04-5",
        "The share of each error source",
        lambda rms: rms**2 / (rms**2).sum(),
        _budgets,
        (
            Mistake(
                "errors added instead of their squares",
                "Independent errors add as squares. What adds up to the whole, then?",
                lambda rms: rms / rms.sum(),
            ),
            Mistake(
                "share of the root",
                "Your shares are lengths against a length; they add up to more than one.",
                lambda rms: rms / np.sqrt((rms**2).sum()),
            ),
            Mistake(
                "compared with the largest",
                "The largest has the share one in your result. The share of what is asked for?",
                lambda rms: rms**2 / (rms**2).max(),
            ),
            Mistake(
                "percent for a share",
                "A share lies between 0 and 1.",
                lambda rms: 100 * rms**2 / (rms**2).sum(),
            ),
            Mistake(
                "not divided by the whole",
                "Those are squares in mm squared. A share has no unit.",
                lambda rms: rms**2,
            ),
        ),
    ),
    Exercise(
        "04-6",
        "The error to expect elsewhere",
        predicted_rms,
        _places,
        (
            Mistake(
                "root missing",
                "Your numbers are in mm squared.",
                lambda G, covariance: predicted_rms(G, covariance) ** 2,
            ),
            Mistake(
                "correlations left out",
                "What one correction spoils another may mend: the corners of the covariance count too.",
                lambda G, covariance: predicted_rms(G, np.diag(np.diag(covariance))),
            ),
            Mistake(
                "standard deviations added",
                "The errors of the corrections do not all push the same way at once.",
                lambda G, covariance: np.linalg.norm(np.abs(G) @ np.sqrt(np.diag(covariance)), axis=1),
            ),
            Mistake(
                "mean over the axes for their sum",
                "The length of an error has three squares in it. You took a third of them.",
                lambda G, covariance: predicted_rms(G, covariance) / np.sqrt(3),
            ),
            Mistake(
                "one error for all poses",
                "Near the spheres and far from them alike? Each pose has its own G.",
                lambda G, covariance: np.full(len(G), np.sqrt((predicted_rms(G, covariance) ** 2).mean())),
            ),
        ),
        unit="mm",
    ),
)
