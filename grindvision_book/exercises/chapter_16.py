"""Exercises to chapter 16, grinding it away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def _maps(rng: np.random.Generator) -> list[tuple[Floats, Floats, float]]:
    cases = []
    for spacing in (0.25, 0.5, 1.0):
        heights = np.maximum(rng.normal(0.2, 0.6, (20, 12)), 0.0)
        heights[rng.random((20, 12)) < 0.1] = np.nan
        cases.append((heights, rng.uniform(0.7, 1.0, (20, 12)), spacing))
    return cases


def volume(heights: Floats, cosines: Floats, spacing: float) -> float:
    """Heights along the normals times the area of the ground that each node stands for."""
    return float(np.nansum(heights * spacing**2 / cosines))


def _processes(rng: np.random.Generator) -> list[tuple[float, float, float, float, float]]:
    low, high = [1e-5, 10, 10, 2, 0.05], [5e-5, 60, 40, 10, 0.5]
    return [(float(k), float(f), float(v), float(w), float(d)) for k, f, v, w, d in rng.uniform(low, high, (5, 5))]


def feed(k: float, force: float, speed: float, width: float, depth: float) -> float:
    """Preston's equation, solved for the feed in mm/s; the speed comes in m/s."""
    return k * force * 1000 * speed / (width * depth)


def _passes(rng: np.random.Generator) -> list[tuple[Floats, Floats, float, float]]:
    cases = []
    for factor in (0.5, 0.7, 0.9):
        before = rng.uniform(0.0, 1.5, 200)
        planned, floor = 0.4, 0.3
        after = np.where(before > floor, np.maximum(before - factor * planned, floor), before)
        cases.append((before, after + rng.normal(0, 0.005, 200), planned, floor))
    return cases


def factor_of(before: Floats, after: Floats, planned: float, floor: float) -> float:
    """Median of what was taken off where the floor did not end the cut, over what was planned."""
    free = after > floor + 0.05
    return float(np.median((before - after)[free]) / planned)


EXERCISES = (
    Exercise(
        "16-1",
        "The volume of a height map",
        volume,
        _maps,
        (
            Mistake(
                "slope left out",
                "A node of a sloped ground stands for more area than the square between the nodes.",
                lambda heights, cosines, spacing: float(np.nansum(heights) * spacing**2),
            ),
            Mistake(
                "slope the wrong way round",
                "The steeper the ground, the larger its area over the same square.",
                lambda heights, cosines, spacing: float(np.nansum(heights * cosines) * spacing**2),
            ),
            Mistake(
                "spacing for area",
                "Your result is not in mm cubed.",
                lambda heights, cosines, spacing: float(np.nansum(heights / cosines) * spacing),
            ),
            Mistake(
                "holes make all of it unknown",
                "Some nodes are not shown. What is the sum of anything and NaN?",
                lambda heights, cosines, spacing: float(np.sum(heights * spacing**2 / cosines)),
            ),
            Mistake(
                "mean height times the whole area",
                "The nodes that are not shown have no height, and no area in the sum either.",
                lambda heights, cosines, spacing: float(np.nanmean(heights) * (spacing**2 / cosines).sum()),
            ),
        ),
        unit="mm^3",
    ),
    Exercise(
        "16-2",
        "The feed that a depth asks for",
        feed,
        _processes,
        (
            Mistake(
                "metres per second left as they are",
                "k is in mm2/N and the feed in mm/s: in which unit is the wheel's speed given?",
                lambda k, force, speed, width, depth: feed(k, force, speed, width, depth) / 1000,
            ),
            Mistake(
                "width left out",
                "A wider contact shares the same force.",
                lambda k, force, speed, width, depth: feed(k, force, speed, 1.0, depth),
            ),
            Mistake(
                "width on the wrong side",
                "A wider contact has less pressure, so it must go slower.",
                lambda k, force, speed, width, depth: k * force * 1000 * speed * width / depth,
            ),
            Mistake(
                "depth on the wrong side",
                "To cut deeper the wheel must stay longer.",
                lambda k, force, speed, width, depth: k * force * 1000 * speed * depth / width,
            ),
            Mistake(
                "solved for the time",
                "That is the time for a millimetre of the way. What is asked for?",
                lambda k, force, speed, width, depth: 1 / feed(k, force, speed, width, depth),
            ),
        ),
        unit="mm/s",
    ),
    Exercise(
        "16-3",
        "The coefficient from two maps",
        factor_of,
        _passes,
        (
            Mistake(
                "nodes at the floor counted",
                "Where the wheel's path ended the cut, what was taken off says nothing of the process.",
                lambda before, after, planned, floor: float(np.median((before - after)[before > floor]) / planned),
            ),
            Mistake(
                "all nodes counted",
                "Some nodes were below the floor before the pass: nothing was taken off there.",
                lambda before, after, planned, floor: float(np.median(before - after) / planned),
            ),
            Mistake(
                "upside down",
                "A process that takes off half of what is planned has a factor of one half.",
                lambda before, after, planned, floor: 1 / factor_of(before, after, planned, floor),
            ),
            Mistake(
                "not divided by what was planned",
                "Your result is a depth in mm. The factor has no unit.",
                lambda before, after, planned, floor: factor_of(before, after, planned, floor) * planned,
            ),
            Mistake(
                "ratio of the heights",
                "The process sets how much goes, not which share of the height stays.",
                lambda before, after, planned, floor: float(np.median((after / before)[after > floor + 0.05])),
            ),
        ),
    ),
)
