"""Exercises to chapter 08, compound error."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision_book.exercises.cases import units
from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def _paths(rng: np.random.Generator) -> list[tuple[Floats]]:
    common = rng.normal(0, 40, (1, 6, 3))
    return [(common + rng.normal(0, [0.05, 0.08, 0.03], (4, 6, 3)),) for _ in range(4)]


def widest_spread(paths: Floats) -> Floats:
    """Largest minus smallest over the orientations; the widest of all points."""
    return np.ptp(paths, axis=0).max(axis=0)


def _ridges(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats]]:
    cases = []
    for _ in range(4):
        ridge, tangents = rng.normal(0, 40, (24, 3)), units(rng, 24)
        cases.append((ridge + rng.normal(0, 0.1, (24, 3)) + tangents * rng.normal(0, 0.8, (24, 1)), ridge, tangents))
    return cases


def square_to_ridge(points: Floats, ridge: Floats, tangents: Floats) -> Floats:
    """Length of the part of the difference across the tangent."""
    off = points - ridge
    return np.linalg.norm(off - (off * tangents).sum(axis=1, keepdims=True) * tangents, axis=1)


def _budgets(rng: np.random.Generator) -> list[tuple[Floats, float]]:
    cases = []
    for floor in (0.02, 0.035, 0.01, 0.03):
        alone = np.hypot(rng.uniform(0.01, 0.08, 5), floor)
        alone[3] = 0.97 * floor
        cases.append((alone, floor))
    return cases


def summed(alone: Floats, none: float) -> float:
    """Squares, the floor once."""
    return float(np.sqrt(np.maximum(alone**2 - none**2, 0).sum() + none**2))


def _counts(rng: np.random.Generator) -> list[tuple[int, int]]:
    return [(200, 200), (196, 200), (10, 12), (58, 60), (20, 20)]


def lower_end(k: int, n: int) -> float:
    """Agresti and Coull: two successes and two failures more."""
    middle = (k + 2) / (n + 4)
    return float(middle - 1.96 * np.sqrt(middle * (1 - middle) / (n + 4)))


EXERCISES = (
    Exercise(
        "08-1",
        "The side of the squares",
        widest_spread,
        _paths,
        (
            Mistake(
                "standard deviation for spread",
                "The paper's square encloses all four points. Does yours?",
                lambda paths: paths.std(axis=0).max(axis=0),
            ),
            Mistake(
                "spread along the path",
                "You compare the six points of one path. Which axis of the array runs over orientations?",
                lambda paths: np.ptp(paths, axis=1).max(axis=0),
            ),
            Mistake(
                "half the spread",
                "A distance from the mean is about half of a side.",
                lambda paths: np.abs(paths - paths.mean(axis=0)).max(axis=(0, 1)),
            ),
            Mistake(
                "mean over the points",
                "All six points must fit into their squares. Which of them decides?",
                lambda paths: np.ptp(paths, axis=0).mean(axis=0),
            ),
            Mistake(
                "distance from the first orientation",
                "D1 is one of four. Two others may lie on opposite sides of it.",
                lambda paths: np.abs(paths - paths[0]).max(axis=(0, 1)),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "08-2",
        "Square to the ridge",
        square_to_ridge,
        _ridges,
        (
            Mistake(
                "whole distance",
                "Where along the bead a point lies does not matter here. Which part of the difference is that?",
                lambda points, ridge, tangents: np.linalg.norm(points - ridge, axis=1),
            ),
            Mistake(
                "the part along the ridge",
                "You kept what was to be left out.",
                lambda points, ridge, tangents: np.abs(((points - ridge) * tangents).sum(axis=1)),
            ),
            Mistake(
                "absolute parts subtracted from each other",
                "The parts along and across are the legs of a right triangle, not pieces of one line.",
                lambda points, ridge, tangents: (
                    np.linalg.norm(points - ridge, axis=1) - np.abs(((points - ridge) * tangents).sum(axis=1))
                ),
            ),
            Mistake(
                "square for a length",
                "Your result is in mm squared.",
                lambda points, ridge, tangents: square_to_ridge(points, ridge, tangents) ** 2,
            ),
            Mistake(
                "sign of the part along",
                "Taking the part along the ridge off must make the difference shorter. Yours got longer.",
                lambda points, ridge, tangents: _wrong_way(points, ridge, tangents),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "08-3",
        "Adding up an error budget",
        summed,
        _budgets,
        (
            Mistake(
                "errors added instead of their squares",
                "Independent errors add as squares: two of 3 and 4 make 5.",
                lambda alone, none: float(np.maximum(alone - none, 0).sum() + none),
            ),
            Mistake(
                "what is left with no source counted in every bar",
                "Each single bar holds the floor that stays when all sources are off. How often may it count?",
                lambda alone, none: float(np.sqrt((alone**2).sum())),
            ),
            Mistake(
                "floor left out",
                "Switch all sources off: your sum is zero, the measured one is not.",
                lambda alone, none: float(np.sqrt(np.maximum(alone**2 - none**2, 0).sum())),
            ),
            Mistake(
                "root missing",
                "Your result is in mm squared.",
                lambda alone, none: summed(alone, none) ** 2,
            ),
            Mistake(
                "negative share",
                "By chance a source alone may come out below the floor. Can a source take error away?",
                lambda alone, none: float(np.sqrt((alone**2 - none**2).sum() + none**2)),
            ),
            Mistake(
                "mean of the squares",
                "A budget is a sum. What would five equal sources make of your result?",
                lambda alone, none: float(np.sqrt(np.maximum(alone**2 - none**2, 0).mean() + none**2)),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "08-4",
        "How sure is a share?",
        lower_end,
        _counts,
        (
            Mistake(
                "the plain share as the middle of the interval",
                "With 200 of 200 your interval has no width: are you certain that the next cell passes?",
                lambda k, n: _with(k, n),
            ),
            Mistake(
                "one standard deviation for 95 %",
                "68 % of the time is not 95 %.",
                lambda k, n: float((k + 2) / (n + 4) - (1 / 1.96) * ((k + 2) / (n + 4) - lower_end(k, n))),
            ),
            Mistake(
                "upper end",
                "That is the end on the other side.",
                lambda k, n: float(2 * (k + 2) / (n + 4) - lower_end(k, n)),
            ),
            Mistake(
                "root missing",
                "p (1 - p) / n is a variance. What is added to a share?",
                lambda k, n: float((k + 2) / (n + 4) * (1 - 1.96 * (1 - (k + 2) / (n + 4)) / (n + 4))),
            ),
            Mistake(
                "failures left out",
                "You add two cells that pass. Which other two does the rule add?",
                lambda k, n: _with(k + 2, n + 2),
            ),
        ),
    ),
)


def _wrong_way(points: Floats, ridge: Floats, tangents: Floats) -> Floats:
    off = points - ridge
    return np.linalg.norm(off + (off * tangents).sum(axis=1, keepdims=True) * tangents, axis=1)


def _with(k: float, n: float) -> float:
    return float(k / n - 1.96 * np.sqrt(k / n * (1 - k / n) / n))
