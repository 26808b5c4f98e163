"""Closed forms for hand-eye calibration: A X = X B by rotation vectors and by dual quaternions, points linearly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.geometry import angle_between, inverse, nearest_rotation, rigid, skew

Floats = NDArray[np.float64]

#: Motions that turn less (rad) say too little about the rotation to take part in a closed form.
MIN_ROTATION_RAD = 0.02


def rotation_rms(carrier: Floats) -> tuple[Floats, Floats]:
    """How far poses (N, 4, 4) turn about their mean: root mean squares (3,) in rad, falling, and their axes (3, 3).

    The axes, a row each, are in the frame that the poses carry.
    """
    mean = nearest_rotation(carrier[:, :3, :3].mean(axis=0))
    vectors = Rotation.from_matrix(mean.T @ carrier[:, :3, :3]).as_rotvec()
    _, singular, axes = np.linalg.svd(vectors - vectors.mean(axis=0))
    return np.pad(singular, (0, 3 - len(singular))) / np.sqrt(len(carrier)), axes


def pair_motions(carrier: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Motions A, B (K, 4, 4) of A X = X B between all pairs of poses that turn enough."""
    first, second = np.triu_indices(len(carrier), 1)
    A = inverse(carrier[second]) @ carrier[first]
    B = target[second] @ inverse(target[first])
    turns = Rotation.from_matrix(A[:, :3, :3]).magnitude()
    chosen = turns >= min(MIN_ROTATION_RAD, float(np.median(turns)))
    return A[chosen], B[chosen]


def by_rotation_vectors(A: Floats, B: Floats) -> Floats:
    """X of A X = X B (K, 4, 4 each): the rotation that maps B's rotation vectors on A's, then the translation.

    Park and Martin 1994, with the rotation by singular values, which two axes suffice for.
    """
    alpha, beta = (Rotation.from_matrix(motions[:, :3, :3]).as_rotvec() for motions in (A, B))
    return _with_translation(A, B, nearest_rotation(alpha.T @ beta))


def by_dual_quaternions(A: Floats, B: Floats) -> Floats | None:
    """X of A X = X B (K, 4, 4 each) by dual quaternions (Daniilidis 1999); None where its equation has no root."""
    (q_a, d_a), (q_b, d_b) = _dual_quaternions(A), _dual_quaternions(B)
    turned, moved = _equations(q_a, q_b), _equations(d_a, d_b)
    rows = np.concatenate([np.dstack([turned, np.zeros_like(turned)]), np.dstack([moved, turned])])
    *_, right = np.linalg.svd(rows.reshape(-1, 8))
    u1, v1, u2, v2 = right[-2, :4], right[-2, 4:], right[-1, :4], right[-1, 4:]
    roots = np.roots([u1 @ v1, u1 @ v2 + u2 @ v1, u2 @ v2]) if abs(u1 @ v1) > 1e-15 else np.array([0.0])
    ratios = np.real(roots)
    if len(ratios) == 0:
        return None
    norms = ratios**2 * (u1 @ u1) + 2 * ratios * (u1 @ u2) + u2 @ u2
    ratio, norm = ratios[np.argmax(norms)], norms.max()
    if not norm > 1e-15:
        return None
    quaternion = (ratio * u1 + u2) / np.sqrt(norm)
    if np.linalg.norm(quaternion) < 1e-9:
        return None
    return _with_translation(A, B, Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix())


def starts_from_poses(carrier: Floats, target: Floats) -> tuple[list[Floats], tuple[float, float]]:
    """X by both closed forms, and how far apart they are, in degrees and mm."""
    A, B = pair_motions(carrier, target)
    first, second = by_rotation_vectors(A, B), by_dual_quaternions(A, B)
    return ([first], (np.nan, np.nan)) if second is None else ([first, second], _difference(first, second))


def starts_from_points(carrier: Floats, points: Floats) -> tuple[list[Floats], tuple[float, float]]:
    """Starts for X from a point seen by every pose: linear in all of X, and one rotation of the cube after another."""
    cube = [by_known_rotation(carrier, points, rotation) for rotation in Rotation.create_group("O").as_matrix()]
    best = [X for _, X in sorted(cube, key=lambda item: item[0])[:8]]
    linear = by_linear_equations(carrier, points)
    if linear is None:
        return best, (np.nan, np.nan)
    return [linear, *best], (np.nan, np.nan)


def by_linear_equations(carrier: Floats, points: Floats) -> Floats | None:
    """X of C_i X p_i = y, its twelve numbers free, then the nearest rigid one; None where they are not known."""
    n, rotation = len(carrier), carrier[:, :3, :3]
    if n < 5:
        return None
    design = np.zeros((n, 3, 15))
    design[:, :, :9] = np.einsum("nij,nk->nijk", rotation, points).reshape(n, 3, 9)
    design[:, :, 9:12], design[:, :, 12:] = rotation, -np.eye(3)
    scale = np.concatenate([np.full(9, 1 / max(np.abs(points).max(), 1e-9)), np.ones(6)])
    found, _, rank, _ = np.linalg.lstsq(design.reshape(-1, 15) * scale, -carrier[:, :3, 3].ravel(), rcond=1e-8)
    if rank < 15:
        return None
    matrix = (found * scale)[:9].reshape(3, 3)
    return by_known_rotation(carrier, points, nearest_rotation(matrix))[1]


def by_known_rotation(carrier: Floats, points: Floats, rotation: Floats) -> tuple[float, Floats]:
    """X with a given rotation (3, 3) and the translation that fits best, with its sum of squares."""
    turned = np.einsum("nij,nj->ni", carrier[:, :3, :3], points @ rotation.T) + carrier[:, :3, 3]
    design = np.concatenate([carrier[:, :3, :3], -np.broadcast_to(np.eye(3), (len(carrier), 3, 3))], axis=2)
    design = design.reshape(-1, 6)
    found = np.linalg.lstsq(design, -turned.ravel(), rcond=1e-10)[0]
    left = design @ found + turned.ravel()
    return float(left @ left), rigid(rotation, found[:3])


def _with_translation(A: Floats, B: Floats, rotation: Floats) -> Floats:
    """(R_A - I) t_X = R_X t_B - t_A by least squares."""
    design = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = B[:, :3, 3] @ rotation.T - A[:, :3, 3]
    return rigid(rotation, np.linalg.lstsq(design, right.ravel(), rcond=1e-10)[0])


def _dual_quaternions(motions: Floats) -> tuple[Floats, Floats]:
    """Real and dual parts (K, 4) of motions (K, 4, 4), scalar first, with the scalar not negative."""
    real = Rotation.from_matrix(motions[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    real = np.where(real[:, :1] >= 0, real, -real)
    t, w, v = motions[:, :3, 3], real[:, :1], real[:, 1:]
    return real, 0.5 * np.hstack([-(t * v).sum(axis=1, keepdims=True), w * t + np.cross(t, v)])


def _equations(a: Floats, b: Floats) -> Floats:
    """What one part of two motions' quaternions (K, 4) asks of the same part of X, (K, 3, 4)."""
    return np.dstack([(a - b)[:, 1:, None], skew((a + b)[:, 1:])])


def _difference(a: Floats, b: Floats) -> tuple[float, float]:
    return float(np.degrees(angle_between(a, b))), float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
