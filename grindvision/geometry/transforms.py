"""Rigid transforms as 4x4 matrices: ``T_base_joint @ p_joint = p_base``, translations in millimetres."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError, NotRigidError

Floats = NDArray[np.float64]


def rigid(rotation: ArrayLike | None = None, translation_mm: ArrayLike | None = None) -> Floats:
    """Build a transform (4, 4) from a rotation matrix (3, 3) and a translation (3,); either may be left out."""
    transform = np.eye(4)
    if rotation is not None:
        transform[:3, :3] = rotation
    if translation_mm is not None:
        transform[:3, 3] = translation_mm
    return transform


def inverse(transform: ArrayLike) -> Floats:
    """Invert one rigid transform (4, 4) or a stack of them (..., 4, 4)."""
    transform = np.asarray(transform, dtype=float)
    rotation_t = np.swapaxes(transform[..., :3, :3], -1, -2)
    result = np.zeros_like(transform)
    result[..., :3, :3] = rotation_t
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation_t, transform[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def move_points(T_to_from: ArrayLike, points_from: ArrayLike) -> Floats:
    """Express points (..., 3) given in frame ``from`` in frame ``to``."""
    transform = np.asarray(T_to_from, dtype=float)
    return np.asarray(points_from, dtype=float) @ transform[:3, :3].T + transform[:3, 3]


def rotate_vectors(T_to_from: ArrayLike, vectors_from: ArrayLike) -> Floats:
    """Express directions such as normals (..., 3) given in frame ``from`` in frame ``to``; no translation."""
    return np.asarray(vectors_from, dtype=float) @ np.asarray(T_to_from, dtype=float)[:3, :3].T


def angle_between(rotation_a: ArrayLike, rotation_b: ArrayLike) -> float:
    """Angle in radians, 0..pi, of the rotation that leads from one rotation (3, 3) or transform (4, 4) to another."""
    a = np.asarray(rotation_a, dtype=float)[:3, :3]
    b = np.asarray(rotation_b, dtype=float)[:3, :3]
    relative = nearest_rotation(a.T @ b)
    return float(
        2 * np.arctan2(np.linalg.norm(relative - np.eye(3)), np.sqrt(8 * max(np.trace(relative) / 4 + 0.25, 0.0)))
    )


def vector_angle(a: ArrayLike, b: ArrayLike) -> Floats:
    """Angle in radians, 0..pi, between vectors (..., 3); exact for small and for nearly opposite ones.

    A zero vector has no direction: the result there is NaN.
    """
    a, b = np.broadcast_arrays(np.asarray(a, dtype=float), np.asarray(b, dtype=float))
    norm_a, norm_b = np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit_a, unit_b = a / norm_a[..., None], b / norm_b[..., None]
    return 2 * np.arctan2(np.linalg.norm(unit_a - unit_b, axis=-1), np.linalg.norm(unit_a + unit_b, axis=-1))


def unit_vectors(vectors: ArrayLike) -> Floats:
    """Vectors (..., 3) at length one; one of no length stays near zero."""
    vectors = np.asarray(vectors, dtype=float)
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def nearest_rotation(matrix: ArrayLike) -> Floats:
    """Return the rotation matrix (3, 3) nearest to ``matrix`` in the Frobenius norm (SVD, reflection guarded)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=float))
    u[:, -1] *= np.sign(np.linalg.det(u @ vt))
    return u @ vt


def orthonormalised(transform: ArrayLike) -> Floats:
    """Return ``transform`` (4, 4) with its rotation replaced by the nearest true one, as for printed matrices."""
    transform = np.asarray(transform, dtype=float)
    return rigid(nearest_rotation(transform[:3, :3]), transform[:3, 3])


