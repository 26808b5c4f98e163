"""Exercises to chapter 12, your own scans and arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision import geometry
from grindvision_book.exercises.cases import clouds, poses
from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]

_MM_PER_UNIT = (1.0, 25.4, 1000.0)


def _files(rng: np.random.Generator) -> list[tuple[Floats, float]]:
    cases = []
    for mm_per_unit, size_mm, off in ((1.0, 200.0, 1.1), (1000.0, 200.0, 1.2), (25.4, 90.0, 0.9), (25.4, 400.0, 1.3)):
        shape = rng.uniform(0, 1, (80, 3)) * [1.0, 0.7, 0.2]
        shape *= size_mm * off / np.ptp(shape[:, 0])
        cases.append(((shape + [900, -200, 700]) / mm_per_unit, size_mm))
    return cases


def mm_per_unit(points: Floats, size_mm: float) -> float:
    """The unit whose size comes nearest, by ratio."""
    return _nearest(size_mm, float(np.ptp(points, axis=0).max()))


def _nearest(size_mm: float, extent: float, units: tuple[float, ...] = _MM_PER_UNIT, by_ratio: bool = True) -> float:
    misses = [abs(np.log(unit * extent / size_mm)) if by_ratio else abs(size_mm - extent / unit) for unit in units]
    return units[int(np.argmin(misses))]


def spacing(points: Floats) -> float:
    """Median distance to the nearest other point."""
    return float(np.median(_second_nearest(points)))


def _second_nearest(points: Floats) -> Floats:
    return cKDTree(points).query(points, k=2)[0][:, 1]


def _spots(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats]]:
    cases = []
    for pose in poses(rng, 4):
        scanned = rng.normal(0, 60, (3, 3)) + [0, 0, 400]
        cases.append((pose, scanned, geometry.move_points(pose, scanned) + rng.normal(0, 0.3, (3, 3))))
    return cases


def largest_miss(T_base_scanner: Floats, scanned: Floats, touched: Floats) -> float:
    """Largest distance after moving the spots of the scan."""
    return float(_misses(T_base_scanner, scanned, touched).max())


def _misses(T_base_scanner: Floats, scanned: Floats, touched: Floats) -> Floats:
    return np.linalg.norm(geometry.move_points(T_base_scanner, scanned) - touched, axis=1)


EXERCISES = (
    Exercise(
        "12-1",
        "Which unit is this file in?",
        mm_per_unit,
        _files,
        (
            Mistake(
                "largest coordinate for size",
                "The part may lie a metre away from the frame's origin. Its size is a difference of coordinates.",
                lambda points, size: _nearest(size, float(np.abs(points).max())),
            ),
            Mistake(
                "inverse factor",
                "What must the file's numbers be multiplied by to become millimetres?",
                lambda points, size: 1 / mm_per_unit(points, size),
            ),
            Mistake(
                "inches forgotten",
                "Three units are asked for.",
                lambda points, size: _nearest(size, float(np.ptp(points, axis=0).max()), (1.0, 1000.0)),
            ),
            Mistake(
                "multiplied where it should be divided",
                "A part of 200 mm is 0.2 in a file in metres: which way does your factor turn the one into the other?",
                lambda points, size: _nearest(size, float(np.ptp(points, axis=0).max()), by_ratio=False),
            ),
        ),
    ),
    Exercise(
        "12-2",
        "The spacing of a scan",
        spacing,
        lambda rng: [(cloud,) for cloud in clouds(rng, 4, 120, [20.0, 15.0, 0.5])],
        (
            Mistake(
                "each point its own neighbour",
                "The nearest point of a cloud to one of its points is that point itself, at distance zero.",
                lambda points: 0.0,
            ),
            Mistake(
                "mean for median",
                "A few strays, far from all others, would decide your spacing.",
                lambda points: float(_second_nearest(points).mean()),
            ),
            Mistake(
                "distance to the next row of the file",
                "Rows of a file are in any order. Which point lies nearest in space?",
                lambda points: float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1))),
            ),
            Mistake(
                "squared distance",
                "Your result is in mm squared.",
                lambda points: float(np.median(_second_nearest(points) ** 2)),
            ),
            Mistake(
                "smallest distance",
                "Two points that happen to lie close say nothing of the rest.",
                lambda points: float(_second_nearest(points).min()),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "12-3",
        "Three spots before the robot moves",
        largest_miss,
        _spots,
        (
            Mistake(
                "inverse transform: the wrong frame direction",
                "T_base_scanner is for points told in the scanner's frame. Which of your lists is?",
                lambda T, scanned, touched: largest_miss(geometry.inverse(T), scanned, touched),
            ),
            Mistake(
                "transposed rotation",
                "With points in rows the product stands on the other side. Compare R @ p with p @ R.",
                lambda T, scanned, touched: largest_miss(geometry.rigid(T[:3, :3].T, T[:3, 3]), scanned, touched),
            ),
            Mistake(
                "shift in metres",
                "The pose's shift is in mm already.",
                lambda T, scanned, touched: largest_miss(geometry.rigid(T[:3, :3], T[:3, 3] / 1000), scanned, touched),
            ),
            Mistake(
                "frames not brought together",
                "You compare numbers of two frames.",
                lambda T, scanned, touched: float(np.linalg.norm(scanned - touched, axis=1).max()),
            ),
            Mistake(
                "mean for the largest",
                "One spot that misses is enough not to start. Which number shows it?",
                lambda T, scanned, touched: float(_misses(T, scanned, touched).mean()),
            ),
            Mistake(
                "largest coordinate for the largest distance",
                "How far apart two points are is one length, not three numbers.",
                lambda T, scanned, touched: float(np.abs(geometry.move_points(T, scanned) - touched).max()),
            ),
        ),
        unit="mm",
    ),
)
