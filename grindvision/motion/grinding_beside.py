"""What stands beside a piece of stock, beyond its map or high above it: whether the tool runs into it on its way.

The map of a piece ends a little beside it, and its passes mind what stands a little higher than the stock. A large
wheel reaches farther and a wall stands higher: the points of the scan say so.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import InputError
from grindvision.geometry import inverse, move_points
from grindvision.motion.grinding import GrindingPlan
from grindvision.motion.grinding_contact import reach_into, tool_shape

Floats = NDArray[np.float64]

CELL_MM = 2.0
"""Points are averaged over cells of this size: their noise is no wall."""

MIN_POINTS, MIN_CELLS = 2, 3
"""Fewer points in a cell are strays, fewer cells that the tool touches no wall."""


def check_beside(plan: GrindingPlan, points_scan: Floats) -> None:
    """Refuse passes on whose way the tool would cut into what the scan (N, 3) shows beside the stock.

    The last pass is looked at: it runs deepest, and over all of the stock.

    Raises:
        InputError: with the depth and the place of the deepest cut, in the frame of the scan.
    """
    if not plan.passes:
        return
    work, options = plan.work, plan.options
    shape = tool_shape(options, options.radius_mm)
    strokes = plan.passes[-1].strokes
    poses = np.vstack([stroke.poses for stroke in strokes])
    lifts = np.concatenate([stroke.lifts_mm for stroke in strokes])
    reach = np.hypot(shape.along_mm, shape.across_mm)
    points = move_points(inverse(work.heights.T_scan_map), points_scan)
    near = (points > poses[:, :3].min(axis=0) - reach).all(axis=1)
    near &= (points < poses[:, :3].max(axis=0) + 2 * reach).all(axis=1)
    cells = _cells(_beside_stock(points[near], plan))
    deep = reach_into(cells, np.ascontiguousarray(poses), lifts, shape)
    touched = deep > work.level_mm
    if touched.sum() < MIN_CELLS:
        return
    worst = int(np.argmax(deep))
    x, y, z = move_points(work.heights.T_scan_map, cells[worst])
    wide = options.width_mm if options.tool == "wheel" else 2 * options.radius_mm
    raise InputError(
        f"a {options.tool} {wide:g} mm wide with a radius of {options.radius_mm:g} mm is wider than the place: on its"
        f" way it would come {deep[worst]:.2g} mm deep over what stands at ({x:.0f}, {y:.0f}, {z:.0f}) mm beside the"
        " stock; take a smaller one"
    )


def _beside_stock(points: Floats, plan: GrindingPlan) -> Floats:
    """Those of the points (N, 3), in the map's frame, that are not over the stock."""
    heights = plan.work.heights
    at = np.rint(points[:, :2] / heights.spacing_mm).astype(np.int64)
    on_map = ((at >= 0) & (at < heights.shape)).all(axis=1)
    stock = np.zeros(len(points), dtype=bool)
    stock[on_map] = plan.work.inside[at[on_map, 0], at[on_map, 1]]
    return points[~stock]


def _cells(points: Floats) -> Floats:
    """Means (M, 3) of the points (N, 3) of each cell that holds enough of them."""
    if len(points) == 0:
        return points
    keys = np.floor((points - points.min(axis=0)) / CELL_MM).astype(np.int64)
    flat = keys @ np.array([1, keys[:, 0].max() + 1, (keys[:, 0].max() + 1) * (keys[:, 1].max() + 1)])
    _, cell, count = np.unique(flat, return_inverse=True, return_counts=True)
    sums = np.column_stack([np.bincount(cell, weights=points[:, axis]) for axis in range(3)])
    enough = count >= MIN_POINTS
    return np.ascontiguousarray(sums[enough] / count[enough, None])
