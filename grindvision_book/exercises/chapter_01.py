"""Exercises to chapter 01, scanning a part."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.vision.surface.voxel_grid import voxel_grid
from grindvision_book.exercises.cases import clouds
from grindvision_book.exercises.checking import Exercise, Function, Mistake

Floats = NDArray[np.float64]


def _pixels(rng: np.random.Generator) -> list[tuple[float, ...]]:
    columns, rows = rng.uniform(0, 1280, 6), rng.uniform(0, 1024, 6)
    return [
        (float(column), float(row), float(disparity), 2400.0, 640.0, 512.0, 100.0)
        for column, row, disparity in zip(columns, rows, rng.uniform(500, 700, 6), strict=True)
    ]


def point_of(column: float, row: float, disparity: float, f: float, c_column: float, c_row: float, b: float) -> Floats:
    """Similar triangles."""
    z = f * b / disparity
    return np.array([(column - c_column) * z / f, (row - c_row) * z / f, z])


def _distances(rng: np.random.Generator) -> list[tuple[float, ...]]:
    return [(float(z), 2400.0, 100.0, float(s)) for z, s in rng.uniform([300, 0.02], [800, 0.2], (5, 2))]


def _around_the_origin(rng: np.random.Generator) -> list[tuple[Floats, float]]:
    return [
        (cloud - cloud.mean(axis=0), size)
        for cloud, size in zip(clouds(rng, 3, 150, 3.0), (1.5, 2.0, 4.0), strict=True)
    ]


def centroids(points: Floats, size_mm: float) -> Floats:
    """PCL's lattice."""
    return voxel_grid(points, size_mm).centroids


def _of_cells(points: Floats, cells: Floats, merge: Function) -> Floats:
    return np.array([merge(points[(cells == cell).all(axis=1)]) for cell in np.unique(cells, axis=0)])


def _floor(points: Floats, size_mm: float) -> Floats:
    return np.floor(points / size_mm)


def _in_order(points: object) -> Floats:
    points = np.atleast_2d(np.asarray(points, dtype=float))
    return points[np.lexsort(np.round(points, 6).T)]


def _budgets(rng: np.random.Generator) -> list[tuple[float, float, int]]:
    return [(float(w), float(s), int(n)) for w, s, n in rng.uniform([0.02, 0.001, 20], [0.06, 0.02, 400], (6, 3))]


