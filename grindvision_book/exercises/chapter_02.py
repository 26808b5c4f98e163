"""Exercises to chapter 02, how well does it measure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision import geometry
from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def _patch(rng: np.random.Generator, T_scanner_bench: Floats, height_mm: float, points: int = 60) -> Floats:
    """A noisy patch, parallel to the bench, off the bench's origin."""
    flat = np.column_stack([rng.uniform([-60, -20], [80, 30], (points, 2)), rng.normal(height_mm, 0.02, points)])
    return geometry.move_points(T_scanner_bench, flat)


def _benches(rng: np.random.Generator) -> list[Floats]:
    tilts = rng.uniform(0.15, 0.5, 5)
    return [
        geometry.rigid(geometry.rotation_about([*rng.normal(size=2), 0], np.pi + tilt), [*rng.normal(0, 30, 2), 400])
        for tilt in tilts
    ]


def _steps(rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    return [(_patch(rng, bench, 0.0), _patch(rng, bench, 30.4)) for bench in _benches(rng)]


def step_height(bench: Floats, top: Floats) -> float:
    """Distance of the top's middle from the bench's plane."""
    return float(abs(geometry.fit_plane(bench).distance([top.mean(axis=0)])[0]))


def _uncentred_normal(points: Floats) -> Floats:
    return np.linalg.svd(points)[2][2]


def _distance(normal: Floats, bench: Floats, top: Floats) -> float:
    return float(abs(normal @ (top.mean(axis=0) - bench.mean(axis=0))))


def _vertical(bench: Floats, top: Floats) -> float:
    a, b, c = np.linalg.lstsq(np.column_stack([bench[:, :2], np.ones(len(bench))]), bench[:, 2], rcond=None)[0]
    x, y, z = top.mean(axis=0)
    return float(abs(z - (a * x + b * y + c)))


def normal_towards_scanner(points: Floats) -> Floats:
    """Least variance, facing the origin."""
    fit = geometry.fit_plane(points)
    return -np.sign(fit.normal @ fit.centre_mm) * fit.normal


def _facing(points: Floats, normal: Floats) -> Floats:
    return -np.sign(normal @ points.mean(axis=0)) * normal


def _residuals(rng: np.random.Generator) -> list[tuple[Floats]]:
    cases = []
    for centre in (0.02, -0.05, 0.4):
        errors = rng.normal(centre, 0.03, 81)
        errors[:8] += rng.uniform(0.5, 30, 8)
        cases.append((errors,))
    return cases


def robust_std(residuals: Floats) -> float:
    """1.4826 times the median absolute deviation."""
    return float(1.4826 * np.median(np.abs(residuals - np.median(residuals))))


def _tables(rng: np.random.Generator) -> list[tuple[Floats, float]]:
    errors = [rng.normal(0, 0.03, (60, 1)) * 0.5 + rng.normal(0, 0.025, (60, 5)) for _ in range(4)]
    return [(table, limit) for table, limit in zip(errors, (0.0277, 0.02, 0.024, 0.017), strict=True)]


def share_below(errors_mm: Floats, printed_mm: float) -> float:
    """Share of rows."""
    return float(np.mean(np.abs(errors_mm).mean(axis=1) < printed_mm))


EXERCISES = (
    Exercise(
        "02-1",
        "The normal of a plane, towards the scanner",
        normal_towards_scanner,
        lambda rng: [(_patch(rng, bench, 0.0),) for bench in _benches(rng)],
        (
            Mistake(
                "centroid not subtracted",
                "Without its centroid a cloud 400 mm away is mainly long along the line to it. Which plane passes "
                "through the origin?",
                lambda points: _facing(points, _uncentred_normal(points)),
            ),
            Mistake(
                "largest singular value instead of the smallest",
                "You return the direction in which the points spread most. In which do they spread least?",
                lambda points: _facing(points, np.linalg.svd(points - points.mean(axis=0))[2][0]),
            ),
            Mistake(
                "column instead of row of V^T",
                "numpy.linalg.svd returns V transposed. Where do the directions stand in it?",
                lambda points: _facing(points, np.linalg.svd(points - points.mean(axis=0))[2][:, 2]),
            ),
            Mistake(
                "sign of the normal: away from the scanner",
                "The scanner sits in the origin. Take the scalar product of your normal and a point of the plane.",
                lambda points: -normal_towards_scanner(points),
            ),
            Mistake(
                "vertical distances instead of perpendicular ones",
                "z = a x + b y + c measures along z. On a tilted bench with noise that is another plane.",
                lambda points: _facing(points, _slope_normal(points)),
            ),
        ),
        tolerance=1e-7,
    ),
    Exercise(
        "02-2",
        "The height of a step",
        step_height,
        _steps,
        (
            Mistake(
                "difference of the mean depths",
                "On a bench that is tilted against the scanner the step does not run along z.",
                lambda bench, top: float(abs(top[:, 2].mean() - bench[:, 2].mean())),
            ),
            Mistake(
                "distance of the centroids",
                "The top's middle does not lie above the bench's. Which part of the difference counts?",
                lambda bench, top: float(np.linalg.norm(top.mean(axis=0) - bench.mean(axis=0))),
            ),
            Mistake(
                "centroid not subtracted in the plane's fit",
                "Your bench passes through the scanner. What has to be taken off the points before the SVD?",
                lambda bench, top: _distance(_uncentred_normal(bench), bench, top),
            ),
            Mistake(
                "measured along z from the fitted plane",
                "The plane is right, the direction is not: the distance from a plane runs along its normal.",
                _vertical,
            ),
            Mistake(
                "two planes, two offsets",
                "Two fits are never quite parallel, and their offsets hold at the origin, 400 mm away.",
                lambda bench, top: float(abs(_offset(top) - _offset(bench))),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "02-3",
        "A spread that strays cannot spoil",
        robust_std,
        _residuals,
        (
            Mistake(
                "plain standard deviation",
                "Eight mixed pixels, 30 mm away, decide your result. Which mean would they not move?",
                lambda residuals: float(residuals.std()),
            ),
            Mistake(
                "sample standard deviation",
                "Dividing by n - 1 does not help against strays. Which mean would they not move?",
                lambda residuals: float(residuals.std(ddof=1)),
            ),
            Mistake(
                "factor 1.4826 left out",
                "Half of a normal distribution lies within 0.6745 standard deviations of its middle.",
                lambda residuals: robust_std(residuals) / 1.4826,
            ),
            Mistake(
                "deviations from zero instead of from the median",
                "The residuals need not lie about zero. About what do you measure their deviations?",
                lambda residuals: float(1.4826 * np.median(np.abs(residuals))),
            ),
            Mistake(
                "mean for median",
                "One of your two middles is a mean, and strays drag a mean along.",
                lambda residuals: float(1.4826 * np.median(np.abs(residuals - residuals.mean()))),
            ),
            Mistake(
                "mean of the deviations",
                "Your deviations are measured well, but then averaged: the strays are back.",
                lambda residuals: float(1.4826 * np.mean(np.abs(residuals - np.median(residuals)))),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "02-4",
        "Where does the printed number lie?",
        share_below,
        _tables,
        (
            Mistake(
                "signs kept",
                "Errors of different sign cancel in your mean. The paper averages absolute values.",
                lambda errors, printed: float(np.mean(errors.mean(axis=1) < printed)),
            ),
            Mistake(
                "absolute value of the mean",
                "First the absolute value, then the mean, or first the mean?",
                lambda errors, printed: float(np.mean(np.abs(errors.mean(axis=1)) < printed)),
            ),
            Mistake(
                "rms for mean absolute error",
                "A root of mean squares is never smaller than the mean of absolute values. Which does the paper print?",
                lambda errors, printed: float(np.mean(np.sqrt((errors**2).mean(axis=1)) < printed)),
            ),
            Mistake(
                "single errors counted instead of instruments",
                "One instrument gives one number, the mean over its five positions. What do you count?",
                lambda errors, printed: float(np.mean(np.abs(errors) < printed)),
            ),
            Mistake(
                "averaged over the instruments",
                "Which axis of the table runs over positions, which over instruments?",
                lambda errors, printed: float(np.mean(np.abs(errors).mean(axis=0) < printed)),
            ),
            Mistake(
                "share above instead of below",
                "You count the instruments that are worse than the printed number.",
                lambda errors, printed: 1 - share_below(errors, printed),
            ),
            Mistake(
                "number instead of share",
                "A share lies between 0 and 1.",
                lambda errors, printed: share_below(errors, printed) * len(errors),
            ),
        ),
    ),
)


def _slope_normal(points: Floats) -> Floats:
    a, b, _ = np.linalg.lstsq(np.column_stack([points[:, :2], np.ones(len(points))]), points[:, 2], rcond=None)[0]
    return np.array([a, b, -1.0]) / np.linalg.norm([a, b, 1.0])


def _offset(points: Floats) -> float:
    fit = geometry.fit_plane(points)
    return abs(fit.offset_mm)
