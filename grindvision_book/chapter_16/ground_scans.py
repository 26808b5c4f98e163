"""Scans of a part after grinding, made from scans before it: every point goes down with what a process took off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import inverse, move_points
from grindvision.geometry.height_map import HeightMap
from grindvision.motion.grinding import GrindingPlan, simulate_passes

Floats = NDArray[np.float64]


def ground_points(
    points: Floats,
    plan: GrindingPlan,
    factor: float = 1.0,
    T_test_points: Floats | None = None,
    heights: Callable[[Floats, Floats], Floats] | None = None,
    times: int = 4,
) -> Floats:
    """Points (N, 3) of a scan after the plan's passes, with ``factor`` times the planned removal.

    ``T_test_points`` leads from their frame into the one the plan was made in (left out: the same). ``heights``: the
    true ones, a function of points and normals (K, 3) in the frame of the plan (left out: those that it holds).
    """
    exact = finer_plan(plan, times)
    fine = exact.work.heights
    before = np.nan_to_num(fine.heights_mm)
    if heights is not None:
        shown = fine.shown
        before[shown] = np.nan_to_num(heights(*fine.in_scan(np.argwhere(shown) * fine.spacing_mm)))
    *_, after = simulate_passes(exact, before, factor)
    return lowered(points, fine, before - after, T_test_points)


def finer_plan(plan: GrindingPlan, times: int) -> GrindingPlan:
    """The same passes over a map with so many times as many nodes along each side: what is taken off between two nodes
    of the plan's own map is not what straight lines between them say."""
    fine = plan.work.heights.refined(times)
    places = np.argwhere(np.ones(fine.shape, dtype=bool)) * fine.spacing_mm
    inside, keep = (
        plan.work.heights.at(marks.astype(float), places).reshape(fine.shape) > 0.5
        for marks in (plan.work.inside, plan.work.keep)
    )
    return replace(plan, work=replace(plan.work, heights=fine, inside=inside, keep=keep))


def lowered(points: Floats, grid: HeightMap, removed_mm: Floats, T_test_points: Floats | None = None) -> Floats:
    """Points (N, 3) that go down along the ground's normals with what was removed (R, C) at their feet."""
    T_map_points = inverse(grid.T_scan_map) @ (np.eye(4) if T_test_points is None else T_test_points)
    there = move_points(T_map_points, points)
    places = there[:, :2]
    for _ in range(2):  # the foot under a point
        normals = np.nan_to_num(grid.at(grid.normals, places))
        height = there[:, 2] - np.nan_to_num(grid.at(grid.ground_mm, places))
        places = there[:, :2] - height[:, None] * normals[:, :2]
    taken = np.where(np.abs(height) < 5.0, np.nan_to_num(grid.at(removed_mm, places)), 0.0)
    return move_points(inverse(T_map_points), there - taken[:, None] * normals)
