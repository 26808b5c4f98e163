"""A scan as its scanner saw it: a depth image, the nearest surface about each of its pixels, and what it enclosed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.kernels import njit
from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

PIXEL_CELLS = 1.0
"""Edge of a depth image's pixel in surfels: nearly every pixel on the surface then holds a point."""

MIN_VISIBLE = 8
"""Of the nine pixels about a place, so many must be filled for a scanner to have looked past it."""

MAX_SLOPE = 1.0
"""Depth gained per width across a hole in one surface; more is a jump from one surface to another."""


MAX_HIDDEN = 0.05
"""Fraction of a scan's points that may be hidden from its scanner behind its own surface: at the scanners' true places
0 to 0.024, at places that the origin of a moved frame merely might have been 0.09 and more."""

HIDDEN_PIXELS = 8.0
"""A point is hidden where it lies so many pixels' widths behind the nearest one: less is the slope within a pixel."""


class DepthImage(NamedTuple):
    """A scan as its scanner saw it. ``known``: whether the scanner's place is; ``viewpoint`` (3,), ``axes`` (3, 3) rows
    right, up, ahead; ``pixel`` tangent per pixel, ``low`` (2,) first pixel; ``front`` (H, W): least depth of the nine
    pixels about each, minus infinity where fewer than ``MIN_VISIBLE`` are filled; ``bridge`` (H, W): over a hole in a
    surface the depth that the surface would have there, else minus infinity; ``empty`` (H, W)."""

    known: bool
    viewpoint: Floats
    axes: Floats
    pixel: float
    low: Integers
    front: Floats
    bridge: Floats
    empty: NDArray[np.bool_]


def depth_image(scan: Scan) -> DepthImage:
    """The scan's surfels as a depth image from its viewpoint.

    An empty one where that is not known, or hides so much of the scan that no scanner stood there.
    """
    surfels = scan.surfels
    nothing = np.zeros((1, 1))
    unknown = DepthImage(False, np.zeros(3), np.eye(3), 1.0, np.zeros(2, np.int64), nothing, nothing, nothing == 0)
    if scan.viewpoint_mm is None:
        return unknown
    viewpoint = np.asarray(scan.viewpoint_mm, dtype=float)
    middle = surfels.points.mean(axis=0) - viewpoint
    distance = float(np.linalg.norm(middle))
    ahead = middle / distance
    axes = np.vstack([np.linalg.svd(ahead[None])[2][1:], ahead])
    pixel = PIXEL_CELLS * surfels.grid.size_mm / distance
    low, high = _pixel_bounds(surfels.points, viewpoint, axes, pixel)
    depth = np.full(tuple(high - low), np.inf)
    _enter_depths(scan.points, viewpoint, axes, pixel, low, depth)
    if _hidden(scan.points, viewpoint, axes, pixel, low, depth) > MAX_HIDDEN:
        return unknown
    bridge = _bridges(depth, pixel)
    return DepthImage(True, viewpoint, axes, pixel, low, _fronts(depth), bridge, np.isinf(depth))


@njit(cache=True, nogil=True)
def _pixel_of(point: Floats, viewpoint: Floats, axes: Floats, pixel: float) -> tuple[int, int, float]:
    """Pixel of a point (3,) and its depth along the image's axis; pixel 0, 0 for a point that is not ahead."""
    x, y, z = point[0] - viewpoint[0], point[1] - viewpoint[1], point[2] - viewpoint[2]
    depth = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
    if depth <= 0:
        return 0, 0, depth
    i = int(np.round((axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z) / depth / pixel))
    j = int(np.round((axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z) / depth / pixel))
    return i, j, depth


