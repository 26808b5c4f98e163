"""Rows of one pose share the error of its joints: scaling to unit noise that knows it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.calibration.estimate import Sigmas, joint_noise_jacobian, row_covariances
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import CarriedPoints
from grindvision.calibration.statistics import whitening
from grindvision.records import by_content

Floats = NDArray[np.float64]


@by_content
@dataclass(frozen=True)
class PoseWhitening:
    """Scales columns (M, 3, c) of residuals or of a Jacobian to unit noise that is independent from row to row.

    ``to_unit`` (M, 3, 3) scales each row's own noise; ``groups`` hold the rows of poses of one size (G, m), with the
    directions (G, 3 m, n) in which the joints' shared error moves them and how much to shrink there (G, n).
    """

    to_unit: Floats
    groups: tuple[tuple[NDArray[np.int64], Floats, Floats], ...]

    def __call__(self, columns: Floats) -> Floats:
        """Return the scaled columns (3 M, c)."""
        white = self.to_unit @ columns
        for rows, directions, shrink in self.groups:
            block = white[rows].reshape(len(rows), -1, white.shape[2])
            along = np.swapaxes(directions, 1, 2) @ block
            block = block + directions @ (shrink[:, :, None] * along)
            white[rows] = block.reshape(*rows.shape, 3, -1)
        return white.reshape(-1, white.shape[2])


def pose_whitening(points: CarriedPoints, measurements: Measurements, sigmas: Sigmas) -> PoseWhitening:
    """Whitening of the rows' own noise and of the joints' noise that all rows of a pose label have in common."""
    to_unit = np.broadcast_to(whitening(row_covariances(points, measurements, sigmas)), (len(measurements), 3, 3))
    shared = sigmas.joint_rad * (to_unit @ joint_noise_jacobian(points))
    _, pose, sizes = np.unique(measurements.pose, return_inverse=True, return_counts=True)
    order = np.argsort(pose, kind="stable")
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    groups = []
    for size in np.unique(sizes):
        rows = order[starts[sizes == size][:, None] + np.arange(size)]
        stacked = shared[rows].reshape(len(rows), 3 * int(size), -1)
        directions, lengths, _ = np.linalg.svd(stacked, full_matrices=False)
        groups.append((rows, directions, 1 / np.sqrt(1 + lengths**2) - 1))
    return PoseWhitening(to_unit, tuple(groups))
