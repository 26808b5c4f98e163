"""What the three numbers called normals in Table 4 of diao2018 may be: every usual reading tried, with what it leaves.

Each reading is tested with the unknown fixed rotations left free, so that a wrong guess of the frame cannot hide a
right guess of the reading.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from grindvision.geometry import fit_rigid, rotate_vectors, vector_angle

Floats = NDArray[np.float64]

#: Half of the last printed digit of a normal's component.
HALF_DIGIT = 5e-5

_SIGNS = tuple(product((1.0, -1.0), repeat=3))
_TURNS = ["".join(axes) for axes in permutations("xyz")] + [a + b + a for a, b in permutations("xyz", 2)]


def tried_readings(normals_scanner: ArrayLike, triples_base: ArrayLike, T_base_scanner: ArrayLike) -> pd.DataFrame:
    """Test families of readings that lead from the normals of Table 3 (N, 3) to the triples of Table 4 (N, 3).

    Returns:
        ``reading, tried, free_numbers, left_rms``: members of the family tried, numbers fitted in each, and the rms
        that the best member leaves per component, in rad or, the same for small angles, in units of a unit vector.
    """
    n3, n4 = np.asarray(normals_scanner, dtype=float), np.asarray(triples_base, dtype=float)
    unit = n3 / np.linalg.norm(n3, axis=1, keepdims=True)
    as_angles = _orientations(n4)
    rows = [
        (
            "the normal turned by T_base_scanner, any signs",
            8,
            0,
            min(_turned(n3 * s, n4, T_base_scanner) for s in _SIGNS),
        ),
        ("any rotation and any shift of the normal", 2, 6, min(_moved(n3 * s, n4) for s in ((1, 1, 1), (1, 1, -1)))),
        ("each number the arc of a component of the turned normal", *_arcs(unit, n4, T_base_scanner)),
        ("angles of a frame that has the normal as an axis", 6 * len(as_angles), 3, _axis_of(as_angles, unit)),
        ("both triples angles of a frame, moved by any rotations", *_frames_apart(_orientations(n3), as_angles)),
        ("angles of a frame set on the normal", *_frames_apart(_set_on(unit, T_base_scanner), as_angles)),
        ("any affine function of the normal", 1, 12, _affine(n3, n4)),
    ]
    return pd.DataFrame(rows, columns=["reading", "tried", "free_numbers", "left_rms"])


def _turned(normals: Floats, triples: Floats, T_base_scanner: ArrayLike) -> float:
    return _rms(rotate_vectors(T_base_scanner, normals) - triples)


def _moved(normals: Floats, triples: Floats) -> float:
    return _rms(fit_rigid(normals, triples).residuals_mm)


def _affine(normals: Floats, triples: Floats) -> float:
    design = np.column_stack([normals, np.ones(len(normals))])
    return _rms(design @ np.linalg.lstsq(design, triples, rcond=None)[0] - triples)


def _arcs(normals: Floats, triples: Floats, T_base_scanner: ArrayLike) -> tuple[int, int, float]:
    """Each number as arccos, arcsin or arctan of the turned normal's components, plus any number of right angles."""
    left = []
    for signs in _SIGNS:
        x = rotate_vectors(T_base_scanner, normals * signs)
        arcs = [f(x[:, i]) for f in (np.arccos, np.arcsin) for i in range(3)]
        arcs += [np.arctan2(x[:, i], x[:, j]) for i, j in permutations(range(3), 2)]
        off = triples[None] - np.array([sign * arc for arc in arcs for sign in (1, -1)])[:, :, None]
        off -= np.pi / 2 * np.round(off.mean(axis=1, keepdims=True) / (np.pi / 2))
        left.append(np.sqrt((off**2).mean(axis=1)))
    best = np.array(left).reshape(-1, 3).min(axis=0)
    return np.array(left).size, 0, float(np.sqrt((best**2).mean()))


def _axis_of(frames: Floats, normals: Floats) -> float:
    """Smallest rms between an axis (column or row) of the frames (K, N, 3, 3) and the normals, one rotation between."""
    axes = np.concatenate([np.moveaxis(frames, -1, 1), np.moveaxis(frames, -2, 1)], axis=1).reshape(-1, *normals.shape)
    u, _, vt = np.linalg.svd(np.swapaxes(axes, 1, 2) @ normals)
    angles = vector_angle(np.einsum("kij,nj->kni", u @ vt, normals), axes)
    return float(np.sqrt((angles**2).mean(axis=1) / 3).min())


def _frames_apart(frames_a: Floats, frames_b: Floats) -> tuple[int, int, float]:
    """Smallest rms difference of the turns from point to point: no fixed rotation before or behind changes those."""
    difference = _turns(frames_a)[:, None] - _turns(frames_b)[None]
    return len(frames_a) * len(frames_b), 6, float(np.sqrt((difference**2).mean(axis=-1) / 3).min())


def _turns(frames: Floats) -> Floats:
    """Angles (K, N (N - 1) / 2) between the frames of every pair of points, for frames (K, N, 3, 3)."""
    first, second = np.triu_indices(frames.shape[1], 1)
    relative = np.swapaxes(frames[:, first], -1, -2) @ frames[:, second]
    return Rotation.from_matrix(relative.reshape(-1, 3, 3)).magnitude().reshape(len(frames), -1)


def _orientations(triples: Floats) -> Floats:
    """Frames (K, N, 3, 3) of three numbers as fixed or moving Euler angles in any order, rotation vector, or MRP."""
    frames = []
    for order, signs in product(permutations(range(3)), _SIGNS):
        numbers = triples[:, order] * signs
        frames += [Rotation.from_euler(axes, numbers) for turn in _TURNS for axes in (turn, turn.upper())]
        frames += [Rotation.from_rotvec(numbers), Rotation.from_mrp(numbers)]
    return _distinct(frame.as_matrix() for frame in frames)


def _set_on(normals: Floats, T_base_scanner: ArrayLike) -> Floats:
    """Frames (K, N, 3, 3) with an axis along the normal, by the shortest turn or towards an axis of scanner or base."""
    frames = []
    for signs, T in product(_SIGNS, (np.eye(4), np.asarray(T_base_scanner, dtype=float))):
        along = rotate_vectors(T, normals * signs)
        for axis in np.eye(3):
            turn = np.cross(axis, along)
            angle = vector_angle(axis, along)[:, None]
            frames.append(Rotation.from_rotvec(turn / np.linalg.norm(turn, axis=1, keepdims=True) * angle).as_matrix())
            side = np.cross(along, axis)
            side /= np.linalg.norm(side, axis=1, keepdims=True)
            frames.append(np.stack([np.cross(side, along), side, along], axis=-1))
    return _distinct(frames)


def _distinct(frames: Iterator[Floats] | list[Floats]) -> Floats:
    return np.array(list({np.round(frame, 9).tobytes(): frame for frame in frames}.values()))


def _rms(differences: Floats) -> float:
    return float(np.sqrt((differences**2).mean()))