def check_rigid(transform: ArrayLike, name: str, tolerance: float = 1e-6) -> Floats:
    """Return ``transform`` as a float array (4, 4) if it is rigid to ``tolerance``.

    Raises:
        NotRigidError: wrong shape, NaN, last row other than 0 0 0 1, a reflection, or a rotation block that is not
            orthonormal; the message carries ``name`` and the deviation.
    """
    try:
        matrix = np.array(transform, dtype=float)
    except (TypeError, ValueError):
        raise NotRigidError(f"{name} is not a 4x4 matrix of numbers") from None
    if matrix.shape != (4, 4):
        raise NotRigidError(f"{name} has shape {matrix.shape}; a rigid transform is a 4x4 matrix")
    if not np.isfinite(matrix).all():
        raise NotRigidError(f"{name} holds NaN or infinity; every entry must be a finite number")
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > tolerance:
        raise NotRigidError(f"{name} ends in the row {matrix[3].tolist()}; it must be 0 0 0 1 (is it transposed?)")
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise NotRigidError(f"{name} is a reflection (determinant below 0); swap or negate one axis")
    deviation = np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max()
    if deviation > tolerance:
        raise NotRigidError(
            f"{name} is not a rotation: R R^T differs from the identity by {deviation:.2g}, allowed {tolerance:.2g};"
            " use geometry.orthonormalised if it was rounded in print"
        )
    return matrix


def mean_rigid(transforms: ArrayLike) -> Floats:
    """Average transforms (N, 4, 4): chordal mean of the rotations, arithmetic mean of the translations."""
    transforms = np.asarray(transforms, dtype=float)
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or len(transforms) == 0:
        raise InputError(f"a mean needs transforms of shape (N, 4, 4) with N >= 1, got {transforms.shape}")
    return rigid(nearest_rotation(transforms[:, :3, :3].mean(axis=0)), transforms[:, :3, 3].mean(axis=0))


def skew(vectors: ArrayLike) -> Floats:
    """Cross-product matrices (..., 3, 3): ``skew(a) @ b = a x b``."""
    v = np.asarray(vectors, dtype=float)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape[:-1], 3, 3)


def motion_columns(points: ArrayLike) -> Floats:
    """How a small motion (6,), translation first and then rotation vector about the origin, moves points (..., 3):
    matrices (..., 3, 6)."""
    points = np.asarray(points, dtype=float)
    return np.concatenate([np.broadcast_to(np.eye(3), (*points.shape, 3)), -skew(points)], axis=-1)


def rotation_about(axis: ArrayLike, angle_rad: float) -> Floats:
    """Rotation matrix (3, 3) by ``angle_rad`` about ``axis`` (3,), of any length but zero."""
    axis = np.asarray(axis, dtype=float)
    length = np.linalg.norm(axis)
    if not length > 0:
        raise InputError("a rotation axis of length zero has no direction")
    return _rotation(axis / length * angle_rad)


def small_motion(twist: ArrayLike) -> Floats:
    """Rigid transform (4, 4) of a twist (6,): translation in mm, then rotation vector in rad, not coupled."""
    twist = np.asarray(twist, dtype=float)
    return rigid(_rotation(twist[3:]), twist[:3])


def twist_between(T_from: ArrayLike, T_to: ArrayLike, centre_mm: ArrayLike) -> Floats:
    """The motion (6,) that leads from one pose (4, 4) to another: translation in mm of the point ``centre_mm`` (3,),
    which the first pose has moved there, then rotation vector in rad; the inverse of ``small_motion`` about it."""
    motion = np.asarray(T_to, dtype=float) @ inverse(T_from)
    centre = np.asarray(centre_mm, dtype=float)
    matrix = motion[:3, :3]
    sense = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
    sine, cosine = float(np.linalg.norm(sense)), (np.trace(matrix) - 1) / 2
    angle = np.arctan2(sine, cosine)
    rotation = rotation_axis(matrix) * angle if cosine < 0 else sense * (angle / sine if sine > 0 else 1.0)
    return np.concatenate([matrix @ centre + motion[:3, 3] - centre, rotation])


def random_rotation(rng: np.random.Generator) -> Floats:
    """Rotation matrix (3, 3) drawn uniformly from all rotations."""
    from scipy.spatial.transform import Rotation

    return Rotation.random(rng=rng).as_matrix()


def rotation_axis(rotation: ArrayLike) -> Floats:
    """Unit vector (3,) about which a rotation (3, 3) turns by an angle of 0..pi; any one for no rotation at all."""
    matrix = np.asarray(rotation, dtype=float)
    axis = np.linalg.svd(matrix - np.eye(3))[2][2]
    sense = axis @ [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    return -axis if sense < 0 else axis


def _rotation(vector: Floats) -> Floats:
    """Rotation matrix (3, 3) about a vector (3,) by its length in radians (Rodrigues)."""
    angle, across = np.linalg.norm(vector), skew(vector)
    return np.eye(3) + np.sinc(angle / np.pi) * across + np.sinc(angle / (2 * np.pi)) ** 2 / 2 * across @ across
