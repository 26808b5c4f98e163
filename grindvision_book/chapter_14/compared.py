"""Studies of chapter 14: with a tracker and without, closed forms against least squares, motions that are too alike."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.calibration.hand_eye import HandEye, hand_eye
from grindvision.calibration.hand_eye_starts import by_dual_quaternions, by_rotation_vectors, pair_motions
from grindvision.errors import DegenerateError
from grindvision.geometry import fit_rigid, inverse, move_points
from grindvision_book.chapter_14.simulated import (
    T_BASE_TARGET,
    T_FLANGE_CAMERA,
    Errors,
    looking_poses,
    off_truth,
    shown_and_seen,
)

Floats = NDArray[np.float64]

METHODS = ("rotation vectors", "dual quaternions", "least squares")


def tracker_or_not(rng: np.random.Generator, sequences: int, poses: int, turn_deg: float) -> pd.DataFrame:
    """Errors of the camera's place from one sphere's centres: its place in the base known by a tracker, or unknown."""
    rows = []
    for sequence in range(sequences):
        shown, seen = shown_and_seen(rng, looking_poses(rng, poses, turn_deg), Errors())
        centres = seen[:, :3, 3]
        in_flange = np.array([move_points(inverse(pose), T_BASE_TARGET[:3, 3]) for pose in shown])
        known = fit_rigid(centres, in_flange).T_target_source
        for name, found in (("known", known), ("unknown", hand_eye(shown, centres).T_parent_camera)):
            off_mm, off_deg = off_truth(found)
            rows.append({"sequence": sequence, "sphere": name, "off_mm": off_mm, "off_deg": off_deg})
    return pd.DataFrame(rows)


def closed_or_least_squares(rng: np.random.Generator, sequences: int, poses: int, turn_deg: float) -> pd.DataFrame:
    """Errors of the camera's place by each of ``METHODS`` on the same poses of arm and target, a row each.

    ``inside``: of the six numbers of least squares, how many lie within two stated standard deviations.
    """
    rows = []
    for sequence in range(sequences):
        shown, seen = shown_and_seen(rng, looking_poses(rng, poses, turn_deg), Errors())
        A, B = pair_motions(shown, seen)
        found = hand_eye(shown, seen)
        closed = by_dual_quaternions(A, B)
        assert closed is not None, "these motions turn enough"
        places = (by_rotation_vectors(A, B), closed, found.T_parent_camera)
        for name, place in zip(METHODS, places, strict=True):
            off_mm, off_deg = off_truth(place)
            inside = within_two_sigma(found) if name == METHODS[-1] else np.nan
            rows.append({"sequence": sequence, "method": name, "off_mm": off_mm, "off_deg": off_deg, "inside": inside})
    return pd.DataFrame(rows)


def too_similar_motions(rng: np.random.Generator, turns_deg: list[float], sequences: int, poses: int) -> pd.DataFrame:
    """Median error of the camera's place, and what the fit states of it, for poses that turn by up to ``turns_deg``.

    ``refused``: share of the sequences whose motions were refused; where all were, the other numbers are NaN.
    """
    rows = []
    for turn_deg in turns_deg:
        off, stated, refused = [], [], 0
        for _ in range(sequences):
            shown, seen = shown_and_seen(rng, looking_poses(rng, poses, turn_deg), Errors())
            try:
                found = hand_eye(shown, seen)
            except DegenerateError:
                refused += 1
                continue
            off.append(off_truth(found.T_parent_camera)[0])
            stated.append(float(np.sqrt((found.sigma_mm**2).sum())))
        middle = (np.median(off), np.median(stated)) if off else (np.nan, np.nan)
        rows.append({"turn_deg": turn_deg, "off_mm": middle[0], "stated_mm": middle[1], "refused": refused / sequences})
    return pd.DataFrame(rows)


def within_two_sigma(found: HandEye) -> int:
    """How many of the camera's six coordinates lie within two stated standard deviations of the truth."""
    turn = Rotation.from_matrix(T_FLANGE_CAMERA[:3, :3] @ found.T_parent_camera[:3, :3].T).as_rotvec()
    off = np.concatenate([T_FLANGE_CAMERA[:3, 3] - found.T_parent_camera[:3, 3], turn])
    return int((np.abs(off) <= 2 * np.sqrt(np.diag(found.covariance))).sum())
