"""Exercises to chapter 03, calibrating scanner and arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision import geometry
from grindvision.arm import MdhArm, link_transforms
from grindvision.calibration import analyse
from grindvision_book.exercises.cases import poses
from grindvision_book.exercises.checking import Exercise, Function, Mistake

Floats = NDArray[np.float64]


def _triangles(rng: np.random.Generator) -> list[tuple[Floats, ...]]:
    return [tuple(rng.normal(0, 80, (3, 3)) + rng.normal(0, 300, 3)) for _ in range(6)]


def triangle_frame(o: Floats, a: Floats, b: Floats) -> Floats:
    """Frame at o with x towards a and z normal to the triangle."""
    x = (a - o) / np.linalg.norm(a - o)
    z = np.cross(x, b - o)
    z /= np.linalg.norm(z)
    return geometry.rigid(np.column_stack([x, np.cross(z, x), z]), o)


def _axes_changed(change: Floats) -> Function:
    return lambda o, a, b: triangle_frame(o, a, b) @ change


def _skewed_frame(o: Floats, a: Floats, b: Floats) -> Floats:
    x, y = ((p - o) / np.linalg.norm(p - o) for p in (a, b))
    z = np.cross(x, y)
    return geometry.rigid(np.column_stack([x, y, z / np.linalg.norm(z)]), o)


def _long_axes(o: Floats, a: Floats, b: Floats) -> Floats:
    z = np.cross(a - o, b - o)
    return geometry.rigid(np.column_stack([a - o, np.cross(z, a - o), z]), o)


def _three_spheres(rng: np.random.Generator) -> list[tuple[Floats, ...]]:
    cases: list[tuple[Floats, ...]] = []
    for T_base_joint4, T_joint4_scanner in zip(poses(rng, 5), poses(rng, 5, 100.0), strict=True):
        scanner = rng.normal(0, 80, (3, 3)) + [0, 0, 400]
        cases.append((T_base_joint4, scanner, geometry.move_points(T_base_joint4 @ T_joint4_scanner, scanner)))
    return cases


def hand_eye(T_base_joint4: Floats, scanner: Floats, base: Floats) -> Floats:
    """Eq 8."""
    return geometry.inverse(T_base_joint4) @ triangle_frame(*base) @ geometry.inverse(triangle_frame(*scanner))


def _links(rng: np.random.Generator) -> list[tuple[float, ...]]:
    angles, lengths = rng.uniform(-1.4, 1.4, (6, 2)), rng.uniform(50, 300, (6, 2))
    return [
        (float(al), float(a), float(d), float(th), 0.02 * k)
        for k, ((al, th), (a, d)) in enumerate(zip(angles, lengths, strict=True), start=1)
    ]


def link(alpha_rad: float, a_mm: float, d_mm: float, theta_rad: float, beta_rad: float) -> Floats:
    """One row of the modified table."""
    return link_transforms(MdhArm(np.array([[alpha_rad, a_mm, d_mm, theta_rad, beta_rad]]), ("joint",)), [0.0])[0]


def _turn(axis: int, angle: float) -> Floats:
    return geometry.rigid(geometry.rotation_about(np.eye(3)[axis], angle))


def _shift(axis: int, length: float) -> Floats:
    return geometry.rigid(None, np.eye(3)[axis] * length)


def _designs(rng: np.random.Generator) -> list[tuple[Floats, Floats, float]]:
    cases = []
    for spectrum in ([900, 40, 2, 3e-2, 4e-6, 0], [80, 50, 30, 4e-4, 1e-5, 1e-9], [5, 1, 8e-2, 1e-3, 1e-7, 1e-8]):
        rows = np.linalg.qr(rng.normal(size=(30, 6)))[0]
        units = np.array([1.0, 1.0, 1.0, 1 / 500, 1 / 500, 1 / 500])
        turned = geometry.random_rotation(rng), geometry.random_rotation(rng)
        columns = np.block([[turned[0], np.zeros((3, 3))], [np.zeros((3, 3)), turned[1]]])
        cases.append((rows * np.array(spectrum) @ columns / units, units, 1e-6))
    return cases


def known_combinations(design: Floats, units: Floats, tolerance: float) -> int:
    """Rank of the scaled design."""
    return analyse(design, tuple(f"u{k}_mm" for k in range(len(units))), units, tolerance=tolerance).rank


def _count(values: Floats, least: float) -> int:
    return int((values > least).sum())


def _values(matrix: Floats) -> Floats:
    return np.asarray(np.linalg.svd(matrix, compute_uv=False), dtype=np.float64)


EXERCISES = (
    Exercise(
        "03-1",
        "The other way round",
        geometry.inverse,
        lambda rng: [(pose,) for pose in poses(rng, 5)],
        (
            Mistake(
                "the whole 4x4 matrix transposed",
                "Its last row is no longer 0 0 0 1. Which block of the matrix may be transposed, and where does the "
                "shift belong?",
                np.transpose,
            ),
            Mistake(
                "shift negated but not turned",
                "The shift you were given is told in frame a. In which frame must the shift of T_b_a be told?",
                lambda T_a_b: geometry.rigid(T_a_b[:3, :3].T, -T_a_b[:3, 3]),
            ),
            Mistake(
                "shift turned with the wrong rotation",
                "The rotation block is right. Look at which of the two rotations brings the shift from a to b.",
                lambda T_a_b: geometry.rigid(T_a_b[:3, :3].T, -T_a_b[:3, :3] @ T_a_b[:3, 3]),
            ),
            Mistake(
                "rotation not transposed",
                "The way back must undo the turn as well. What is the inverse of a rotation?",
                lambda T_a_b: geometry.rigid(T_a_b[:3, :3], -T_a_b[:3, 3]),
            ),
            Mistake(
                "sign of the shift",
                "Send the origin of frame b there and back with your result: does it come back to zero?",
                lambda T_a_b: geometry.rigid(T_a_b[:3, :3].T, T_a_b[:3, :3].T @ T_a_b[:3, 3]),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "03-2",
        "A frame in a triangle",
        triangle_frame,
        _triangles,
        (
            Mistake(
                "transposed rotation",
                "The axes stand in rows. Where does T_scanner_part @ [1, 0, 0, 0] point, and where should it?",
                lambda o, a, b: geometry.rigid(triangle_frame(o, a, b)[:3, :3].T, o),
            ),
            Mistake(
                "axes not perpendicular",
                "The triangle's corner at o is not a right angle, so b does not lie on the y axis. Which axis can be "
                "had from the other two?",
                _skewed_frame,
            ),
            Mistake(
                "axes not of length one",
                "The axes point the right way. How long is a column of a rotation matrix?",
                _long_axes,
            ),
            Mistake(
                "sign of the normal",
                "z points to the other side of the triangle. Look at the order in your cross product.",
                _axes_changed(np.diag([1.0, -1, -1, 1])),
            ),
            Mistake(
                "reflection",
                "The determinant of your axes is -1: a left-handed frame. Check y against z x x.",
                _axes_changed(np.diag([1.0, -1, 1, 1])),
            ),
            Mistake(
                "origin in the centroid",
                "The axes are right; the origin is asked for in another place than the middle of the triangle.",
                lambda o, a, b: geometry.rigid(triangle_frame(o, a, b)[:3, :3], (o + a + b) / 3),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "03-3",
        "Hand-eye transform from one pose (Eq 8)",
        hand_eye,
        _three_spheres,
        (
            Mistake(
                "inverse transform: the wrong frame direction",
                "You have T_scanner_joint4. Which of the two names must stand first?",
                lambda *case: geometry.inverse(hand_eye(*case)),
            ),
            Mistake(
                "pose of the arm not inverted",
                "Chain the names like dominoes: your result would need joint 4 where T_base_joint4 brings the base.",
                lambda T, s, b: T @ triangle_frame(*b) @ geometry.inverse(triangle_frame(*s)),
            ),
            Mistake(
                "scanner and base exchanged",
                "Which triangle is told in the scanner's frame, and does its frame come first or last in the chain?",
                lambda T, s, b: geometry.inverse(T) @ triangle_frame(*s) @ geometry.inverse(triangle_frame(*b)),
            ),
            Mistake(
                "frame of the scanner's triangle not inverted",
                "T_scanner_part ends in the scanner's frame; the chain needs to come from it.",
                lambda T, s, b: geometry.inverse(T) @ triangle_frame(*b) @ triangle_frame(*s),
            ),
            Mistake(
                "pose of the arm left out",
                "That is the scanner seen from the base. Where is the joint?",
                lambda T, s, b: triangle_frame(*b) @ geometry.inverse(triangle_frame(*s)),
            ),
            Mistake(
                "order of the product",
                "All three factors are right. A product of transforms is read from the right: which acts first?",
                lambda T, s, b: geometry.inverse(triangle_frame(*s)) @ triangle_frame(*b) @ geometry.inverse(T),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "03-4",
        "One row of a modified DH table",
        link,
        _links,
        (
            Mistake(
                "standard DH for modified DH",
                "In the modified convention alpha and a belong to the joint before: which turn comes first?",
                lambda al, a, d, th, be: _turn(2, th) @ _shift(2, d) @ _shift(0, a) @ _turn(0, al) @ _turn(1, be),
            ),
            Mistake(
                "tilt beta behind the joint",
                "Everything else is right. Chapter 03 says on which side of the joint's turn the tilt must stand.",
                lambda al, a, d, th, be: _turn(0, al) @ _shift(0, a) @ _turn(2, th) @ _shift(2, d) @ _turn(1, be),
            ),
            Mistake(
                "tilt beta left out",
                "Right for beta = 0. Five parameters go in.",
                lambda al, a, d, th, be: link(al, a, d, th, 0.0),
            ),
            Mistake(
                "degrees for radians",
                "The names of the angles end in _rad. What do np.cos and Rotation.from_euler(degrees=...) take?",
                lambda *row: _in_degrees(*row),
            ),
            Mistake(
                "inverse transform: the wrong frame direction",
                "This brings points of the joint before into the joint after. Which way does T_before_after go?",
                lambda *row: geometry.inverse(link(*row)),
            ),
            Mistake(
                "transposed rotations",
                "Every turn has the wrong sense. Where does the minus stand in the matrix of a turn about z?",
                lambda al, a, d, th, be: _turn(0, -al) @ _shift(0, a) @ _turn(1, -be) @ _turn(2, -th) @ _shift(2, d),
            ),
        ),
        unit="mm",
    ),
    Exercise(
        "03-5",
        "What can be known?",
        known_combinations,
        _designs,
        (
            Mistake(
                "columns in mm and rad compared as they come",
                "The units do nothing in your function. What does a column count in before, and after, scaling?",
                lambda design, units, tolerance: _count(_values(design), tolerance * _values(design)[0]),
            ),
            Mistake(
                "divided by the units",
                "An unknown counted in smaller units has a smaller slope per unit. Multiply, or divide?",
                lambda design, units, tolerance: _count(
                    _values(design / units), tolerance * _values(design / units)[0]
                ),
            ),
            Mistake(
                "absolute tolerance",
                "A singular value is small against something. Against what?",
                lambda design, units, tolerance: _count(_values(design * units), tolerance),
            ),
            Mistake(
                "squared singular values",
                "Eigenvalues of A^T A are squares of the singular values: half of the digits are gone, and so is the "
                "meaning of the tolerance.",
                lambda design, units, tolerance: _count(
                    _values(design * units) ** 2, tolerance * _values(design * units)[0] ** 2
                ),
            ),
            Mistake(
                "everything that is not exactly zero counts",
                "A computer rounds: a value of 1e-9 is not zero, but does it mean anything?",
                lambda design, units, tolerance: _count(_values(design * units), 0.0),
            ),
            Mistake(
                "counted what cannot be known",
                "You count the small ones. How many unknowns are there, and how many are asked for?",
                lambda design, units, tolerance: len(units) - known_combinations(design, units, tolerance),
            ),
        ),
    ),
)


def _in_degrees(alpha: float, a: float, d: float, theta: float, beta: float) -> Floats:
    alpha, theta, beta = np.radians([alpha, theta, beta])
    return link(alpha, a, d, theta, beta)
