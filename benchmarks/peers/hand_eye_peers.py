"""Hand-eye calibration by OpenCV's five closed forms and by kinhec's solvers, closed and refined."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np

from benchmarks.peers.laps import Answer, Laps


def opencv(sequences: str, method: str) -> Answer:
    """``cv2.calibrateHandEye`` by TSAI, PARK, HORAUD, ANDREFF or DANIILIDIS."""
    import cv2

    flag = getattr(cv2, f"CALIB_HAND_EYE_{method}")

    def solve(flange: np.ndarray, board: np.ndarray) -> np.ndarray:
        turn, shift = cv2.calibrateHandEye(
            list(flange[:, :3, :3]), list(flange[:, :3, 3]), list(board[:, :3, :3]), list(board[:, :3, 3]), method=flag
        )
        return placed(turn, shift.ravel())

    return each(sequences, solve)


def kinhec(sequences: str, method: str, refined: bool = False) -> Answer:
    """kinhec's solvers of A X = X B over all pairs of poses, or of A X = Y B; then its least squares if ``refined``."""
    from kinhec import se3, solvers

    def solve(flange: np.ndarray, board: np.ndarray) -> np.ndarray:
        arm, camera = metres(flange), np.linalg.inv(metres(board))
        if method in solvers.AXYB_SOLVERS:
            X, Y = solvers.AXYB_SOLVERS[method](arm, camera)
            X = solvers.refine_lm_axyb(arm, camera, X, Y)[0] if refined else X
        else:
            pairs = np.array(list(combinations(range(len(arm)), 2)))
            A, B = se3.relative_motions(arm, pairs), se3.relative_motions(camera, pairs)
            X = solvers.AXXB_SOLVERS[method](A, B)
            X = solvers.refine_lm(A, B, X) if refined else X
        return placed(X[:3, :3], 1000 * X[:3, 3])

    return each(sequences, solve)


def metres(poses: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) with their places in metres, as kinhec's weights want them."""
    scaled = poses.copy()
    scaled[:, :3, 3] /= 1000
    return scaled


def each(sequences: str, solve: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Answer:
    """T_flange_camera (K, 4, 4) of every sequence in the file; NaN where the solver gives up."""
    lap = Laps()
    with np.load(sequences) as arrays:
        flange, board, ends = arrays["T_base_flange"], arrays["T_camera_board"], np.cumsum(arrays["lengths"])[:-1]
    lap("read")
    found = []
    for poses, seen in zip(np.split(flange, ends), np.split(board, ends), strict=True):
        try:
            found.append(solve(poses, seen))
        except (ValueError, ArithmeticError):
            found.append(np.full((4, 4), np.nan))
    lap("solve")
    return {"T_flange_camera": np.array(found), "laps_s": lap.laps_s}


def placed(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """A transform (4, 4) of its rotation (3, 3) and translation (3,)."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = turn, shift
    return transform
