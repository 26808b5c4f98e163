"""Exercises to chapter 05, registering two scans."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision import geometry
from grindvision.vision.registration.sac_ia import huber
from grindvision_book.exercises.cases import clouds, poses, units
from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def _pairs(rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    """Pairs of clouds, some of them so flat and noisy that a mirror image fits better than any turn."""
    cases = []
    for source, pose in zip(clouds(rng, 4, 20), poses(rng, 4), strict=True):
        cases.append((source, geometry.move_points(pose, source) + rng.normal(0, 0.05, source.shape)))
    for source, pose in zip(clouds(rng, 2, 20, [60.0, 40.0, 0.5]), poses(rng, 2), strict=True):
        mirrored = source.copy()
        mirrored[:, 2] = 2 * source[:, 2].mean() - source[:, 2]
        cases.append((source, geometry.move_points(pose, mirrored)))
    return cases


def rigid_motion(source: Floats, target: Floats) -> Floats:
    """Least squares, no reflection."""
    return geometry.fit_rigid(source, target).T_target_source


def _kabsch(source: Floats, target: Floats, change: str) -> Floats:
    a, b = source.mean(axis=0), target.mean(axis=0)
    if change == "no centroid":
        a = b = np.zeros(3)
    u, _, vt = np.linalg.svd((target - b).T @ (source - a))
    guard = np.eye(3) if change == "reflection" else np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ guard @ vt
    if change == "transposed":
        rotation = rotation.T
    shift = b - a if change == "shift of the centroids" else b - rotation @ a
    if change == "no centroid":
        shift = target.mean(axis=0) - rotation @ source.mean(axis=0)
    return geometry.rigid(rotation, shift)


def _oriented_pairs(rng: np.random.Generator) -> list[tuple[Floats, ...]]:
    return [(rng.normal(0, 5, 3), units(rng), rng.normal(0, 5, 3), units(rng)) for _ in range(6)]


def pair_angles(p: Floats, n_p: Floats, q: Floats, n_q: Floats) -> Floats:
    """Eqs 3 and 4: alpha, phi, theta."""
    v = np.cross(q - p, n_p)
    return _angles(q - p, n_p, n_q, v / np.linalg.norm(v))


def _angles(d: Floats, u: Floats, n: Floats, v: Floats) -> Floats:
    return np.array([v @ n, u @ d / np.linalg.norm(d), np.arctan2(np.cross(u, v) @ n, u @ n)])


def _partners(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats, float]]:
    cases = []
    for pose, source, threshold in zip(poses(rng, 4, 50), clouds(rng, 4, 30, 30.0), (2.0, 5.0, 3.0, 1.5), strict=True):
        distances = np.abs(rng.normal(0, 3, (30, 1)))
        cases.append((pose, source, geometry.move_points(pose, source) + units(rng, 30) * distances, threshold))
    return cases


def _distances(T_target_source: Floats, source: Floats, partners: Floats) -> Floats:
    return np.linalg.norm(geometry.move_points(T_target_source, source) - partners, axis=1)


def score(T_target_source: Floats, source: Floats, partners: Floats, t_e: float) -> float:
    """Eq 6, mean."""
    return float(huber(_distances(T_target_source, source, partners), t_e).mean())


def _planes(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats]]:
    return [(source, source + rng.normal(0, 2, source.shape), units(rng, 12)) for source in clouds(rng, 4, 12)]


def plane_equations(source: Floats, target: Floats, normals: Floats) -> Floats:
    """Rows [n, p x n | n . (target - p)] of shift, small turn, and right-hand side."""
    return _equations(source, target, normals, np.cross(source, normals))


def _equations(source: Floats, target: Floats, normals: Floats, turns: Floats) -> Floats:
    return np.column_stack([normals, turns, ((target - source) * normals).sum(axis=1)])


EXERCISES = (
    Exercise(
        "05-1",
        "The rigid motion between paired points",
        rigid_motion,
        _pairs,
        (
            Mistake(
                "centroid not subtracted",
                "The rotation is that of two clouds turned about the origin. What belongs into the cross-covariance?",
                lambda source, target: _kabsch(source, target, "no centroid"),
            ),
            Mistake(
                "reflection",
                "Some clouds are nearly flat, and there a mirror image fits better than any turn. What is the "
                "determinant of your rotation?",
                lambda source, target: _kabsch(source, target, "reflection"),
            ),
            Mistake(
                "transposed rotation",
                "U and V have changed places, or the cross-covariance has. Which cloud does it begin with?",
                lambda source, target: _kabsch(source, target, "transposed"),
            ),
            Mistake(
                "inverse transform: the wrong frame direction",
                "You have T_source_target. The source is to be moved.",
                lambda source, target: rigid_motion(target, source),
            ),
            Mistake(
                "difference of the centroids for the shift",
                "The rotation turns about the origin. Where does it take the source's centroid?",
                lambda source, target: _kabsch(source, target, "shift of the centroids"),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "05-2",
        "Three angles of a pair (Eqs 3-4)",
        pair_angles,
        _oriented_pairs,
        (
            Mistake(
                "v not normalised",
                "The cross product of two vectors is a unit vector only if both are and they are perpendicular.",
                lambda p, n_p, q, n_q: _angles(q - p, n_p, n_q, np.cross(q - p, n_p)),
            ),
            Mistake(
                "frame built on the neighbour's normal",
                "u is the normal of the query point p. Which point is which?",
                lambda p, n_p, q, n_q: pair_angles(p, n_q, q, n_p),
            ),
            Mistake(
                "difference of the points the wrong way round",
                "The line runs from the query point to its neighbour.",
                lambda p, n_p, q, n_q: pair_angles(q, n_p, p, n_q),
            ),
            Mistake(
                "arguments of atan2 exchanged",
                "atan2 takes the part along w first, the part along u second. What is theta for equal normals?",
                lambda p, n_p, q, n_q: np.array(
                    [*pair_angles(p, n_p, q, n_q)[:2], _exchanged(pair_angles(p, n_p, q, n_q)[2])]
                ),
            ),
            Mistake(
                "distance left in phi",
                "phi must not change when the cloud is twice as large.",
                lambda p, n_p, q, n_q: pair_angles(p, n_p, q, n_q) * [1, np.linalg.norm(q - p), 1],
            ),
            Mistake(
                "sense of v",
                "A cross product changes its sign with the order of its factors. Look at Eq 3 again.",
                lambda p, n_p, q, n_q: pair_angles(p, n_p, q, n_q) * [-1, 1, -1],
            ),
            Mistake(
                "degrees for radians",
                "The third angle is asked for in radians.",
                lambda p, n_p, q, n_q: pair_angles(p, n_p, q, n_q) * [1, 1, 180 / np.pi],
            ),
        ),
        tolerance=1e-7,
    ),
    Exercise(
        "05-3",
        "The score of a pose (Eq 6)",
        score,
        _partners,
        (
            Mistake(
                "squared distance compared with the threshold",
                "That is what PCL does: 5 mm then act like 2.2 mm. Which unit does the threshold have, which your e?",
                lambda T, source, partners, t_e: float(huber(_distances(T, source, partners) ** 2, t_e).mean()),
            ),
            Mistake(
                "squared threshold",
                "The threshold is a length, and so is the distance that it is compared with.",
                lambda T, source, partners, t_e: float(huber(_distances(T, source, partners), t_e**2).mean()),
            ),
            Mistake(
                "square without a limit",
                "Far points still count with their square, and one stray decides the score.",
                lambda T, source, partners, t_e: float((0.5 * _distances(T, source, partners) ** 2).mean()),
            ),
            Mistake(
                "jump at the threshold",
                "Evaluate both branches at e = t_e: they must meet.",
                lambda T, source, partners, t_e: float(_jumping(_distances(T, source, partners), t_e).mean()),
            ),
            Mistake(
                "sum for mean",
                "Clouds of different size could not be compared.",
                lambda T, source, partners, t_e: score(T, source, partners, t_e) * len(source),
            ),
            Mistake(
                "inverse transform: the wrong frame direction",
                "The source is to be moved to the target. Which way does T_target_source go?",
                lambda T, source, partners, t_e: score(geometry.inverse(T), source, partners, t_e),
            ),
        ),
        unit="mm squared",
    ),
    Exercise(
        "05-4",
        "Point to plane: the equations",
        plane_equations,
        _planes,
        (
            Mistake(
                "order of the cross product",
                "Turn p by a small r: it moves by r x p. Along n that is n . (r x p) = r . (?).",
                lambda p, q, n: _equations(p, q, n, np.cross(n, p)),
            ),
            Mistake(
                "lever arm of the target",
                "It is the source point that moves.",
                lambda p, q, n: _equations(p, q, n, np.cross(q, n)),
            ),
            Mistake(
                "sign of the right-hand side",
                "The step is to move the source to the target, not away from it.",
                lambda p, q, n: plane_equations(p, q, n) * [1, 1, 1, 1, 1, 1, -1],
            ),
            Mistake(
                "turn before shift",
                "Which three unknowns come first?",
                lambda p, q, n: plane_equations(p, q, n)[:, [3, 4, 5, 0, 1, 2, 6]],
            ),
            Mistake(
                "distance of the points for the distance along the normal",
                "Point to plane measures along the normal only: that is why surfaces may slide.",
                lambda p, q, n: np.column_stack([plane_equations(p, q, n)[:, :6], np.linalg.norm(q - p, axis=1)]),
            ),
        ),
        unit="mm",
    ),
)


def _jumping(distances: Floats, t_e: float) -> Floats:
    return np.where(distances <= t_e, 0.5 * distances**2, t_e * distances)


def _exchanged(theta: float) -> float:
    return float(np.arctan2(np.cos(theta), np.sin(theta)))
