"""SciPy: its kd-tree for the difference, its least squares for the calibration."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.peers.laps import Answer, Laps
from benchmarks.peers.recipe import THRESHOLD_MM
from grindvision.clouds import read_cloud

JOINTS = 4
COLUMNS = ("alpha_rad", "a_mm", "d_mm", "theta_rad", "beta_rad")


def difference(sample: str, test: str) -> Answer:
    """Points farther than 0.5 mm from their nearest neighbour, on all cores."""
    lap = Laps()
    target, source = (read_cloud(path).points for path in (sample, test))
    lap("read")
    changed = cKDTree(target).query(source, workers=-1)[0] > THRESHOLD_MM
    lap("difference")
    return {"changed": changed, "laps_s": lap.laps_s}


def calibrate(train: str, test: str, robot: str) -> Answer:
    """Least squares over scanner, arm and base with SciPy's numerical Jacobian."""
    lap = Laps()
    nominal = pd.read_csv(robot)[list(COLUMNS)].to_numpy()[:JOINTS]
    known, held_out = pd.read_csv(train), pd.read_csv(test)
    q_rad, seen, tracked = (known.filter(regex=pattern).to_numpy() for pattern in ("q._rad", "s._mm", "b._mm"))
    lap("read")
    rotations, shifts = chain(nominal, q_rad)
    in_joint = np.einsum("kji,kj->ki", rotations, tracked - shifts)
    turn, _ = Rotation.align_vectors(in_joint - in_joint.mean(axis=0), seen - seen.mean(axis=0))
    shift = in_joint.mean(axis=0) - turn.apply(seen.mean(axis=0))
    start = np.concatenate([turn.as_rotvec(), shift, np.zeros(6), np.zeros(nominal.size)])
    found = least_squares(lambda x: (placed(x, nominal, q_rad, seen) - tracked).ravel(), start, x_scale="jac")
    lap("calibrate")
    q_rad, seen = (held_out.filter(regex=pattern).to_numpy() for pattern in ("q._rad", "s._mm"))
    return {"held_out": placed(found.x, nominal, q_rad, seen), "laps_s": lap.laps_s}


def placed(x: np.ndarray, nominal: np.ndarray, q_rad: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Scanned points (K, 3) in the tracker's frame; ``x`` holds scanner, base (rotation vector, shift), MDH changes."""
    rotations, shifts = chain(nominal + x[12:].reshape(nominal.shape), q_rad)
    in_joint = Rotation.from_rotvec(x[:3]).apply(seen) + x[3:6]
    in_base = np.einsum("kij,kj->ki", rotations, in_joint) + shifts
    return Rotation.from_rotvec(x[6:9]).apply(in_base) + x[9:12]


def chain(table: np.ndarray, q_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (K, 3, 3) and shifts (K, 3) of the last joint's frame: Rx Tx Ry Rz Tz of every joint."""
    rotation, shift = np.broadcast_to(np.eye(3), (len(q_rad), 3, 3)), np.zeros((len(q_rad), 3))
    for joint, (alpha, a, d, theta, beta) in enumerate(table):
        shift = shift + a * rotation[:, :, 0]
        tilted = rotation @ Rotation.from_euler("x", alpha).as_matrix() @ Rotation.from_euler("y", beta).as_matrix()
        rotation = tilted @ Rotation.from_euler("z", q_rad[:, joint, None] + theta).as_matrix()
        shift = shift + d * rotation[:, :, 2]
    return rotation, shift
