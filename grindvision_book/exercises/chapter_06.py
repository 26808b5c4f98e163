"""Exercises to chapter 06, from difference to path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision import geometry
from grindvision.vision import find_change_paper
from grindvision.vision.change.oriented_box import minimal_box
from grindvision_book.exercises.cases import poses, units
from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def _scans(rng: np.random.Generator) -> list[tuple[Floats, Floats, float]]:
    cases = []
    for pose, threshold in zip(poses(rng, 3), (0.4, 0.6, 2.5), strict=True):
        sample = np.column_stack([rng.uniform(-10, 10, (300, 2)), rng.normal(0, 0.02, 300)])
        test = np.column_stack([rng.uniform(-10, 10, (200, 2)), rng.choice([0, 0.5, 0.8, 2, 3, 6], 200)])
        cases.append((geometry.move_points(pose, sample), geometry.move_points(pose, test), threshold))
    return cases


def _distances(sample: Floats, test: Floats) -> Floats:
    return cKDTree(sample).query(test)[0]


def changed(sample: Floats, test: Floats, threshold_mm: float) -> NDArray[np.bool_]:
    """Section 3.5 with a length for a length."""
    return find_change_paper(test, sample, threshold_mm, squared=False)


def _feet(rng: np.random.Generator) -> list[tuple[Floats, ...]]:
    cases: list[tuple[Floats, ...]] = []
    for _ in range(4):
        feet, normals = rng.normal(0, 30, (15, 3)), units(rng, 15)
        tests = feet + rng.normal(0, 1.5, (15, 3))
        cases.append((tests, feet, normals))
    return cases


def heights(tests: Floats, feet: Floats, normals: Floats) -> Floats:
    """Along the good surface's normal."""
    return ((tests - feet) * normals).sum(axis=1)


def _noises(rng: np.random.Generator) -> list[tuple[float, int, float, int, float]]:
    rows = rng.uniform([0.02, 4, 0.02, 4, 0.005], [0.08, 60, 0.08, 60, 0.03], (5, 5))
    return [(float(a), int(n), float(b), int(m), float(c)) for a, n, b, m, c in rows]


def level(sample: float, n_sample: int, test: float, n_test: int, pose: float) -> float:
    """1.96 standard deviations."""
    return float(1.96 * np.sqrt(sample**2 / n_sample + test**2 / n_test + pose**2))


def _beads(rng: np.random.Generator) -> list[tuple[Floats, int]]:
    cases = []
    for pose, parts in zip(poses(rng, 3), (6, 4, 5), strict=True):
        along = np.concatenate([rng.uniform(0, 40, 200), rng.uniform(0, 12, 200)])
        bead = np.column_stack([along, rng.uniform(-2, 2, 400), rng.uniform(0, 1.5, 400)])
        cases.append((geometry.move_points(pose, bead), parts))
    return cases


def part_centroids(points: Floats, parts: int, axis: int = 0) -> Floats:
    """Section 3.6: equal lengths of the minimal box's longest side."""
    box = minimal_box(points)
    return _cut(points, (points - box.centre_mm) @ box.axes[axis] / box.size_mm[axis] + 0.5, parts)


def _cut(points: Floats, share: Floats, parts: int) -> Floats:
    part = np.clip((share * parts).astype(int), 0, parts - 1)
    return np.array([points[part == k].mean(axis=0) for k in range(parts) if (part == k).any()])


def _equal_counts(points: Floats, parts: int) -> Floats:
    along = (points - points.mean(axis=0)) @ minimal_box(points).axes[0]
    return np.array([points[group].mean(axis=0) for group in np.array_split(np.argsort(along), parts)])


def _frame_axis(points: Floats, parts: int) -> Floats:
    along = points[:, 0]
    return _cut(points, (along - along.min()) / np.ptp(along), parts)


def _middles(points: Floats, parts: int) -> Floats:
    box = minimal_box(points)
    steps = ((np.arange(parts) + 0.5) / parts - 0.5) * box.size_mm[0]
    return box.centre_mm + steps[:, None] * box.axes[0]


def _from_one_end(path: object) -> Floats:
    path = np.atleast_2d(np.asarray(path, dtype=float))
    return path[::-1] if path[0, 0] > path[-1, 0] else path


