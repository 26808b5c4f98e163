"""Exercises to chapter 09, what limits accuracy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def _unit_cubes(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats]]:
    return [(rng.random((16, 4)), low, low + rng.uniform(0.5, 30, 4)) for low in rng.uniform(-5, 40, (3, 4))]


def scaled(shares: Floats, low: Floats, high: Floats) -> Floats:
    """From the unit cube to the ranges."""
    return low + shares * (high - low)


def _jobs(rng: np.random.Generator) -> list[tuple[Floats, Floats, float, int]]:
    cases = []
    for depth, passes in ((0.25, 3), (0.25, 12), (0.5, 2), (0.1, 18)):
        true = rng.uniform(0.8, 1.8, 12)
        cases.append((true, true + rng.normal(0, 0.15, 12), depth, passes))
    return cases


def left_over(true: Floats, found: Floats, depth: float, passes: int) -> Floats:
    """Never deeper than the height that vision found."""
    return true - np.minimum(passes * depth, found)


def _wheels(rng: np.random.Generator) -> list[tuple[float, float]]:
    return [(float(radius), float(h)) for radius, h in rng.uniform([2, 0.1], [80, 1.0], (5, 2))]


def _designs(rng: np.random.Generator) -> list[tuple[Floats, Floats, int]]:
    cases = []
    for column in (0, 1, 2):
        x = rng.uniform(-1, 1, (64, 3))
        y = 0.5 + 0.8 * x[:, 0] + 0.7 * x[:, 1] ** 2 + 0.2 * x[:, 2] + rng.normal(0, 0.2, 64)
        cases.append((x, y, column))
    return cases


def _unexplained(terms: list[Floats], y: Floats) -> float:
    X = np.column_stack(terms)
    return float(((y - X @ np.linalg.lstsq(X, y, rcond=None)[0]) ** 2).sum())


def _terms(x: Floats, columns: list[int], powers: tuple[int, ...] = (1, 2)) -> list[Floats]:
    return [np.ones(len(x)), *(x[:, column] ** power for column in columns for power in powers)]


def share(x: Floats, y: Floats, column: int, powers: tuple[int, ...] = (1, 2)) -> float:
    """What the model loses without one parameter, as a share of the variance."""
    everything = list(range(x.shape[1]))
    others = [other for other in everything if other != column]
    lost = _unexplained(_terms(x, others, powers), y) - _unexplained(_terms(x, everything, powers), y)
    return lost / float(((y - y.mean()) ** 2).sum())


EXERCISES = (
    Exercise(
        "09-1",
        "From the unit cube to parameters",
        scaled,
        _unit_cubes,
        (
            Mistake(
                "low end left out",
                "A share of 0 must give the low end of the range.",
                lambda shares, low, high: shares * (high - low),
            ),
            Mistake(
                "width of the range left out",
                "A share of 1 must give the high end of the range, not more.",
                lambda shares, low, high: low + shares * high,
            ),
            Mistake(
                "ends exchanged",
                "A share of 0 gives the high end in your function.",
                lambda shares, low, high: high - shares * (high - low),
            ),
            Mistake(
                "one range for all parameters",
                "Each column has a range of its own.",
                lambda shares, low, high: low[0] + shares * (high[0] - low[0]),
            ),
            Mistake(
                "scaled to the smallest and largest share drawn",
                "The design's points need not touch the ends. You stretch them until they do.",
                lambda shares, low, high: scaled((shares - shares.min(axis=0)) / np.ptp(shares, axis=0), low, high),
            ),
        ),
    ),
    Exercise(
        "09-2",
        "What the wheel leaves",
        left_over,
        _jobs,
        (
            Mistake(
                "found height forgotten",
                "The wheel never goes deeper than the height that vision found, however many passes it makes.",
                lambda true, found, depth, passes: true - passes * depth,
            ),
            Mistake(
                "gouge hidden",
                "Below zero the wheel has cut into the good surface. Your result does not show it.",
                lambda true, found, depth, passes: np.maximum(left_over(true, found, depth, passes), 0),
            ),
            Mistake(
                "measured from the found height",
                "What is left over is left of the true bead. The found height only limits the cut.",
                lambda true, found, depth, passes: found - np.minimum(passes * depth, found),
            ),
            Mistake(
                "the larger of the two limits",
                "Two limits hold for the cut, and both must be kept.",
                lambda true, found, depth, passes: true - np.maximum(passes * depth, found),
            ),
            Mistake(
                "limited by the true height",
                "The machine does not know the true height. Which height stops it?",
                lambda true, found, depth, passes: true - np.minimum(passes * depth, true),
            ),
            Mistake(
                "one pass only",
                "The depth of cut is that of one pass.",
                lambda true, found, depth, passes: true - np.minimum(depth, found),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "09-3",
        "How far apart may path points be?",
        lambda radius, allowed: float(np.sqrt(8 * radius * allowed)),
        _wheels,
        (
            Mistake(
                "half the chord",
                "The chord is off most in its middle; from there to an end is half of what is asked for.",
                lambda radius, allowed: float(np.sqrt(2 * radius * allowed)),
            ),
            Mistake(
                "diameter for radius",
                "The rule takes the radius of curvature.",
                lambda radius, allowed: float(np.sqrt(16 * radius * allowed)),
            ),
            Mistake(
                "root missing",
                "Your result is in mm squared.",
                lambda radius, allowed: float(8 * radius * allowed),
            ),
            Mistake(
                "proportional to the allowed error",
                "Twice the points make a quarter of the error. What does half the error allow?",
                lambda radius, allowed: float(8 * allowed),
            ),
            Mistake(
                "solved for the wrong quantity",
                "That is how much a chord of the allowed length sticks out. What is given, what is asked for?",
                lambda radius, allowed: float(allowed**2 / (8 * radius)),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "09-4",
        "What mattered?",
        share,
        _designs,
        (
            Mistake(
                "linear terms only",
                "A parameter whose middle is best has no slope at all. What else does the model hold?",
                lambda x, y, column: share(x, y, column, powers=(1,)),
            ),
            Mistake(
                "the parameter alone instead of the loss without it",
                "That is what this parameter explains when nobody else may. What does the full model lose without it?",
                lambda x, y, column: 1 - _unexplained(_terms(x, [column]), y) / float(((y - y.mean()) ** 2).sum()),
            ),
            Mistake(
                "share of what is explained",
                "The share is asked for of the whole variance, also of the part that nothing explains.",
                lambda x, y, column: _of_explained(x, y, column),
            ),
            Mistake(
                "mean not taken off the response",
                "Variance is counted from the mean. You divide by the squares of the values themselves.",
                lambda x, y, column: share(x, y, column) * float(((y - y.mean()) ** 2).sum() / (y**2).sum()),
            ),
            Mistake(
                "constant term missing",
                "Your models must pass through zero where all parameters are zero. Does the response?",
                lambda x, y, column: _without_constant(x, y, column),
            ),
            Mistake(
                "not divided by the variance",
                "Your result has the unit of the response squared. A share has none.",
                lambda x, y, column: share(x, y, column) * float(((y - y.mean()) ** 2).sum()),
            ),
        ),
    ),
)


def _of_explained(x: Floats, y: Floats, column: int) -> float:
    everything = _unexplained(_terms(x, list(range(x.shape[1]))), y)
    whole = float(((y - y.mean()) ** 2).sum())
    return share(x, y, column) * whole / (whole - everything)


def _without_constant(x: Floats, y: Floats, column: int) -> float:
    everything = list(range(x.shape[1]))
    others = [other for other in everything if other != column]
    lost = _unexplained(_terms(x, others)[1:], y) - _unexplained(_terms(x, everything)[1:], y)
    return lost / float(((y - y.mean()) ** 2).sum())
