"""Exercises to chapter 14, hand-eye without a tracker."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.calibration.hand_eye_starts import by_rotation_vectors
from grindvision.geometry import inverse, nearest_rotation, rigid, rotation_about
from grindvision_book.exercises.cases import poses, units
from grindvision_book.exercises.checking import Exercise, Mistake

Floats = NDArray[np.float64]


def motions(C_1: Floats, C_2: Floats, P_1: Floats, P_2: Floats) -> Floats:
    """A and B of A X = X B."""
    return np.array([inverse(C_2) @ C_1, P_2 @ inverse(P_1)])


def _pose_pairs(rng: np.random.Generator) -> list[tuple[Floats, Floats, Floats, Floats]]:
    drawn = [poses(rng, 4) for _ in range(4)]
    return [(C_1, C_2, P_1, P_2) for C_1, C_2, P_1, P_2 in drawn]


def _motions(rng: np.random.Generator, count: int = 5) -> tuple[Floats, Floats]:
    """Exact motions (count, 4, 4) of flange and camera."""
    turns = [
        rotation_about(axis, angle) for axis, angle in zip(units(rng, count), rng.uniform(0.3, 1.2, count), strict=True)
    ]
    B = np.array([rigid(turn, rng.normal(0, 100, 3)) for turn in turns])
    (X,) = poses(rng, 1, 80.0)
    return X @ B @ inverse(X), B


def _pairs_of_motions(rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    return [_motions(rng) for _ in range(3)]


def solve_ax_xb(A: Floats, B: Floats) -> Floats:
    """X by rotation vectors."""
    return by_rotation_vectors(A, B)


def _solved(A: Floats, B: Floats, turned: Floats | None = None, sign: float = 1.0, identity: float = 1.0) -> Floats:
    """The solution with a mistake: another rotation, the shift's sign, or (R_A - I) without I."""
    rotation = solve_ax_xb(A, B)[:3, :3] if turned is None else turned
    left = (A[:, :3, :3] - identity * np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ rotation.T - A[:, :3, 3]).ravel()
    return rigid(rotation, sign * np.linalg.lstsq(left, right, rcond=None)[0])


def _unturned(A: Floats, B: Floats) -> Floats:
    """The camera's shifts left in its own frame."""
    rotation = solve_ax_xb(A, B)[:3, :3]
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    return rigid(rotation, np.linalg.lstsq(left, (B[:, :3, 3] - A[:, :3, 3]).ravel(), rcond=None)[0])


def _other_pairs(rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    """Pairs of motions, some of which do not belong together."""
    A, B = _motions(rng, 4)
    return [(A[0], B[0]), (A[1], B[2]), (A[2], B[1]), (A[3], B[3])]


def screw(motion: Floats) -> Floats:
    """Angle (deg) and pitch (mm) of a motion, (2,)."""
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    angle = np.linalg.norm(turn)
    return np.array([np.degrees(angle), motion[:3, 3] @ turn / angle])


def disagreement(A: Floats, B: Floats) -> Floats:
    """Angle and pitch of A less those of B."""
    return screw(A) - screw(B)


def _with_length(motion: Floats) -> Floats:
    return np.array([screw(motion)[0], np.linalg.norm(motion[:3, 3])])


def _in_radians(A: Floats, B: Floats) -> Floats:
    angle, pitch = disagreement(A, B)
    return np.array([np.radians(angle), pitch])


def _not_unit(motion: Floats) -> Floats:
    angle, pitch = screw(motion)
    return np.array([angle, pitch * np.radians(angle)])


EXERCISES = (
    Exercise(
        "14-1",
        "Two poses make a motion",
        motions,
        _pose_pairs,
        (
            Mistake(
                "A and B run opposite ways",
                "One of your motions goes from the first pose to the second, the other back. Write down their frames.",
                lambda C_1, C_2, P_1, P_2: np.array([inverse(C_2) @ C_1, P_1 @ inverse(P_2)]),
            ),
            Mistake(
                "both motions inverted",
                "A pair that fits, but from the second pose to the first. What does the task say A takes where?",
                lambda C_1, C_2, P_1, P_2: np.array([inverse(C_1) @ C_2, P_1 @ inverse(P_2)]),
            ),
            Mistake(
                "motions of the base's and the target's frames",
                "X must stand between A and B: the flange's frame on its left, the camera's on its right.",
                lambda C_1, C_2, P_1, P_2: np.array([C_2 @ inverse(C_1), inverse(P_2) @ P_1]),
            ),
            Mistake(
                "transposed instead of inverted",
                "A 4x4 matrix is no rotation: what happens to its last column?",
                lambda C_1, C_2, P_1, P_2: np.array([C_2.T @ C_1, P_2 @ P_1.T]),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "14-2",
        "A X = X B by hand",
        solve_ax_xb,
        _pairs_of_motions,
        (
            Mistake(
                "rotation the wrong way round",
                "Which vectors does R_X turn, and onto which? Try your rotation on one pair.",
                lambda A, B: _solved(A, B, solve_ax_xb(A, B)[:3, :3].T),
            ),
            Mistake(
                "shift with the wrong sign",
                "Your rotation is right. Put your shift into (R_A - I) t_X = R_X t_B - t_A.",
                lambda A, B: _solved(A, B, sign=-1.0),
            ),
            Mistake(
                "identity left out",
                "Your rotation is right. A motion that does not turn says nothing of the shift; in yours it does.",
                lambda A, B: _solved(A, B, identity=0.0),
            ),
            Mistake(
                "camera's shifts not turned",
                "Your rotation is right. In which frame is t_B, and in which is t_A?",
                _unturned,
            ),
            Mistake(
                "X inverted",
                "You have T_camera_flange.",
                lambda A, B: inverse(solve_ax_xb(A, B)),
            ),
            Mistake(
                "rotation matrices in the place of rotation vectors",
                "The sum of R_A R_B^T is no fit of X: the matrices' columns are not what X turns into each other.",
                lambda A, B: _solved(A, B, nearest_rotation((A[:, :3, :3] @ B[:, :3, :3].swapaxes(1, 2)).sum(axis=0))),
            ),
        ),
        unit="mm",
        tolerance=1e-7,
    ),
    Exercise(
        "14-3",
        "Does this pair belong together?",
        disagreement,
        _other_pairs,
        (
            Mistake(
                "length of the shift for the pitch",
                "The length of a shift depends on where the camera sits. Only its part along the axis does not.",
                lambda A, B: _with_length(A) - _with_length(B),
            ),
            Mistake(
                "angle in radians",
                "The pitch is right; the angle is asked for in degrees.",
                _in_radians,
            ),
            Mistake(
                "axis not of length one",
                "A rotation vector is as long as its angle. What does the product with it measure?",
                lambda A, B: _not_unit(A) - _not_unit(B),
            ),
            Mistake(
                "one axis for both",
                "Each motion has its own axis, in its own frame.",
                lambda A, B: np.array([disagreement(A, B)[0], (A[:3, 3] - B[:3, 3]) @ _axis(A)]),
            ),
        ),
        tolerance=1e-7,
    ),
)


def _axis(motion: Floats) -> Floats:
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return turn / np.linalg.norm(turn)
