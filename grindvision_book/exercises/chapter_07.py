"""Exercises to chapter 07, into the robot's frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision import geometry
from grindvision_book.exercises.cases import poses, units
from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def _paths(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats]]:
    return [(pose, rng.normal(0, 30, (6, 3)) + [0, 0, 400], units(rng, 6)) for pose in poses(rng, 4)]


def path_in_base(T_base_scanner: Floats, points: Floats, normals: Floats) -> Floats:
    """Points moved, normals turned."""
    moved, turned = geometry.move_points(T_base_scanner, points), geometry.rotate_vectors(T_base_scanner, normals)
    return np.column_stack([moved, turned])


def _transposed(T: Floats) -> Floats:
    return geometry.rigid(T[:3, :3].T, T[:3, 3])


def joint_pose(T_base_scanner: Floats, T_joint4_scanner: Floats) -> Floats:
    """T_base_joint4."""
    return T_base_scanner @ geometry.inverse(T_joint4_scanner)


def _rounded(rng: np.random.Generator) -> list[tuple[Floats]]:
    """Rotations as printed, some badly, some so badly that the nearest orthogonal matrix is a reflection."""
    turns = [geometry.random_rotation(rng) for _ in range(5)]
    matrices = [
        turn + rng.uniform(-size, size, (3, 3)) for turn, size in zip(turns, (5e-5, 5e-3, 0.05, 0.1, 0.1), strict=True)
    ]
    flat = geometry.random_rotation(rng) @ np.diag([1.0, 0.9, -0.2]) @ geometry.random_rotation(rng)
    return [(matrix,) for matrix in (*matrices, flat)]


def _from_svd(matrix: Floats, guard: bool) -> Floats:
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt)) if guard else 1]) @ vt


def _gram_schmidt(matrix: Floats) -> Floats:
    x = matrix[:, 0] / np.linalg.norm(matrix[:, 0])
    y = matrix[:, 1] - x * (x @ matrix[:, 1])
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def _printed(rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    cases = []
    for _ in range(4):
        along = np.cumsum(rng.uniform(2, 5, 6))
        cases.append((np.column_stack([along, 0.02 * along**2, 0.3 * along]), units(rng, 6)))
    return cases


def off_perpendicular_deg(points: Floats, normals: Floats) -> Floats:
    """How far normals are from perpendicular to the path."""
    return np.abs(np.degrees(geometry.vector_angle(normals, np.gradient(points, axis=0))) - 90)


EXERCISES = (
    Exercise(
        "07-1",
        "A path into the base frame",
        path_in_base,
        _paths,
        (
            Mistake(
                "normals moved like points",
                "A direction has no place: the origin of the frame must not matter to it.",
                lambda T, points, normals: np.column_stack(
                    [geometry.move_points(T, points), geometry.move_points(T, normals)]
                ),
            ),
            Mistake(
                "transposed rotation",
                "With points in rows the product stands on the other side. Compare R @ p with p @ R.",
                lambda T, points, normals: path_in_base(_transposed(T), points, normals),
            ),
            Mistake(
                "inverse transform: the wrong frame direction",
                "Your points went from the base to the scanner. Read T_base_scanner from right to left.",
                lambda T, points, normals: path_in_base(geometry.inverse(T), points, normals),
            ),
            Mistake(
                "normals left in the scanner's frame",
                "The points are in the base frame, the normals are not.",
                lambda T, points, normals: np.column_stack([geometry.move_points(T, points), normals]),
            ),
            Mistake(
                "points turned but not shifted",
                "The base does not stand where the scanner is.",
                lambda T, points, normals: np.column_stack(
                    [geometry.rotate_vectors(T, points), geometry.rotate_vectors(T, normals)]
                ),
            ),
            Mistake(
                "shift in metres",
                "The points have hardly moved. Which unit has the shift?",
                lambda T, points, normals: path_in_base(geometry.rigid(T[:3, :3], T[:3, 3] / 1000), points, normals),
            ),
        ),
        unit="mm",
        tolerance=1e-7,
    ),
    Exercise(
        "07-2",
        "Where was joint 4?",
        joint_pose,
        lambda rng: list(zip(poses(rng, 5), poses(rng, 5, 100.0), strict=True)),
        (
            Mistake(
                "printed matrix not inverted",
                "Names must meet: T_base_scanner needs something that begins with the scanner on its right.",
                lambda T_base_scanner, T_joint4_scanner: T_base_scanner @ T_joint4_scanner,
            ),
            Mistake(
                "order of the product",
                "Both factors are right. Which name must stand where they meet?",
                lambda T_base_scanner, T_joint4_scanner: geometry.inverse(T_joint4_scanner) @ T_base_scanner,
            ),
            Mistake(
                "inverse transform: the wrong frame direction",
                "You have T_joint4_base.",
                lambda T_base_scanner, T_joint4_scanner: geometry.inverse(joint_pose(T_base_scanner, T_joint4_scanner)),
            ),
            Mistake(
                "the other factor inverted",
                "One of the two goes in as it is. Write the chain by names.",
                lambda T_base_scanner, T_joint4_scanner: geometry.inverse(T_base_scanner) @ T_joint4_scanner,
            ),
            Mistake(
                "transposed instead of inverted",
                "A 4x4 matrix is no rotation: what happens to its last column?",
                lambda T_base_scanner, T_joint4_scanner: T_base_scanner @ T_joint4_scanner.T,
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "07-3",
        "The rotation nearest to a printed matrix",
        geometry.nearest_rotation,
        _rounded,
        (
            Mistake(
                "reflection",
                "For one of the matrices the nearest orthogonal one mirrors. What is its determinant?",
                lambda matrix: _from_svd(matrix, guard=False),
            ),
            Mistake(
                "columns made unit vectors only",
                "Your columns have length one, but are they perpendicular?",
                lambda matrix: matrix / np.linalg.norm(matrix, axis=0),
            ),
            Mistake(
                "one column after the other (Gram-Schmidt)",
                "A rotation, but not the nearest: the first column is believed, the last one is not asked.",
                _gram_schmidt,
            ),
            Mistake(
                "transposed rotation",
                "Is your product U V^T or V U^T?",
                lambda matrix: _from_svd(matrix, guard=True).T,
            ),
            Mistake(
                "whole matrix negated",
                "Changing the sign of all three axes mends the determinant, and turns every axis round.",
                lambda matrix: _from_svd(matrix, guard=False) * np.sign(np.linalg.det(_from_svd(matrix, guard=False))),
            ),
        ),
    ),
    Exercise(
        "07-4",
        "Do the normals stand on the path?",
        off_perpendicular_deg,
        _printed,
        (
            Mistake(
                "radians for degrees",
                "The name of the function ends in _deg.",
                lambda points, normals: np.radians(off_perpendicular_deg(points, normals)),
            ),
            Mistake(
                "angle to the path instead of off perpendicular",
                "A perfect normal should give zero. Yours gives 90.",
                lambda points, normals: np.degrees(geometry.vector_angle(normals, np.gradient(points, axis=0))),
            ),
            Mistake(
                "sign kept",
                "Leaning forwards or backwards by 10 degrees is equally bad. The task asks for a size.",
                lambda points, normals: np.degrees(geometry.vector_angle(normals, np.gradient(points, axis=0))) - 90,
            ),
            Mistake(
                "tangent not of length one",
                "An arcsine or arccosine wants a cosine. How long is the difference of two path points?",
                lambda points, normals: _with_long_tangents(points, normals),
            ),
            Mistake(
                "direction of the point instead of the path",
                "That is the angle to the line of sight. The path's direction comes from neighbouring points.",
                lambda points, normals: np.abs(np.degrees(geometry.vector_angle(normals, points)) - 90),
            ),
            Mistake(
                "one chord for the whole path",
                "The path bends. Each point has a direction of its own.",
                lambda points, normals: np.abs(np.degrees(geometry.vector_angle(normals, points[-1] - points[0])) - 90),
            ),
        ),
        unit="deg",
    ),
)


def _with_long_tangents(points: Floats, normals: Floats) -> Floats:
    products = (normals * np.gradient(points, axis=0)).sum(axis=1)
    return np.abs(np.degrees(np.arcsin(np.clip(products, -1, 1))))