EXERCISES = (
    Exercise(
        "01-1",
        "A point from a pixel",
        point_of,
        _pixels,
        (
            Mistake(
                "distance along the ray taken for depth",
                "The formula gives z, the depth along the camera's axis. How long is the ray to that depth, compared "
                "with z?",
                lambda *case: _ray(*case) * case[3] * case[6] / case[2],
            ),
            Mistake(
                "principal point left out",
                "Pixels are counted from a corner of the image, rays from the optical axis.",
                lambda u, v, d, f, cu, cv, b: point_of(u, v, d, f, 0.0, 0.0, b),
            ),
            Mistake(
                "row and column exchanged",
                "Which of the two runs along x, which along y?",
                lambda *case: point_of(*case)[[1, 0, 2]],
            ),
            Mistake(
                "sign of the ray",
                "A column to the right of the axis lies on the side of positive x. What do you subtract from what?",
                lambda *case: point_of(*case) * [-1, -1, 1],
            ),
            Mistake(
                "baseline left out",
                "In your formula the unit of the depth is px / px. What makes it millimetres?",
                lambda u, v, d, f, cu, cv, b: point_of(u, v, d, f, cu, cv, 1.0),
            ),
            Mistake(
                "disparity and focal length exchanged",
                "Does a larger disparity mean nearer or farther?",
                lambda u, v, d, f, cu, cv, b: point_of(u, v, f * f / d, f, cu, cv, b),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "01-2",
        "Depth noise and distance",
        lambda z, f, b, s: z**2 * s / (f * b),
        _distances,
        (
            Mistake(
                "noise proportional to the distance",
                "Take the slope of z = f b / d once more, and write d by z again: to which power does z stand there?",
                lambda z, f, b, s: z * s / f,
            ),
            Mistake(
                "noise of the disparity ratio",
                "Check the units: px / px is no length. How does an error of the disparity become one of z?",
                lambda z, f, b, s: s * z / (f * b),
            ),
            Mistake(
                "baseline left out",
                "A scanner with twice the baseline is twice as good. Is yours?",
                lambda z, f, b, s: z**2 * s / f,
            ),
            Mistake(
                "variance for standard deviation",
                "Your result is in mm squared.",
                lambda z, f, b, s: (z**2 * s / (f * b)) ** 2,
            ),
            Mistake(
                "slope left out",
                "That is how z changes per pixel. Where does the disparity noise come in?",
                lambda z, f, b, s: z**2 / (f * b),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "01-3",
        "Voxel grid (Eqs 1-2)",
        centroids,
        _around_the_origin,
        (
            Mistake(
                "cell centres for centroids",
                "Eq 2 takes the mean of the points in a cell, not the middle of the cell.",
                lambda points, size: size * (np.unique(_floor(points, size), axis=0) + 0.5),
            ),
            Mistake(
                "truncated toward zero instead of floor",
                "What do int(-0.3) and floor(-0.3) give? How wide is your cell about zero?",
                lambda points, size: _of_cells(points, np.trunc(points / size), _mean),
            ),
            Mistake(
                "rounded instead of floor",
                "Your lattice is moved by half a cell. Where does the cell number change?",
                lambda points, size: _of_cells(points, np.round(points / size), _mean),
            ),
            Mistake(
                "lattice in the cloud's corner",
                "One point more at the rim and all your cells move. Where is this lattice's corner asked to be?",
                lambda points, size: _of_cells(points, _floor(points - points.min(axis=0), size), _mean),
            ),
            Mistake(
                "one point of each cell",
                "You keep one of the points of a cell. Which do you lose, and with them what?",
                lambda points, size: _of_cells(points, _floor(points, size), lambda inside: inside[0]),
            ),
            Mistake(
                "median for mean",
                "Eq 2 is a mean. A median by coordinates also depends on the axes of the frame.",
                lambda points, size: _of_cells(points, _floor(points, size), lambda inside: np.median(inside, axis=0)),
            ),
        ),
        unit="mm",
        arranged=_in_order,
    ),
    Exercise(
        "01-4",
        "What averages out",
        lambda white, shared, n: np.sqrt(white**2 / n + shared**2),
        _budgets,
        (
            Mistake(
                "the shared error averaged too",
                "All points carry the same shared error. What is the mean of n equal numbers?",
                lambda white, shared, n: np.sqrt((white**2 + shared**2) / n),
            ),
            Mistake(
                "divided by n instead of its root",
                "The variance of a mean falls with n. The standard deviation?",
                lambda white, shared, n: np.sqrt((white / n) ** 2 + shared**2),
            ),
            Mistake(
                "standard deviations added",
                "Independent errors add as the legs of a right triangle. What is added, then?",
                lambda white, shared, n: white / np.sqrt(n) + shared,
            ),
            Mistake(
                "the white noise not averaged",
                "Nothing in your result falls with the number of points.",
                lambda white, shared, n: np.hypot(white, shared),
            ),
            Mistake(
                "the shared error left out",
                "With a million points yours would be zero. No scanner measures that well.",
                lambda white, shared, n: white / np.sqrt(n),
            ),
            Mistake(
                "variance for standard deviation",
                "Your result is in mm squared.",
                lambda white, shared, n: white**2 / n + shared**2,
            ),
        ),
        unit="mm",
    ),
)


def _ray(column: float, row: float, disparity: float, f: float, c_column: float, c_row: float, b: float) -> Floats:
    ray = np.array([column - c_column, row - c_row, f])
    return ray / np.linalg.norm(ray)


def _mean(points: Floats) -> Floats:
    return points.mean(axis=0)
