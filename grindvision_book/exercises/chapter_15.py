"""Exercises to chapter 15, joints the paper does not have."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision_book.exercises.cases import units
from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def _planes(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats, Floats, Floats]]:
    cases = []
    for _ in range(5):
        first, second = units(rng, 2)
        while abs(first @ second) > 0.8:
            first, second = units(rng, 2)
        cases.append((rng.normal(0, 40, 3), first, rng.normal(0, 40, 3), second, rng.normal(0, 30, 3)))
    return cases


def root_near(
    on_first: Floats, first: Floats, on_second: Floats, second: Floats, place: Floats, cosine: float | None = None
) -> Floats:
    """Nearest point to ``place`` on both planes, each through a point and with a unit normal."""
    c = float(first @ second) if cosine is None else cosine
    to_first, to_second = (on_first - place) @ first, (on_second - place) @ second
    x, y = (to_first - c * to_second) / (1 - c * c), (to_second - c * to_first) / (1 - c * c)
    return place + x * first + y * second


def _one_after_the_other(on_first: Floats, first: Floats, on_second: Floats, second: Floats, place: Floats) -> Floats:
    foot = place + ((on_first - place) @ first) * first
    return foot + ((on_second - foot) @ second) * second


def _faces(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats, Floats]]:
    cases = []
    for turn, concave in zip(np.radians([90.0, 40.0, 130.0, 75.0, 20.0]), (1, -1, 1, -1, 1), strict=True):
        frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        reach, along = rng.uniform(8, 25, 2), rng.normal(0, 10, 2)
        # In the section: the first face is the u axis, its normal v; the second leaves at the angle of air.
        air = np.pi - concave * turn
        second = np.array([np.cos(air), np.sin(air)])
        normal = np.array([np.sin(air), -np.cos(air)])
        points = [np.array([reach[0], 0.0, along[0]]), np.array([*reach[1] * second, along[1]])]
        normals = [np.array([0.0, 1.0, 0.0]), np.array([*normal, 0.0])]
        cases.append((*(frame @ one for one in (points[0], normals[0], points[1], normals[1])),))
    return cases


def air_deg(on_first: Floats, first: Floats, on_second: Floats, second: Floats) -> float:
    """Angle of the air between two faces, 0 to 360 deg."""
    turn = np.degrees(np.arccos(np.clip(first @ second, -1, 1)))
    return float(180 - turn if (on_second - on_first) @ first > 0 else 180 + turn)


def _levels(rng: np.random.Generator) -> list[tuple[float, float, float]]:
    return [(*rng.uniform(0.02, 0.3, 2), float(turn)) for turn in (90.0, 30.0, 140.0, 60.0)]


def root_sigma_mm(first_mm: float, second_mm: float, turn_deg: float) -> float:
    """Standard deviation of the root across the seam."""
    return float(np.hypot(first_mm, second_mm) / np.sin(np.radians(turn_deg)))


def _throats(rng: np.random.Generator) -> list[tuple[float, float]]:
    return [(float(rng.uniform(2, 8)), float(air)) for air in (90.0, 60.0, 120.0, 75.0)]


def leg_mm(throat_mm: float, air_deg: float) -> float:
    """Leg of a fillet weld with equal legs."""
    return float(throat_mm / np.cos(np.radians(air_deg) / 2))


EXERCISES = (
    Exercise(
        "15-1",
        "The line where two planes meet",
        root_near,
        _planes,
        (
            Mistake(
                "planes taken for perpendicular",
                "Moving along one normal also moves you off the other plane, unless the normals are square.",
                lambda a, n, b, m, place: root_near(a, n, b, m, place, cosine=0.0),
            ),
            Mistake(
                "one plane after the other",
                "The second step leaves the first plane again. Both equations must hold at once.",
                _one_after_the_other,
            ),
            Mistake(
                "nearest to the origin",
                "The line goes on for ever: which of its points is asked for?",
                lambda a, n, b, m, place: root_near(a, n, b, m, 0 * place),
            ),
            Mistake(
                "halfway between the two points",
                "The points lie anywhere on their planes; only the planes count.",
                lambda a, n, b, m, place: (a + b) / 2,
            ),
            Mistake(
                "sign of the distances",
                "You step away from the planes. Is it the plane minus the place, or the other way round?",
                lambda a, n, b, m, place: 2 * place - root_near(a, n, b, m, place),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "15-2",
        "How much air is in a corner?",
        air_deg,
        _faces,
        (
            Mistake(
                "concave and convex exchanged",
                "In a concave corner the second face rises above the first one. How much air is then left?",
                lambda a, n, b, m: 360 - air_deg(a, n, b, m),
            ),
            Mistake(
                "angle between the normals",
                "Two faces of one plane have normals 0 deg apart, and 180 deg of air.",
                lambda a, n, b, m: float(np.degrees(np.arccos(np.clip(n @ m, -1, 1)))),
            ),
            Mistake(
                "every corner taken for concave",
                "The outside of a box has more than 180 deg of air. What tells it from the inside?",
                lambda a, n, b, m: float(180 - np.degrees(np.arccos(np.clip(n @ m, -1, 1)))),
            ),
            Mistake(
                "radians for degrees",
                "The name of the function ends in _deg.",
                lambda a, n, b, m: float(np.radians(air_deg(a, n, b, m))),
            ),
        ),
        unit="deg",
    ),
    Exercise(
        "15-3",
        "How well is a root known?",
        root_sigma_mm,
        _levels,
        (
            Mistake(
                "angle left out",
                "Two faces that are nearly one plane meet nearly anywhere.",
                lambda a, b, turn: float(np.hypot(a, b)),
            ),
            Mistake(
                "cosine for sine",
                "Square faces are the best case. What does your formula say at 90 deg?",
                lambda a, b, turn: float(np.hypot(a, b) / abs(np.cos(np.radians(turn)))),
            ),
            Mistake(
                "half the angle",
                "The equations of both planes are solved at once; their determinant is the sine of the whole turn.",
                lambda a, b, turn: float(np.hypot(a, b) / np.sin(np.radians(turn) / 2)),
            ),
            Mistake(
                "errors added instead of their squares",
                "The errors of the two faces know nothing of each other.",
                lambda a, b, turn: float((a + b) / np.sin(np.radians(turn))),
            ),
            Mistake(
                "degrees taken for radians",
                "np.sin takes radians.",
                lambda a, b, turn: float(np.hypot(a, b) / np.sin(turn)),
            ),
            Mistake(
                "variance for standard deviation",
                "The result has the unit mm.",
                lambda a, b, turn: root_sigma_mm(a, b, turn) ** 2,
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "15-4",
        "From the throat to the legs",
        leg_mm,
        _throats,
        (
            Mistake(
                "right angle always",
                "The square root of two belongs to 90 deg of air.",
                lambda throat, air: float(throat * np.sqrt(2)),
            ),
            Mistake(
                "sine for cosine",
                "In a narrow corner the throat is nearly as long as the leg.",
                lambda throat, air: float(throat / np.sin(np.radians(air) / 2)),
            ),
            Mistake(
                "whole angle",
                "The throat halves the angle between the faces.",
                lambda throat, air: float(throat / np.cos(np.radians(air))),
            ),
            Mistake(
                "leg and throat exchanged",
                "The leg is the longer one of the two.",
                lambda throat, air: float(throat * np.cos(np.radians(air) / 2)),
            ),
            Mistake(
                "other leg of the triangle",
                "That is half the weld's face. The leg is the longest side of the half triangle.",
                lambda throat, air: float(throat * np.tan(np.radians(air) / 2)),
            ),
        ),
        unit="mm",
    ),
)
