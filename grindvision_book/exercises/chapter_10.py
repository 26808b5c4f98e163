"""Exercises to chapter 10, finding weld grooves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import grey_closing, grey_dilation, grey_erosion, grey_opening
from scipy.spatial import cKDTree

from grindvision.geometry import vector_angle
from grindvision.vision.seam.gfh import base_normal
from grindvision_book.exercises.cases import units
from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


def _normals(rng: np.random.Generator) -> list[tuple[Floats]]:
    cases = []
    for main in units(rng, 4):
        normals = main + rng.normal(0, 0.15, (60, 3))
        normals[:6] = -main + rng.normal(0, 0.1, (6, 3))
        cases.append((normals / np.linalg.norm(normals, axis=1, keepdims=True),))
    return cases


def global_angles(normals: Floats) -> Floats:
    """Eqs 3 and 4, degrees."""
    return np.degrees(vector_angle(normals, base_normal(normals)))


def _histograms(rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    return [(rng.uniform(0, 8, 25) + shift, rng.uniform(2, 20, 25)) for shift in (0.0, 3.0, 10.0, 1.0)]


def spread(local: Floats, global_: Floats) -> float:
    """Fourth root of the product of the variations."""
    return float((local.var() * global_.var()) ** 0.25)


def _marks(rng: np.random.Generator) -> list[tuple[Floats, Flags, float]]:
    cases = []
    for radius in (4.0, 6.0, 5.0):
        points = rng.uniform(0, 40, (250, 3)) * [1, 1, 0.05]
        cases.append((points, (points[:, 0] > 18) ^ (rng.random(250) < 0.2), radius))
    return cases


def voted(points: Floats, marked: Flags, radius: float) -> Flags:
    """More than half of all within the radius, itself included."""
    near = cKDTree(points).query_ball_point(points, radius)
    return np.array([marked[inside].mean() > 0.5 for inside in near])


def _voted_by_others(points: Floats, marked: Flags, radius: float) -> Flags:
    near = cKDTree(points).query_ball_point(points, radius)
    shares = [marked[[i for i in inside if i != k]] for k, inside in enumerate(near)]
    return np.array([others.mean() > 0.5 if len(others) else False for others in shares])


def _any_marked(points: Floats, marked: Flags, radius: float) -> Flags:
    return np.array([marked[inside].any() for inside in cKDTree(points).query_ball_point(points, radius)])


def _detections(rng: np.random.Generator) -> list[tuple[Flags, Flags]]:
    cases = []
    for kept, extra in ((0.9, 0.1), (0.7, 0.02), (0.98, 0.3)):
        truth = rng.random(400) < 0.3
        cases.append((np.where(truth, rng.random(400) < kept, rng.random(400) < extra), truth))
    return cases


def overlap_percent(found: Flags, truth: Flags) -> float:
    """Intersection over union."""
    return float(100 * (found & truth).sum() / (found | truth).sum())


def _sections(rng: np.random.Generator) -> list[tuple[Floats, int]]:
    cases = []
    for width, half in ((6, 8), (4, 6), (9, 12)):
        x = np.arange(120)
        heights = 0.02 * x + rng.normal(0, 0.05, 120)
        heights -= np.maximum(7 - np.abs(x - 40) * 7 / width, 0)
        heights += np.maximum(5 - np.abs(x - 90), 0)
        cases.append((heights, half))
    return cases


def valley_depth(heights: Floats, half: int) -> Floats:
    """Closing minus the heights."""
    return grey_closing(heights, 2 * half + 1, mode="nearest") - heights


EXERCISES = (
    Exercise(
        "10-1",
        "Angles to the base normal (Eqs 3-4)",
        global_angles,
        _normals,
        (
            Mistake(
                "radians for degrees",
                "The name of the function ends in _deg.",
                lambda normals: np.radians(global_angles(normals)),
            ),
            Mistake(
                "base normal not of length one",
                "The mean of unit vectors is shorter than one. What does arccos make of that?",
                lambda normals: np.degrees(np.arccos(np.clip(normals @ normals.mean(axis=0), -1, 1))),
            ),
            Mistake(
                "sign of the normals lost",
                "Some normals point away from the base normal, by more than 90 degrees. Yours never do.",
                lambda normals: np.minimum(global_angles(normals), 180 - global_angles(normals)),
            ),
            Mistake(
                "camera's axis for base normal",
                "The plate need not face the camera. Which direction do its normals have together?",
                lambda normals: np.degrees(vector_angle(normals, [0.0, 0.0, -1.0])),
            ),
            Mistake(
                "first normal for base normal",
                "One normal is as noisy as any other. Eq 3 takes all of them.",
                lambda normals: np.degrees(vector_angle(normals, normals[0])),
            ),
            Mistake(
                "median for mean",
                "Eq 3 is a sum, made one long.",
                lambda normals: np.degrees(vector_angle(normals, np.median(normals, axis=0))),
            ),
        ),
        unit="deg",
    ),
    Exercise(
        "10-2",
        "The groove descriptor (Eqs 5-6)",
        spread,
        _histograms,
        (
            Mistake(
                "squares not taken about the mean",
                "On a pipe all angles may be large and equal: that is no groove. About what do Eqs 5 and 6 vary?",
                lambda local, global_: float(((local**2).mean() * (global_**2).mean()) ** 0.25),
            ),
            Mistake(
                "sample for population variation",
                "Eqs 5 and 6 divide by N.",
                lambda local, global_: float((local.var(ddof=1) * global_.var(ddof=1)) ** 0.25),
            ),
            Mistake(
                "square root for the fourth root",
                "D has the unit of degrees to the fourth power.",
                lambda local, global_: float((local.var() * global_.var()) ** 0.5),
            ),
            Mistake(
                "no root",
                "D has the unit of degrees to the fourth power, the threshold that of degrees.",
                lambda local, global_: float(local.var() * global_.var()),
            ),
            Mistake(
                "mean of the standard deviations",
                "The descriptor is a product: a point must vary in both histograms.",
                lambda local, global_: float((local.std() + global_.std()) / 2),
            ),
            Mistake(
                "variation of all angles together",
                "Each histogram varies about its own mean.",
                lambda local, global_: float(np.concatenate([local, global_]).std()),
            ),
        ),
        unit="deg",
    ),
    Exercise(
        "10-3",
        "The vote",
        voted,
        _marks,
        (
            Mistake(
                "one marked neighbour is enough",
                "A majority is more than half. Yours lets the marks grow.",
                _any_marked,
            ),
            Mistake(
                "squared threshold",
                "Your radius acts like its root: is a squared distance compared with a length?",
                lambda points, marked, radius: voted(points, marked, float(np.sqrt(radius))),
            ),
            Mistake(
                "the point itself not counted",
                "The point has a vote like all others within the radius.",
                _voted_by_others,
            ),
            Mistake(
                "the mark kept whatever the neighbours say",
                "A vote can also take a mark away.",
                lambda points, marked, radius: marked | voted(points, marked, radius),
            ),
            Mistake(
                "minority",
                "The result is turned round: which side has more than half?",
                lambda points, marked, radius: ~voted(points, marked, radius),
            ),
            Mistake(
                "radius for diameter",
                "You look only half as far as you may.",
                lambda points, marked, radius: voted(points, marked, radius / 2),
            ),
        ),
    ),
    Exercise(
        "10-4",
        "The overlap of Table II",
        overlap_percent,
        _detections,
        (
            Mistake(
                "recall for overlap",
                "Calling everything groove would give 100 %. What must the false points do to the result?",
                lambda found, truth: float(100 * (found & truth).sum() / truth.sum()),
            ),
            Mistake(
                "precision for overlap",
                "One sure point would give 100 %. What must the missed points do to the result?",
                lambda found, truth: float(100 * (found & truth).sum() / found.sum()),
            ),
            Mistake(
                "share of points judged right",
                "Most points are plate, and calling nothing groove would be 70 % right.",
                lambda found, truth: float(100 * (found == truth).mean()),
            ),
            Mistake(
                "Dice's coefficient",
                "Twice the intersection over the sum of both is another number. What is below the line in the task?",
                lambda found, truth: float(200 * (found & truth).sum() / (found.sum() + truth.sum())),
            ),
            Mistake(
                "share for percent",
                "Table II counts in percent.",
                lambda found, truth: overlap_percent(found, truth) / 100,
            ),
        ),
        unit="%",
    ),
    Exercise(
        "10-5",
        "Valleys by closing",
        valley_depth,
        _sections,
        (
            Mistake(
                "opening for closing",
                "Your result finds the ridge and not the groove. Which of the two steps comes first?",
                lambda heights, half: heights - grey_opening(heights, 2 * half + 1, mode="nearest"),
            ),
            Mistake(
                "largest value only",
                "The first step alone lifts every slope. What does the second one do?",
                lambda heights, half: grey_dilation(heights, 2 * half + 1, mode="nearest") - heights,
            ),
            Mistake(
                "smallest value only",
                "Your line runs below the surface everywhere.",
                lambda heights, half: heights - grey_erosion(heights, 2 * half + 1, mode="nearest"),
            ),
            Mistake(
                "sign",
                "A depth is positive. What is subtracted from what?",
                lambda heights, half: -valley_depth(heights, half),
            ),
            Mistake(
                "half width taken for the width",
                "The window reaches that many samples to *both* sides.",
                lambda heights, half: valley_depth(heights, half // 2),
            ),
            Mistake(
                "closed heights for the depth",
                "That is the surface without its valleys. How deep are they below it?",
                lambda heights, half: valley_depth(heights, half) + heights,
            ),
        ),
        unit="mm",
    ),
)
