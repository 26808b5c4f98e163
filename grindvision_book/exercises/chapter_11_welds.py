"""Exercises to chapter 11 on what a shop asks for: the weave, and beads in a groove."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def _weaves(rng: np.random.Generator) -> list[tuple[Floats, float, float]]:
    return [(np.sort(rng.uniform(0, 60, 40)), float(rng.uniform(2, 8)), float(rng.uniform(3, 9))) for _ in range(4)]


def weave_offset(along_mm: Floats, width_mm: float, swing_mm: float) -> Floats:
    """Half the width times the sine of a whole turn per swing."""
    return width_mm / 2 * np.sin(2 * np.pi * along_mm / swing_mm)


def _grooves(rng: np.random.Generator) -> list[tuple[float, float, float]]:
    cases = []
    for width, depth, share in rng.uniform([8, 5, 0.1], [20, 15, 0.9], (5, 3)):
        cases.append((float(width), float(depth), float(share * width * depth / 2)))
    return cases


def filled_height(width_mm: float, depth_mm: float, area_mm2: float) -> float:
    """Similar triangles: areas go with the square of the height."""
    return float(depth_mm * np.sqrt(area_mm2 / (width_mm * depth_mm / 2)))


WELD_EXERCISES = (
    Exercise(
        "11-6",
        "The weave",
        weave_offset,
        _weaves,
        (
            Mistake(
                "width taken for the amplitude",
                "From toe to toe is from the lowest to the highest value. How far is the tip from the middle then?",
                lambda along, width, swing: 2 * weave_offset(along, width, swing),
            ),
            Mistake(
                "starts at a toe",
                "Put the length 0 into your function: the swing starts in the middle of the seam.",
                lambda along, width, swing: width / 2 * np.cos(2 * np.pi * along / swing),
            ),
            Mistake(
                "half a turn per swing",
                "One swing goes to both sides and back to the middle: by which angle has the sine gone on?",
                lambda along, width, swing: width / 2 * np.sin(np.pi * along / swing),
            ),
            Mistake(
                "towards the other side",
                "The first quarter of a swing goes to positive values.",
                lambda along, width, swing: -weave_offset(along, width, swing),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "11-7",
        "How high a bead fills a V",
        filled_height,
        _grooves,
        (
            Mistake(
                "height in proportion to the area",
                "Near the root the V is narrow: does the first half of the area reach only half the depth?",
                lambda width, depth, area: depth * area / (width * depth / 2),
            ),
            Mistake(
                "area of a rectangle",
                "What is the area of a triangle with this width and this depth?",
                lambda width, depth, area: depth * np.sqrt(area / (width * depth)),
            ),
            Mistake(
                "area over the whole width",
                "The bead lies between walls that come together; it is not as wide as the edges everywhere.",
                lambda width, depth, area: area / width,
            ),
            Mistake(
                "depth under the edges",
                "From where is the height counted: from the root, or from the surface down?",
                lambda width, depth, area: depth - filled_height(width, depth, area),
            ),
        ),
        unit="mm",
    ),
)
