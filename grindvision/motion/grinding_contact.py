"""Where a wheel or disc meets a height map: how far it must be lifted over a floor, and what it takes off.

A pose of the tool is its tip on the ground with three axes: along the feed, across, and along the ground's normal. The
tip is the lowest point of a wheel, of a disc the point of its rim that its tilt presses down.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.height_map import HeightMap
from grindvision.kernels import njit
from grindvision.motion.grinding_options import GrindingOptions

Floats = NDArray[np.float64]

WHEEL, DISC = 0, 1


class ToolShape(NamedTuple):
    """The lower surface of a tool: its kind, radius, half width of a wheel, tilt of a disc.

    ``step_mm``: how far the rim of a disc is drawn from pose to pose. ``along_mm``, ``across_mm``: how far from the tip
    it can touch what stands no higher than some height.
    """

    kind: int
    radius_mm: float
    half_width_mm: float
    tilt_rad: float
    step_mm: float
    along_mm: float
    across_mm: float


class Nodes(NamedTuple):
    """Ground points and normals (R, C, 6) of a map in its own frame, NaN where it shows none, and their spacing."""

    rows: Floats
    spacing_mm: float


def tool_shape(options: GrindingOptions, highest_mm: float) -> ToolShape:
    """The tool, as far as it may touch what stands up to ``highest_mm`` over its tip."""
    radius = options.radius_mm
    if options.tool == "wheel":
        high = min(highest_mm, radius)
        along = float(np.sqrt(high * (2 * radius - high)))
        return ToolShape(WHEEL, radius, options.width_mm / 2, 0.0, 0.0, along, options.width_mm / 2)
    return ToolShape(DISC, radius, radius, options.contact_angle_rad, options.path_step_mm, 2 * radius, radius)


def nodes_of(heights: HeightMap) -> Nodes:
    """The ground of a map for the kernels."""
    return Nodes(np.ascontiguousarray(np.concatenate([heights.feet_mm, heights.normals], axis=-1)), heights.spacing_mm)


@njit(cache=True, nogil=True)
def _lower(x: float, y: float, shape: ToolShape) -> float:
    """Height of the tool's lower surface over its tip, at x along and y across; infinite beside the tool."""
    if shape.kind == 0:
        if abs(y) > shape.half_width_mm or abs(x) >= shape.radius_mm:
            return np.inf
        return shape.radius_mm - np.sqrt(shape.radius_mm * shape.radius_mm - x * x)
    if abs(y) >= shape.radius_mm:
        return np.inf
    half = np.sqrt(shape.radius_mm * shape.radius_mm - y * y)
    front = (half - shape.radius_mm) * np.cos(shape.tilt_rad)
    if x > front + shape.step_mm or x < -(half + shape.radius_mm) * np.cos(shape.tilt_rad):
        return np.inf
    return -min(x, front) * np.tan(shape.tilt_rad)


@njit(cache=True, nogil=True)
def _nodes_near(nodes: Nodes, pose: Floats, shape: ToolShape) -> tuple[int, int, int, int]:
    """Rows and columns of nodes that the tool may cover at a pose (12,): the first, and the one behind the last."""
    ground, spacing = nodes
    reach = np.sqrt(shape.along_mm * shape.along_mm + shape.across_mm * shape.across_mm)
    low_i, high_i = max(int((pose[0] - reach) / spacing), 0), int((pose[0] + reach) / spacing) + 2
    low_j, high_j = max(int((pose[1] - reach) / spacing), 0), int((pose[1] + reach) / spacing) + 2
    return low_i, min(high_i, ground.shape[0]), low_j, min(high_j, ground.shape[1])


@njit(cache=True, nogil=True)
def lifts_over(nodes: Nodes, floors: Floats, poses: Floats, shape: ToolShape) -> Floats:
    """Least heights (K,) of the tip over the ground at poses (K, 12) at which the tool is nowhere below the floors.

    ``floors`` (R, C): heights over the ground, along its normals, that must not be cut; NaN where there are none.
    """
    ground, _spacing = nodes
    lifts = np.full(len(poses), -np.inf)
    for k in range(len(poses)):
        pose = poses[k]
        low_i, high_i, low_j, high_j = _nodes_near(nodes, pose, shape)
        for i in range(low_i, high_i):
            for j in range(low_j, high_j):
                floor = floors[i, j]
                node = ground[i, j]
                if np.isnan(floor) or np.isnan(node[2]):
                    continue
                x = y = z = 0.0
                for axis in range(3):
                    away = node[axis] + floor * node[3 + axis] - pose[axis]
                    x += away * pose[3 + axis]
                    y += away * pose[6 + axis]
                    z += away * pose[9 + axis]
                if abs(x) > shape.along_mm or abs(y) > shape.across_mm:
                    continue
                lift = z - _lower(x, y, shape)
                if lift > lifts[k]:
                    lifts[k] = lift
    return lifts