@njit(cache=True, nogil=True)
def _pixel_bounds(points: Floats, viewpoint: Floats, axes: Floats, pixel: float) -> tuple[Integers, Integers]:
    """First pixel (2,) and the one behind the last (2,) of an image of points (N, 3), with an empty rim of two."""
    low, high = np.full(2, np.int64(1) << 40), np.full(2, -(np.int64(1) << 40))
    for p in range(len(points)):
        i, j, depth = _pixel_of(points[p], viewpoint, axes, pixel)
        if depth > 0:
            low[0], high[0] = min(low[0], i), max(high[0], i)
            low[1], high[1] = min(low[1], j), max(high[1], j)
    return low - 2, high + 3


@njit(cache=True, nogil=True)
def _enter_depths(points: Floats, viewpoint: Floats, axes: Floats, pixel: float, low: Integers, image: Floats) -> None:
    """Enter the least depth of points (N, 3) into an ``image`` (H, W) whose first pixel is ``low``."""
    for p in range(len(points)):
        i, j, depth = _pixel_of(points[p], viewpoint, axes, pixel)
        i, j = i - low[0], j - low[1]
        if depth > 0 and 0 <= i < image.shape[0] and 0 <= j < image.shape[1] and depth < image[i, j]:
            image[i, j] = depth


@njit(cache=True, nogil=True)
def _hidden(points: Floats, viewpoint: Floats, axes: Floats, pixel: float, low: Integers, image: Floats) -> float:
    """Fraction of points (N, 3) that lie behind what an ``image`` (H, W) of them shows."""
    hidden = 0
    for p in range(len(points)):
        i, j, depth = _pixel_of(points[p], viewpoint, axes, pixel)
        i, j = i - low[0], j - low[1]
        if depth <= 0:
            hidden += 1
        elif 0 <= i < image.shape[0] and 0 <= j < image.shape[1]:
            hidden += depth > image[i, j] + HIDDEN_PIXELS * pixel * depth
    return hidden / len(points)


@njit(cache=True, nogil=True)
def _fronts(depth: Floats) -> Floats:
    """``front`` (H, W) of a depth image with infinity in its empty pixels."""
    height, width = depth.shape
    front = np.full((height, width), -np.inf)
    for i in range(height):
        for j in range(width):
            shown, least = 0, np.inf
            for a in range(max(i - 1, 0), min(i + 2, height)):
                for b in range(max(j - 1, 0), min(j + 2, width)):
                    if np.isfinite(depth[a, b]):
                        shown += 1
                        least = min(least, depth[a, b])
            if shown >= MIN_VISIBLE:
                front[i, j] = least
    return front


@njit(cache=True, nogil=True)
def _bridges(depth: Floats, pixel: float) -> Floats:
    """``bridge`` (H, W) of a depth image with infinity in its empty pixels.

    An empty pixel among empty ones is in a hole when along its row and along its column the surface goes on behind the
    gap as it ended before it. Where the depth jumps across the gap, something nearer hid the surface from the scanner
    or from its light, and the gap tells nothing.
    """
    bridge = np.full(depth.shape, np.inf)
    for axis in range(2):
        lines = depth if axis == 0 else depth.T
        over = bridge if axis == 0 else bridge.T
        for i in range(lines.shape[0]):
            last = -1
            for j in range(lines.shape[1]):
                if np.isinf(lines[i, j]):
                    continue
                before = lines[i, last] if last >= 0 else np.inf
                step = (lines[i, j] - before) / max(j - last, 1)
                steep = MAX_SLOPE * pixel * lines[i, j]
                level = abs(step) < steep and last + 1 < j and last > 0 and j + 1 < lines.shape[1]
                if level:  # a single pixel of the hidden surface beside what hides it
                    level = abs(before - lines[i, last - 1]) < steep and abs(lines[i, j + 1] - lines[i, j]) < steep
                for between in range(last + 1, j):
                    inside = level and last + 1 < between < j - 1
                    depth_there = before + step * (between - last) if inside else -np.inf
                    over[i, between] = min(over[i, between], depth_there)
                over[i, j] = -np.inf
                last = j
            over[i, last + 1 :] = -np.inf
    return bridge
