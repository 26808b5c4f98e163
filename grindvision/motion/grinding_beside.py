"""What stands beside a piece of stock, beyond its map or high above it: whether the tool runs into it on its way.

The map of a piece ends a little beside it, and its passes mind what stands a little higher than the stock. A large
wheel reaches farther and a wall stands higher: the points of the scan say so.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import InputError
from grindvision.geometry import inverse, move_points
from grindvision.motion.grinding import GrindingPlan, Stroke
from grindvision.motion.grinding_contact import ToolShape, reach_into, tool_shape
from grindvision.motion.grinding_options import GrindingOptions

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

CELL_MM = 2.0
"""Points are averaged over cells of this size: their noise is no wall."""

MIN_POINTS, MIN_CELLS = 2, 3
"""Fewer points in a cell are strays, fewer cells that the tool touches no wall."""

LEADS = (1.0, 0.75, 0.5, 0.25)
"""Parts of the asked length that a lead-in or lead-out may have; where the tool would touch on all of them, it comes
down, or goes up, along the normal."""

LEAD_STEP_MM = 1.0
"""Places of a lead at which the tool is held against what stands beside the stock."""


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
    beside = _beside_stock(plan, points_scan, poses[:, :3], float(reach))
    cells, of = _cells(beside)
    deep = reach_into(cells, poses, lifts, shape)
    touched = deep > work.level_mm
    # the mean of a cell at the foot of a wall stands higher than its ground: points themselves must be touched
    at = np.flatnonzero(touched[of] & (of >= 0))
    themselves = at[reach_into(beside[at], poses, lifts, shape) > work.level_mm]
    touched &= np.bincount(of[themselves], minlength=len(cells)) >= MIN_POINTS
    if touched.sum() < MIN_CELLS:
        return
    worst = int(np.argmax(np.where(touched, deep, -np.inf)))
    x, y, z = move_points(work.heights.T_scan_map, cells[worst])
    wide = options.width_mm if options.tool == "wheel" else 2 * options.radius_mm
    raise InputError(
        f"a {options.tool} {wide:g} mm wide with a radius of {options.radius_mm:g} mm is wider than the place: on its"
        f" way it would come {deep[worst]:.2g} mm deep over what stands at ({x:.0f}, {y:.0f}, {z:.0f}) mm beside the"
        " stock; take a smaller one"
    )


def with_free_leads(plan: GrindingPlan, points_scan: Floats) -> GrindingPlan:
    """The same plan with each lead-in and lead-out as long as the tool touches nothing on it that the scan (N, 3)
    shows beside the stock; at most as asked for, and 0 where no length is free: the tool then moves along the normal.
    """
    if not plan.passes:
        return plan
    options = plan.options
    shape = tool_shape(options, options.radius_mm)
    places = np.vstack([stroke.poses[:, :3] for one in plan.passes for stroke in one.strokes])
    reach = float(np.hypot(shape.along_mm, shape.across_mm))
    beside = _beside_stock(plan, points_scan, places, reach + options.lead_mm)
    reach += options.lead_mm + options.lead_height_mm

    def freed(stroke: Stroke) -> Stroke:
        lengths = []
        for end, sign in ((0, -1.0), (-1, 1.0)):
            near = beside[(np.abs(beside - stroke.poses[end, :3]) < reach + shape.radius_mm).all(axis=1)]
            lead = (stroke.poses[end], float(stroke.lifts_mm[end]), sign)
            lengths.append(_free_length(options, shape, near, lead, plan.work.level_mm))
        return replace(stroke, leads_mm=(lengths[0], lengths[1]))

    passes = [replace(one, strokes=tuple(freed(stroke) for stroke in one.strokes)) for one in plan.passes]
    return replace(plan, passes=tuple(passes))


def _free_length(
    options: GrindingOptions, shape: ToolShape, points: Floats, lead: tuple[Floats, float, float], level_mm: float
) -> float:
    """Length of a ``lead`` from a pose (12,), its lift and the side, on which no ``points`` (M, 3) are touched."""
    pose, lift, sign = lead
    for part in LEADS:
        length = part * options.lead_mm
        on = np.linspace(0, 1, max(int(np.ceil(length / LEAD_STEP_MM)), 1) + 1)[1:]
        poses = np.repeat(pose[None], len(on), axis=0)
        poses[:, :3] += sign * length * on[:, None] * pose[3:6]
        deep = reach_into(points, poses, lift + options.lead_height_mm * on, shape)
        if (deep > level_mm).sum() < MIN_POINTS:
            return length
    return 0.0


def _beside_stock(plan: GrindingPlan, points_scan: Floats, places: Floats, reach_mm: float) -> Floats:
    """Points (M, 3) in the map's frame of what the scan (N, 3) shows that is not over the stock, about places (K, 3) of
    the tip: no farther than the tool reaches, and twice as far up."""
    heights = plan.work.heights
    points = move_points(inverse(heights.T_scan_map), points_scan)
    near = (points > places.min(axis=0) - reach_mm).all(axis=1)
    near &= (points < places.max(axis=0) + 2 * reach_mm).all(axis=1)
    points = points[near]
    at = np.rint(points[:, :2] / heights.spacing_mm).astype(np.int64)
    on_map = ((at >= 0) & (at < heights.shape)).all(axis=1)
    stock = np.zeros(len(points), dtype=bool)
    stock[on_map] = plan.work.inside[at[on_map, 0], at[on_map, 1]]
    return np.ascontiguousarray(points[~stock])


def _cells(points: Floats) -> tuple[Floats, Integers]:
    """Means (M, 3) of the points (N, 3) of each cell that holds enough of them, and the cell (N,) of each point, -1
    where it holds too few."""
    if len(points) == 0:
        return points, np.empty(0, dtype=np.int64)
    keys = np.floor((points - points.min(axis=0)) / CELL_MM).astype(np.int64)
    flat = keys @ np.array([1, keys[:, 0].max() + 1, (keys[:, 0].max() + 1) * (keys[:, 1].max() + 1)])
    _, cell, count = np.unique(flat, return_inverse=True, return_counts=True)
    sums = np.column_stack([np.bincount(cell, weights=points[:, axis]) for axis in range(3)])
    enough = count >= MIN_POINTS
    numbers = np.where(enough, np.cumsum(enough) - 1, -1)
    return np.ascontiguousarray(sums[enough] / count[enough, None]), numbers[cell]
