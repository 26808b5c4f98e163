"""Poses by features of wider neighbourhoods, where the usual ones fit nowhere: castings and other smooth parts.

The waves of a casting are longer than the usual radius; within it all of its surface looks alike.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError
from grindvision.vision.registration.global_registration import propose_poses
from grindvision.vision.surface.fpfh import compute_fpfh
from grindvision.vision.surface.keypoints import Keypoints
from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]

WIDE_VOXELS = 12.0
"""Radius of the features in voxels: a fifth of the size of a scan of 3,000 voxels."""


def wider_poses(source: Scan, target: Scan, rng: np.random.Generator) -> Floats:
    """Likely poses T_target_source (K, 4, 4), best first; none where no two points of one scan fit two of the other."""
    try:
        return propose_poses(_wide(source), _wide(target), rng)[0]
    except DegenerateError:
        return np.empty((0, 4, 4))


def _wide(scan: Scan) -> Keypoints:
    """A scan's keypoints with features of wide neighbourhoods."""
    points, normals = scan.voxels.points, scan.voxels.normals
    return replace(scan.keypoints, features=compute_fpfh(points, normals, WIDE_VOXELS * scan.voxels.grid.size_mm))
