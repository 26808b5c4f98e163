"""How well views meet that were brought into one frame: distances between their surfaces where they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import check_points, inverse, move_points
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.registration.plane_icp import plane_residuals
from grindvision.vision.surface.scan import choose_resolution, prepare_scan

Floats = NDArray[np.float64]

#: Two views overlap where so much of one (fraction, cells) lies over the other's surface.
MIN_OVERLAP, MIN_CELLS = 0.1, 50

#: Surfaces farther apart than this part of a view's extent do not meet.
FARTHEST = 0.15


@by_content
@dataclass(frozen=True)
class Meeting:
    """Views in one frame, and their distances where they overlap.

    ``points`` (M, 3): of all views, in their order, mm. ``median_mm`` (N, N): median distance of the row's points along
    the column's normals, NaN where the two do not overlap and on the diagonal; ``overall_mm``: the median over all
    overlaps.
    """

    points: Floats
    median_mm: Floats
    overall_mm: float

    @property
    def pair_mm(self) -> Floats:
        """The mean (N, N) of both ways of every pair, NaN where neither overlaps."""
        both = np.stack([self.median_mm, self.median_mm.T])
        shown = np.isfinite(both)
        total, count = np.where(shown, both, 0.0).sum(axis=0), shown.sum(axis=0)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    @property
    def worst(self) -> tuple[int, int]:
        """The pair of views that meets worst."""
        first, second = np.unravel_index(np.nanargmax(np.round(np.triu(self.pair_mm, 1), 9)), self.median_mm.shape)
        return int(first), int(second)

    @property
    def alone(self) -> NDArray[np.int64]:
        """Views that overlap no other."""
        return np.flatnonzero(~np.isfinite(self.pair_mm).any(axis=1))

    def __str__(self) -> str:
        pairs = int(np.isfinite(np.triu(self.pair_mm, 1)[np.triu_indices(len(self.median_mm), 1)]).sum())
        return f"{len(self.median_mm)} views meet within {self.overall_mm:.2f} mm in the median, over {pairs} pairs"


@one_blas_thread()
def merge(clouds: Sequence[ArrayLike], T_common_view: ArrayLike) -> Meeting:
    """Join views (M_i, 3), mm, each in the frame of a camera at its origin, and measure how well they meet.

    Args:
        clouds: the views.
        T_common_view: their poses (N, 4, 4) in one frame.

    Returns:
        All points in the common frame, and the distance of every pair of views where they overlap.

    Raises:
        InputError: NaN points, not one pose for each view.
        DegenerateError: too few points in a view; no two views overlap.

    Example:
        >>> import numpy as np
        >>> from grindvision import merge
        >>> from grindvision.geometry import rigid
        >>> x, y = np.meshgrid(np.arange(-40.0, 40.0), np.arange(-30.0, 30.0))
        >>> view = np.column_stack([x.ravel(), y.ravel(), 400 + 0.01 * x.ravel() ** 2])
        >>> poses = [np.eye(4), rigid(translation_mm=[5, 0, 0])]
        >>> joined = merge([view, view - [5, 0, 0]], poses)
        >>> joined.points.shape, bool(joined.overall_mm < 1e-6)
        ((9600, 3), True)
    """
    views = [check_points(cloud, f"view {row + 1}", MIN_CELLS) for row, cloud in enumerate(clouds)]
    poses = np.asarray(T_common_view, dtype=float)
    if poses.shape != (len(views), 4, 4):
        raise InputError(f"{len(views)} views and poses of shape {poses.shape}; expected ({len(views)}, 4, 4)")
    scans = [prepare_scan(view, choose_resolution(view), np.zeros(3), None).surfels for view in views]
    shown = [np.linalg.norm(scan.normals, axis=1) > 0.5 for scan in scans]
    medians = np.full((len(views), len(views)), np.nan)
    found = []
    for source, target in permutations(range(len(views)), 2):
        points, normals = (part[shown[source]] for part in (scans[source].points, scans[source].normals))
        motion = inverse(poses[target]) @ poses[source]
        extent = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
        distances, facing = plane_residuals(points, normals, scans[target], motion, FARTHEST * extent)
        if facing.sum() >= max(MIN_CELLS, MIN_OVERLAP * len(points)):
            size = np.abs(distances[facing])
            medians[source, target] = np.median(size)
            found.append(size)
    if not found:
        middles = np.array([move_points(pose, view.mean(axis=0)) for pose, view in zip(poses, views, strict=True)])
        apart = float(np.linalg.norm(middles - middles.mean(axis=0), axis=1).max())
        raise DegenerateError(
            f"no two views overlap: their middles lie up to {apart:.0f} mm apart; do the poses belong to these views,"
            " in this order, is the rotation written as said?"
        )
    joined = np.vstack([move_points(pose, view) for pose, view in zip(poses, views, strict=True)])
    return Meeting(joined, medians, float(np.median(np.concatenate(found))))