@njit(cache=True, nogil=True)
def lifts_of_sides(nodes: Nodes, floors: Floats, poses: Floats, shape: ToolShape) -> Floats:
    """Least heights (K,), as ``lifts_over``, at which the two sides of a wheel are not below the floors.

    They stand between nodes, where ``lifts_over`` looks at none, and sloping ground is met there first: the floors are
    taken on the straight lines from node to node.
    """
    ground, spacing = nodes
    lifts = np.full(len(poses), -np.inf)
    half = shape.half_width_mm
    for k in range(len(poses)):
        pose = poses[k]
        low_i, high_i, low_j, high_j = _nodes_near(nodes, pose, shape)
        for i in range(low_i, high_i):
            for j in range(low_j, high_j):
                x, y, z = _in_tool(ground, floors, i, j, pose)
                if np.isnan(z) or abs(abs(y) - half) > 2 * spacing or abs(x) > shape.along_mm + spacing:
                    continue
                side = half if y > 0 else -half
                for step in range(2):
                    other_i, other_j = i + 1 - step, j + step
                    if other_i >= ground.shape[0] or other_j >= ground.shape[1]:
                        continue
                    u, v, w = _in_tool(ground, floors, other_i, other_j, pose)
                    if np.isnan(w) or (y - side) * (v - side) >= 0:
                        continue
                    part = (side - y) / (v - y)
                    at = x + part * (u - x)
                    if abs(at) <= shape.along_mm:
                        lifts[k] = max(lifts[k], z + part * (w - z) - _lower(at, side, shape))
    return lifts


@njit(cache=True, nogil=True)
def _in_tool(ground: Floats, floors: Floats, i: int, j: int, pose: Floats) -> tuple[float, float, float]:
    """A node's floor from the tip at a pose (12,): along feed, across, along the normal; NaN where there is none."""
    x = y = z = 0.0
    for axis in range(3):
        away = ground[i, j, axis] + floors[i, j] * ground[i, j, 3 + axis] - pose[axis]
        x += away * pose[3 + axis]
        y += away * pose[6 + axis]
        z += away * pose[9 + axis]
    return x, y, z


@njit(cache=True, nogil=True)
def envelope_of(nodes: Nodes, poses: Floats, lifts: Floats, shape: ToolShape) -> Floats:
    """Heights (R, C) over the ground, along its normals, below which the tool comes nowhere on its way through the
    poses (K, 12) at ``lifts`` (K,); infinite where it does not come."""
    ground, _spacing = nodes
    lowest = np.full(ground.shape[:2], np.inf)
    for k in range(len(poses)):
        pose = poses[k]
        low_i, high_i, low_j, high_j = _nodes_near(nodes, pose, shape)
        for i in range(low_i, high_i):
            for j in range(low_j, high_j):
                node = ground[i, j]
                if np.isnan(node[2]):
                    continue
                x = y = z = facing = 0.0
                for axis in range(3):
                    away = node[axis] - pose[axis]
                    x += away * pose[3 + axis]
                    y += away * pose[6 + axis]
                    z += away * pose[9 + axis]
                    facing += node[3 + axis] * pose[9 + axis]
                if abs(x) > shape.along_mm or abs(y) > shape.across_mm or facing < 0.2:
                    continue
                height = (_lower(x, y, shape) + lifts[k] - z) / facing
                if height < lowest[i, j]:
                    lowest[i, j] = height
    return lowest


@njit(cache=True, nogil=True)
def reach_into(points: Floats, poses: Floats, lifts: Floats, shape: ToolShape) -> Floats:
    """How deep (M,) the tool comes over points (M, 3) of the map's frame on its way through poses (K, 12) at lifts
    (K,): their heights over its lower surface, where they lie no higher than its axle is high twice; minus infinity
    beside its way."""
    deep = np.full(len(points), -np.inf)
    for k in range(len(poses)):
        pose = poses[k]
        for m in range(len(points)):
            x = y = z = 0.0
            for axis in range(3):
                away = points[m, axis] - pose[axis]
                x += away * pose[3 + axis]
                y += away * pose[6 + axis]
                z += away * pose[9 + axis]
            above = z - lifts[k]
            if above > 2 * shape.radius_mm:
                continue
            depth = above - _lower(x, y, shape)
            if depth > deep[m]:
                deep[m] = depth
    return deep
