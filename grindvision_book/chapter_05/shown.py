"""What an instrument shows of a scene when its noise is away: the floor under every registration and every path.

Distortion and scale error stand in both scans. No comparison of the two can take them out, so the best that it can
find is the motion between what is shown, and the ridge where it is shown.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.cell import GrindingScene, Scanner
from grindvision.geometry import fit_rigid, move_points

Floats = NDArray[np.float64]

#: A spot of the test scan is in the sample scan as well when that has a true point so near.
SAME_SPOT_MM = 1.0


def shown_points(scanner: Scanner, points: ArrayLike) -> Floats:
    """Where a scanner without noise shows points (N, 3) of its frame: moved along their rays."""
    points = np.asarray(points, dtype=float)
    return points * (1 + scanner.systematic_mm(points) / points[:, 2])[:, None]


def shown_pose(scanner: Scanner, scene: GrindingScene, spots: int = 8000) -> Floats:
    """T_sample_test (4, 4) that best joins what the scanner shows of the same spots in both scans of a scene."""
    on_part = scene.test.true_points[~scene.on_bead]
    in_test = on_part[:: max(len(on_part) // spots, 1)]
    in_sample = move_points(scene.T_sample_test, in_test)
    near, _ = cKDTree(scene.sample.true_points).query(in_sample, distance_upper_bound=SAME_SPOT_MM)
    both = np.isfinite(near)
    return fit_rigid(shown_points(scanner, in_test[both]), shown_points(scanner, in_sample[both])).T_target_source
