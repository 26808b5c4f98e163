"""Views whose poses an arm gave, fitted to each other: what the arm errs from view to view is taken out.

Pairs of views are refined by ICP from the arm's poses. One least squares over the pairs and the arm's poses gives the
views' own: where the surfaces hold a motion they decide, where they do not, as a plane along itself, the arm does; and
all views together stay where the arm puts them in the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry import check_points, inverse, move_points
from grindvision.geometry.neighbours import nearest
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.registration.meeting import Meeting, merge
from grindvision.vision.registration.scan_registration import MIN_POINTS
from grindvision.vision.registration.view_poses import Tie, consistent_poses, moved_mm
from grindvision.vision.registration.view_ties import loop_limits, refined_pairs
from grindvision.vision.surface.scan import choose_resolution
from grindvision.vision.surface.surfels import build_surfels

Floats = NDArray[np.float64]

#: A pair of views is refined by at most this fraction of the part's extent: farther, a pose is wrong, and that is said.
FARTHEST_MOVED = 0.06

#: Cosine between normal and line of sight below which a surface is seen edge-on, and its plane runs along pixels.
SEEN_EDGE_ON = 0.02

#: Weight of the arm's pose of a view (squares of mm) against that of a pair's surfaces: the arm errs ten times as far
#: as surfaces that hold a motion.
ARM_WEIGHT = 0.01


@by_content
@dataclass(frozen=True)
class FittedViews:
    """Poses ``T_common_view`` (N, 4, 4) of views that were fitted to each other, how they meet, and how far (N,) in mm
    each lies from where the arm put it."""

    T_common_view: Floats
    meeting: Meeting
    moved_mm: Floats

    def __str__(self) -> str:
        return (
            f"fitted to each other they meet within {self.meeting.overall_mm:.2g} mm, moved by"
            f" {float(np.median(self.moved_mm)):.2g} mm in the median, {float(self.moved_mm.max()):.2g} mm at most"
        )


@one_blas_thread()
def fit_views(clouds: Sequence[ArrayLike], T_common_view: ArrayLike, meeting: Meeting) -> FittedViews | None:
    """Fit views (M_i, 3), mm, each in the frame of a camera at its origin, to each other.

    Args:
        clouds: the views.
        T_common_view: their poses (N, 4, 4) in one frame, by the arm.
        meeting: how they meet there.

    Returns:
        The views' own poses; None where the views would meet no better, or too few points show a surface.
    """
    poses = np.asarray(T_common_view, dtype=float)
    views = [check_points(cloud, f"view {row + 1}", 1) for row, cloud in enumerate(clouds)]
    if min(len(view) for view in views) < MIN_POINTS:
        return None
    overlapping = np.isfinite(meeting.pair_mm)
    pairs = [pair for pair in combinations(range(len(views)), 2) if overlapping[pair]]
    _, extent, middles = loop_limits(views)
    ties, _ = refined_pairs(views, pairs, poses, held=False, max_mm=FARTHEST_MOVED * extent)
    if not ties:
        return None
    common = len(views)
    information = ARM_WEIGHT * np.diag([1, 1, 1, *[extent**2] * 3]) / 3
    by_arm = {(common, row): Tie(pose, move_points(pose, middles[row]), information) for row, pose in enumerate(poses)}
    placed = np.concatenate([poses, np.eye(4)[None]])
    fitted = consistent_poses(ties | by_arm, placed, common, firm=by_arm)[0][:common]
    met = merge(views, fitted)
    if met.overall_mm >= meeting.overall_mm:
        return None
    moved = [
        moved_mm(fitted[row] @ inverse(pose), move_points(pose, middles[row]), extent) for row, pose in enumerate(poses)
    ]
    return FittedViews(fitted, met, np.array(moved))


def view_normals(points: ArrayLike) -> Floats:
    """Unit normals (M, 3) of a view's points (M, 3), mm, turned to its camera at the origin; where no surface is seen,
    the direction to the camera."""
    points = np.asarray(points, dtype=float)
    towards = -points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    surfels = build_surfels(points, choose_resolution(points).surfel_mm)
    rows, _ = nearest(surfels.grid, points, 2 * surfels.grid.size_mm)
    normals = np.where((rows >= 0)[:, None], surfels.normals[rows], 0.0)
    sight = (normals * towards).sum(axis=1)
    normals = np.where(np.abs(sight)[:, None] < SEEN_EDGE_ON, towards, normals * np.sign(sight)[:, None])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))
