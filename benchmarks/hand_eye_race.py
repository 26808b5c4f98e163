"""What is raced for the camera's place on an arm: simulated poses of a board, with errors of camera and arm; the judge.

A sequence has 8 to 20 poses from which a camera on the flange looks at a board 0.3 to 0.6 m away. What the controller
shows differs from where the flange is, in place and rotation, and so does what the camera sees of the board, along its
axis more than across. The sizes of these errors are drawn anew for every sequence; no racer knows them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.racing import Arrays
from grindvision.geometry import angle_between, inverse, rigid

Floats = NDArray[np.float64]

SEQUENCES = 200
"""Sequences of a case."""

POSES = (8, 20)
"""Fewest and most poses of a sequence."""

ARM_MM, ARM_DEG, CAMERA_MM, CAMERA_DEG = (0.1, 0.5), (0.02, 0.1), (0.05, 0.3), (0.03, 0.2)
"""Least and greatest standard deviation along, or about, an axis; drawn for every sequence."""

ALONG_AXIS = 3.0
"""Error of the board's place along the camera's axis over that across it."""

WRONG_MM, WRONG_DEG = 20.0, 5.0
"""In the median of a case, a camera's place farther off has not been found."""


def simulated_sequence(rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """T_base_flange (N, 4, 4) as the controller shows it, T_camera_board (N, 4, 4) as seen, T_flange_camera (4, 4)."""
    T_flange_camera = rigid(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-120, 120, 3))
    T_base_board = rigid(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-600, 600, 3))
    count, max_deg = int(rng.integers(*POSES, endpoint=True)), rng.uniform(15, 40)
    arm_mm, arm_deg, camera_mm, camera_deg = (
        rng.uniform(*limits) for limits in (ARM_MM, ARM_DEG, CAMERA_MM, CAMERA_DEG)
    )
    turns = Rotation.from_rotvec(np.radians(rng.uniform(-max_deg, max_deg, (count, 3)))).as_matrix()
    places = np.column_stack([rng.uniform(-60, 60, (count, 2)), rng.uniform(300, 600, count)])
    T_camera_board = np.array([rigid(turn, place) for turn, place in zip(turns, places, strict=True)])
    T_base_flange = T_base_board @ inverse(T_camera_board) @ inverse(T_flange_camera)
    across = camera_mm * np.array([1.0, 1.0, ALONG_AXIS])
    shown = T_base_flange @ small_motions(rng, count, arm_mm * np.ones(3), arm_deg)
    seen = T_camera_board.copy()
    seen[:, :3, 3] += across * rng.normal(size=(count, 3))
    seen[:, :3, :3] = Rotation.from_rotvec(np.radians(camera_deg) * rng.normal(size=(count, 3))).as_matrix() @ turns
    return shown, seen, T_flange_camera


def small_motions(rng: np.random.Generator, count: int, sizes_mm: Floats, size_deg: float) -> Floats:
    """Random motions (count, 4, 4) of these standard deviations along (3,) and about the axes."""
    turns = Rotation.from_rotvec(np.radians(size_deg) * rng.normal(size=(count, 3))).as_matrix()
    shifts = sizes_mm * rng.normal(size=(count, 3))
    return np.array([rigid(turn, shift) for turn, shift in zip(turns, shifts, strict=True)])


def simulated_sequences(rng: np.random.Generator, count: int) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """What racers get, all sequences one after the other with their lengths (count,), and the truth (count, 4, 4)."""
    made = [simulated_sequence(rng) for _ in range(count)]
    given = {
        "T_base_flange": np.vstack([shown for shown, _, _ in made]),
        "T_camera_board": np.vstack([seen for _, seen, _ in made]),
        "lengths": np.array([len(shown) for shown, _, _ in made]),
    }
    return given, {"T_flange_camera": np.array([camera for _, _, camera in made])}


def judge_hand_eye(answer: Arrays, truth: Arrays) -> dict[str, float]:
    """Errors of the cameras' places (K, 4, 4), a sequence each: medians and 90 % of them lie within."""
    found, true = answer["T_flange_camera"], truth["T_flange_camera"]
    shift_mm = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1)
    turn_deg = np.degrees([angle_between(one, other) for one, other in zip(found, true, strict=True)])
    shift_mm, turn_deg = np.nan_to_num(shift_mm, nan=np.inf), np.nan_to_num(turn_deg, nan=180.0)
    middle_mm, middle_deg = float(np.median(shift_mm)), float(np.median(turn_deg))
    return {
        "shift_mm": middle_mm,
        "rotation_deg": middle_deg,
        "shift_90_mm": float(np.quantile(shift_mm, 0.9)),
        "rotation_90_deg": float(np.quantile(turn_deg, 0.9)),
        "failed": float(not (middle_mm < WRONG_MM and middle_deg < WRONG_DEG)),
    }