def _sections(rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    cases = []
    for ridge in rng.uniform(-0.6, 0.6, 5):
        across = np.concatenate([rng.uniform(-1.5, 1.5, 30), rng.uniform(0.5, 1.5, 60)])
        cases.append((across, 1.4 - 0.4 * (across - ridge) ** 2 + rng.normal(0, 0.03, 90)))
    return cases


def ridge(across: Floats, height: Floats) -> float:
    """Vertex of the parabola of least squares."""
    c2, c1, _ = np.polyfit(across, height, 2)
    return float(-c1 / (2 * c2))


EXERCISES = (
    Exercise(
        "06-1",
        "The paper's difference cloud",
        changed,
        _scans,
        (
            Mistake(
                "squared threshold",
                "PCL compares the squared distance with the threshold. A length belongs against a length.",
                lambda sample, test, threshold: find_change_paper(test, sample, threshold, squared=True),
            ),
            Mistake(
                "threshold squared too often",
                "Your distance is a length, your threshold is not.",
                lambda sample, test, threshold: _distances(sample, test) > threshold**2,
            ),
            Mistake(
                "kept what agrees",
                "You return what lies near the sample. What is to be ground away?",
                lambda sample, test, threshold: _distances(sample, test) <= threshold,
            ),
            Mistake(
                "searched the wrong way round",
                "One flag for each test point: whose neighbours are looked for, and among which points?",
                lambda sample, test, threshold: _distances(test, sample) > threshold,
            ),
            Mistake(
                "point against point in the order of the files",
                "Row 7 of one scan has nothing to do with row 7 of the other. Which sample point is the partner?",
                lambda sample, test, threshold: np.linalg.norm(test - sample[: len(test)], axis=1) > threshold,
            ),
            Mistake(
                "difference along z",
                "The scanner does not look along the surface's normal; what is asked for is a distance in space.",
                lambda sample, test, threshold: np.abs(test - sample[cKDTree(sample).query(test)[1]])[:, 2] > threshold,
            ),
        ),
    ),
    Exercise(
        "06-2",
        "Signed height over the good surface",
        heights,
        _feet,
        (
            Mistake(
                "sign: negative where material stands out",
                "The normals point out of the good part. What is positive along them?",
                lambda tests, feet, normals: -heights(tests, feet, normals),
            ),
            Mistake(
                "sign lost",
                "A dent and a bead look alike in your result.",
                lambda tests, feet, normals: np.abs(heights(tests, feet, normals)),
            ),
            Mistake(
                "distance of the points",
                "Two samplings of one surface never meet point by point: only the part along the normal says anything.",
                lambda tests, feet, normals: np.linalg.norm(tests - feet, axis=1),
            ),
            Mistake(
                "foot point left out",
                "The height is measured from the good surface, not from the scanner.",
                lambda tests, feet, normals: (tests * normals).sum(axis=1),
            ),
            Mistake(
                "along z",
                "Each foot point has a normal of its own, and few of them are the z axis.",
                lambda tests, feet, normals: (tests - feet)[:, 2],
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "06-3",
        "Level of detection",
        level,
        _noises,
        (
            Mistake(
                "noise not averaged over the points of a cell",
                "A mean of n points is surer than one of them.",
                lambda a, n, b, m, c: level(a, 1, b, 1, c),
            ),
            Mistake(
                "divided by n instead of its root",
                "The variance falls with n. Where does your n stand, under the root or not?",
                lambda a, n, b, m, c: level(a / n, 1, b / m, 1, c),
            ),
            Mistake(
                "the pose's uncertainty averaged too",
                "A shifted scan is shifted in all its points alike. What does averaging change?",
                lambda a, n, b, m, c: 1.96 * np.sqrt(a**2 / n + b**2 / m + c**2 / min(n, m)),
            ),
            Mistake(
                "standard deviations added",
                "Independent errors add as squares.",
                lambda a, n, b, m, c: 1.96 * (a / np.sqrt(n) + b / np.sqrt(m) + c),
            ),
            Mistake(
                "one standard deviation for 95 %",
                "Every third unchanged point would lie above your level.",
                lambda a, n, b, m, c: level(a, n, b, m, c) / 1.96,
            ),
            Mistake(
                "the pose left out",
                "At the limit of many points yours is zero. What does not average out?",
                lambda a, n, b, m, c: level(a, n, b, m, 0.0),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "06-4",
        "Path points of the paper's boxes",
        part_centroids,
        _beads,
        (
            Mistake(
                "equal counts for equal lengths",
                "One end of the bead was scanned denser. Your points crowd there.",
                _equal_counts,
            ),
            Mistake(
                "cut along the frame's x axis",
                "The bead does not know the scanner's axes. Which side of its own box is the longest?",
                _frame_axis,
            ),
            Mistake(
                "cut along the shortest side",
                "The box's axes come longest first.",
                lambda points, parts: part_centroids(points, parts, axis=2),
            ),
            Mistake(
                "middles of the boxes for centroids",
                "Your points lie on the axis of the box. What does the paper take from each part?",
                _middles,
            ),
            Mistake(
                "one part too many",
                "The point at the very end opens a part of its own. Into which part does it belong?",
                lambda points, parts: part_centroids(points, parts + 1),
            ),
        ),
        unit="mm",
        arranged=_from_one_end,
    ),
    Exercise(
        "06-5",
        "The ridge of a section",
        ridge,
        _sections,
        (
            Mistake(
                "mean weighted by height",
                "One flank was scanned denser and pulls your mean. A fit of heights does not care about density.",
                lambda across, height: float(np.average(across, weights=height)),
            ),
            Mistake(
                "centroid",
                "That is where most points are, not where the bead is highest.",
                lambda across, height: float(across.mean()),
            ),
            Mistake(
                "highest point",
                "The highest of many noisy points is the noisiest near the top.",
                lambda across, height: float(across[np.argmax(height)]),
            ),
            Mistake(
                "factor 2 in the vertex",
                "Set the slope of c0 + c1 b + c2 b^2 to zero.",
                lambda across, height: 2 * ridge(across, height),
            ),
            Mistake(
                "sign of the vertex",
                "Set the slope of c0 + c1 b + c2 b^2 to zero, and mind on which side c1 ends up.",
                lambda across, height: -ridge(across, height),
            ),
            Mistake(
                "coefficients in the other order",
                "np.polyfit returns the highest power first.",
                lambda across, height: _reversed_vertex(across, height),
            ),
        ),
        unit="mm",
    ),
)


def _reversed_vertex(across: Floats, height: Floats) -> float:
    _, c1, c2 = np.polyfit(across, height, 2)
    return float(-c1 / (2 * c2))
