"""Exercises to chapter 11, weld trajectories."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision import geometry
from grindvision.vision.seam.seam_path import weiszfeld_median
from grindvision_book.exercises.cases import clouds, poses, units
from grindvision_book.exercises.chapter_11_welds import WELD_EXERCISES
from grindvision_book.exercises.checking import Exercise, Function, Mistake

Floats = NDArray[np.float64]


def _slabs(rng: np.random.Generator) -> list[tuple[Floats]]:
    cases = []
    for cloud in clouds(rng, 4, 60, [1.0, 4.0, 3.0]):
        cloud[:20] += [0, 12, 8]
        cases.append((cloud,))
    return cases


def _medoid(points: Floats) -> Floats:
    return points[np.linalg.norm(points[:, None] - points, axis=2).sum(axis=1).argmin()]


def _squared_weights(points: Floats) -> Floats:
    place = points.mean(axis=0)
    for _ in range(1000):
        weights = 1 / np.maximum(((points - place) ** 2).sum(axis=1), 1e-9)
        place = weights @ points / weights.sum()
    return place


def _one_round(points: Floats) -> Floats:
    weights = 1 / np.linalg.norm(points - points.mean(axis=0), axis=1)
    return weights @ points / weights.sum()


def _walls(rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    cases = []
    for root, slopes in zip(rng.uniform(-1, 1, (4, 2)), rng.uniform(0.8, 1.6, (4, 2)), strict=True):
        walls = []
        for side, slope, count in zip((-1, 1), slopes, (40, 55), strict=True):
            across = side * rng.uniform(0.6, 6, count)
            height = slope * np.abs(across) + rng.normal(0, 0.05, count)
            walls.append(np.column_stack([across, height]) + root)
        cases.append((walls[0], walls[1]))
    return cases


def root(left: Floats, right: Floats) -> Floats:
    """Where the two lines of least squares meet."""
    (a, b), (c, d) = (np.polyfit(wall[:, 0], wall[:, 1], 1) for wall in (left, right))
    across = (d - b) / (a - c)
    return np.array([across, a * across + b])


def _seams(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats]]:
    return [(rng.normal(0, 100, 3), *units(rng, 2)) for _ in range(5)]


def torch_frame(place: Floats, normal: Floats, direction: Floats) -> Floats:
    """z into the work, x along the seam freed from its part along z."""
    z = -normal
    x = direction - (direction @ z) * z
    x /= np.linalg.norm(x)
    return geometry.rigid(np.column_stack([x, np.cross(z, x), z]), place)


def _not_freed(place: Floats, normal: Floats, direction: Floats) -> Floats:
    y = np.cross(-normal, direction)
    return geometry.rigid(np.column_stack([direction, y / np.linalg.norm(y), -normal]), place)


def _axes_turned(signs: tuple[int, int, int]) -> Function:
    return lambda *case: torch_frame(*case) @ np.diag([*signs, 1])


def _euler(sequence: str) -> Function:
    return lambda roll, pitch, yaw: Rotation.from_euler(sequence, [roll, pitch, yaw]).as_matrix()


def roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> Floats:
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    return _euler("xyz")(roll, pitch, yaw)


def controller_pose(T_base_tool: Floats) -> Floats:
    """Metres, rotation vector, half a turn."""
    return _as_numbers(_half_turn() @ T_base_tool)


def _half_turn() -> Floats:
    return np.diag([-1.0, -1.0, 1.0, 1.0])


def _as_numbers(T: Floats, scale: float = 1e-3) -> Floats:
    return np.array([*(scale * T[:3, 3]), *Rotation.from_matrix(T[:3, :3]).as_rotvec()])


EXERCISES = (
    Exercise(
        "11-1",
        "The geometric median",
        weiszfeld_median,
        _slabs,
        (
            Mistake(
                "mean",
                "The mean has the least sum of *squared* distances. A far third of the points drags it along.",
                lambda points: points.mean(axis=0),
            ),
            Mistake(
                "median of each coordinate",
                "Turn the axes and your result moves in the slab. A place in space must not know the axes.",
                lambda points: np.median(points, axis=0),
            ),
            Mistake(
                "one of the points",
                "The place need not be one of the points.",
                _medoid,
            ),
            Mistake(
                "squared distances in the weights",
                "Set the gradient of the sum of distances to zero: with which power is each point weighed?",
                _squared_weights,
            ),
            Mistake(
                "one round only",
                "The weights belong to the old place. What has to happen after the move?",
                _one_round,
            ),
        ),
        unit="mm",
        tolerance=1e-5,
    ),
    Exercise(
        "11-2",
        "The root where two walls meet",
        root,
        _walls,
        (
            Mistake(
                "mean of the points",
                "A V has its points on its walls. Whatever middle you take of them hangs above the root.",
                lambda left, right: np.vstack([left, right]).mean(axis=0),
            ),
            Mistake(
                "lowest point",
                "The lowest of many noisy points is the noisiest, and no point need lie in the root.",
                lambda left, right: np.vstack([left, right])[np.vstack([left, right])[:, 1].argmin()],
            ),
            Mistake(
                "middle of the two walls' centroids",
                "That is a point in the air between the walls.",
                lambda left, right: (left.mean(axis=0) + right.mean(axis=0)) / 2,
            ),
            Mistake(
                "walls taken for mirror images",
                "The two slopes need not be equal and opposite.",
                lambda left, right: _mirrored(left, right),
            ),
            Mistake(
                "sign in the intersection",
                "Both lines must have the same height at your place. Put it into both.",
                lambda left, right: _wrong_side(left, right),
            ),
            Mistake(
                "across and height exchanged",
                "Which of the two numbers of the result comes first?",
                lambda left, right: root(left, right)[::-1],
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "11-3",
        "The torch frame",
        torch_frame,
        _seams,
        (
            Mistake(
                "z out of the work",
                "The torch points into the work, the surface normal out of it.",
                lambda place, normal, direction: torch_frame(place, -normal, direction),
            ),
            Mistake(
                "x not freed from its part along z",
                "The seam's direction is noisy and not quite perpendicular to the normal. Are your columns?",
                _not_freed,
            ),
            Mistake(
                "reflection",
                "The determinant of your axes is -1. What is z x x?",
                _axes_turned((1, -1, 1)),
            ),
            Mistake(
                "transposed rotation",
                "The axes belong into the columns.",
                lambda place, normal, direction: geometry.rigid(torch_frame(place, normal, direction)[:3, :3].T, place),
            ),
            Mistake(
                "x against the seam",
                "The torch would travel backwards.",
                _axes_turned((-1, -1, 1)),
            ),
            Mistake(
                "inverse transform: the wrong frame direction",
                "You have T_tool_base: the work as the torch sees it.",
                lambda *case: geometry.inverse(torch_frame(*case)),
            ),
        ),
        unit="mm",
        tolerance=1e-8,
    ),
    Exercise(
        "11-4",
        "Roll, pitch, yaw",
        roll_pitch_yaw,
        lambda rng: [tuple(float(a) for a in angles) for angles in rng.uniform(-1.2, 1.2, (5, 3))],
        (
            Mistake(
                "order of the turns",
                "About fixed axes the first turn stands on the right of the product. Which one is first?",
                _euler("XYZ"),
            ),
            Mistake(
                "degrees for radians",
                "The angles come in radians.",
                lambda *angles: roll_pitch_yaw(*np.radians(angles)),
            ),
            Mistake(
                "transposed rotation",
                "Every turn has the wrong sense, or the whole is the way back.",
                lambda *angles: roll_pitch_yaw(*angles).T,
            ),
            Mistake(
                "roll and yaw exchanged",
                "Roll turns about x, yaw about z.",
                lambda roll, pitch, yaw: roll_pitch_yaw(yaw, pitch, roll),
            ),
            Mistake(
                "sense of every turn",
                "Where does the minus stand in the matrix of a turn about z?",
                lambda *angles: roll_pitch_yaw(*np.negative(angles)),
            ),
        ),
    ),
    Exercise(
        "11-5",
        "A pose for the UR controller",
        controller_pose,
        lambda rng: [(pose,) for pose in poses(rng, 6)],
        (
            Mistake(
                "millimetres for metres",
                "Half a metre is 500 in your numbers. Which unit does URScript count in?",
                lambda T: _as_numbers(_half_turn() @ T, 1.0),
            ),
            Mistake(
                "half turn of the controller's base left out",
                "The numbers are right for base_link. Which frame does the controller count in?",
                _as_numbers,
            ),
            Mistake(
                "roll, pitch, yaw for the rotation vector",
                "Three numbers for an orientation can mean many things. A rotation vector is axis times angle.",
                lambda T: np.array(
                    [
                        *controller_pose(T)[:3],
                        *Rotation.from_matrix((_half_turn() @ T)[:3, :3]).as_euler("xyz"),
                    ]
                ),
            ),
            Mistake(
                "degrees for radians",
                "The rotation vector has the right direction. Its length?",
                lambda T: controller_pose(T) * [1, 1, 1, *[180 / np.pi] * 3],
            ),
            Mistake(
                "half turn on the wrong side",
                "It is the base that stands otherwise, not the torch. On which side of T_base_tool does it belong?",
                lambda T: _as_numbers(T @ _half_turn()),
            ),
            Mistake(
                "inverse transform: the wrong frame direction",
                "The controller asks where the tool is in its base, not the other way round.",
                lambda T: _as_numbers(geometry.inverse(_half_turn() @ T)),
            ),
        ),
        tolerance=1e-7,
    ),
    *WELD_EXERCISES,
)


def _mirrored(left: Floats, right: Floats) -> Floats:
    falling, rising = (np.polyfit(wall[:, 0], wall[:, 1], 1)[0] for wall in (left, right))
    slope = (rising - falling) / 2
    across = ((left[:, 1] + slope * left[:, 0]).mean() - (right[:, 1] - slope * right[:, 0]).mean()) / (2 * slope)
    return np.array([across, (right[:, 1] - slope * right[:, 0]).mean() + slope * across])


def _wrong_side(left: Floats, right: Floats) -> Floats:
    (a, b), (c, d) = (np.polyfit(wall[:, 0], wall[:, 1], 1) for wall in (left, right))
    across = (b - d) / (a - c)
    return np.array([across, a * across + b])
