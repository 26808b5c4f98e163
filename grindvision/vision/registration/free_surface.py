"""Surfaces that leave a motion free wherever they meet: planes, cylinders and spheres, shown by both scans."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.vision.registration.free_motions import motion_names, rms_extent
from grindvision.vision.registration.plane_icp import NORMAL_NOISE
from grindvision.vision.registration.pose_candidates import Candidate, PoseJudge
from grindvision.vision.registration.rivals import weak_motions
from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]

UNRESISTED = 2 * NORMAL_NOISE**2
"""A motion that so small a part of the surface resists is held by the errors of the normals alone, and free."""


def free_all_over(judge: PoseJudge, source: Scan, target: Scan, best: Candidate) -> Floats:
    """Twists (6, K) of the motions that are free at the best pose, where neither scan shows a surface that resists all
    motions: what meets at any other pose is a part of both, and resists no more. None (6, 0) elsewhere, and on a model,
    whose ends tell."""
    free = weak_motions(judge, best, UNRESISTED)
    if judge.whole or not free.size:
        return free[:, :0]
    resistances = (least_resistance(scan.surfels.points, scan.surfels.normals) for scan in (source, target))
    return free if max(resistances) < UNRESISTED else free[:, :0]


def least_resistance(points: Floats, normals: Floats) -> float:
    """Fraction of a surface (N, 3) with ``normals`` (N, 3) that resists the motion which it resists least: 0 for a
    plane, a cylinder or a sphere without noise, whatever the unit. Rotations count at the points' rms distance."""
    rows = np.column_stack([normals, np.cross((points - points.mean(axis=0)) / rms_extent(points), normals)])
    return float(np.linalg.eigvalsh(rows.T @ rows)[0] / (normals**2).sum())


def free_motion(judge: PoseJudge, best: Candidate, twists: Floats) -> str:
    """In words, that motions (6, K) about the best pose's centre are free."""
    names = motion_names(twists * judge.extent, judge.extent, best.found.centre_mm)
    return (
        f"the registration is ambiguous, free motion: {'; '.join(names)};"
        " the part shows nothing that fixes it there, scan more of the part or a part with features"
    )
