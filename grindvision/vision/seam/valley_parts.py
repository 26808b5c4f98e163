"""Compiled kernels over a depth map: its connected parts, how wide they are inside, and the map without them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.kernels import njit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]


@njit(cache=True, nogil=True)
def connected_parts(depth: Floats, level: float | np.float32) -> tuple[NDArray[np.int32], Floats, Integers]:
    """Parts of a map (R, C) that are deeper than a level; cells that touch at a corner belong together.

    Returns the number of each cell's part (R, C), counted from 1 and 0 outside, the sum of depths of every part (P,),
    and its box (P, 4): first row, row behind the last, first column, column behind the last.
    """
    rows, columns = depth.shape
    names = np.zeros((rows, columns), np.int32)
    volumes, boxes = np.empty(rows * columns), np.empty((rows * columns, 4), np.int64)
    waiting = np.empty(rows * columns, np.int64)
    count = 0
    for seed in range(rows * columns):
        i, j = seed // columns, seed % columns
        if names[i, j] > 0 or not depth[i, j] > level:
            continue
        volume, top, bottom, left, right = 0.0, i, i, j, j
        names[i, j] = count + 1
        waiting[0] = seed
        size = 1
        while size > 0:
            size -= 1
            i, j = waiting[size] // columns, waiting[size] % columns
            volume += depth[i, j]
            top, bottom, left, right = min(top, i), max(bottom, i), min(left, j), max(right, j)
            for k in range(max(i - 1, 0), min(i + 2, rows)):
                for m in range(max(j - 1, 0), min(j + 2, columns)):
                    if names[k, m] == 0 and depth[k, m] > level:
                        names[k, m] = count + 1
                        waiting[size] = k * columns + m
                        size += 1
        volumes[count] = volume
        boxes[count, 0], boxes[count, 1], boxes[count, 2], boxes[count, 3] = top, bottom + 1, left, right + 1
        count += 1
    return names, volumes[:count].copy(), boxes[:count].copy()


@njit(cache=True, nogil=True)
def inner_radius(inside: Flags) -> float:
    """Greatest distance, in cells, of a cell that is ``inside`` (R, C) from the nearest one that is not.

    Beyond the map all is outside.
    """
    rows, columns = inside.shape
    down = np.zeros((rows, columns), np.int64)  # to the nearest cell outside in the same column
    for j in range(columns):
        for i in range(rows):
            if inside[i, j]:
                down[i, j] = 1 + (down[i - 1, j] if i > 0 else 0)
        for i in range(rows - 1, -1, -1):
            if inside[i, j]:
                down[i, j] = min(down[i, j], 1 + (down[i + 1, j] if i < rows - 1 else 0))
    largest = 0
    for i in range(rows):
        for j in range(columns):
            nearest = down[i, j] ** 2
            step = 1
            while nearest > largest and step * step < nearest:
                before = down[i, j - step] if j >= step else 0
                behind = down[i, j + step] if j + step < columns else 0
                nearest = min(nearest, step * step + min(before, behind) ** 2)
                step += 1
            largest = max(largest, nearest)
    return np.sqrt(largest)


@njit(cache=True, nogil=True)
def cleared(depth: Floats, level: float) -> Floats:
    """A depth map (R, C) without what is deeper than a level, and without two cells around it."""
    result = depth.copy()
    rows, columns = depth.shape
    for i in range(rows):
        for j in range(columns):
            if depth[i, j] > level:
                result[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3] = 0
    return result
