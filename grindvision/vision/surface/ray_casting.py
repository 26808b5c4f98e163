"""Rays against triangles: a binary tree of boxes over triangles sorted along a space-filling curve."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.kernels import njit
from grindvision.parallel import parallel_map

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

LEAF = 4
"""Triangles in a leaf of the tree."""

CURVE_BITS = 16
"""Cells along an axis, as a power of two, by which triangles are sorted."""


class RayTree(NamedTuple):
    """Triangles made ready for rays: ``boxes`` (2 L, 6), lowest then highest corner, of a full binary tree whose node k
    has the children 2 k and 2 k + 1 and whose leaves are the last L; leaf l holds the triangles from 4 l on, as
    ``corners`` (T, 3, 3) has them."""

    boxes: Floats
    corners: Floats

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other


def ray_tree(corners: ArrayLike) -> RayTree:
    """Make finite triangles (T, 3, 3) ready for ``blocked``."""
    corners = np.asarray(corners, dtype=float)
    middles = corners.mean(axis=1)
    low, high = middles.min(axis=0), middles.max(axis=0)
    cells = ((middles - low) / np.maximum(high - low, 1e-300) * ((1 << CURVE_BITS) - 1)).astype(np.int64)
    code = np.zeros(len(corners), dtype=np.int64)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    corners = np.ascontiguousarray(corners[np.argsort(code, kind="stable")])
    leaves = 1 << max(int(np.ceil(np.log2(max(-(-len(corners) // LEAF), 1)))), 0)
    boxes = np.empty((2 * leaves, 6))
    boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
    starts = np.arange(0, len(corners), LEAF)
    boxes[leaves : leaves + len(starts), :3] = np.minimum.reduceat(corners.min(axis=1), starts)
    boxes[leaves : leaves + len(starts), 3:] = np.maximum.reduceat(corners.max(axis=1), starts)
    level = leaves
    while level > 1:
        pairs = boxes[level : 2 * level].reshape(-1, 2, 6)
        level //= 2
        boxes[level : 2 * level, :3] = pairs[:, :, :3].min(axis=1)
        boxes[level : 2 * level, 3:] = pairs[:, :, 3:].max(axis=1)
    boxes[np.isinf(boxes[:, 0]), 3:] = np.inf  # both corners of a box that holds nothing: no way goes through it
    return RayTree(boxes, corners)


def blocked(tree: RayTree, starts: ArrayLike, ways: ArrayLike) -> Flags:
    """Whether the straight way from ``starts`` (N, 3) to starts + ``ways`` (N, 3) meets a triangle."""
    starts = np.ascontiguousarray(starts, dtype=float)
    ways = np.ascontiguousarray(np.broadcast_to(ways, starts.shape), dtype=float)
    halves = parallel_map(
        lambda start, way: _blocked(tree.boxes, tree.corners, start, way),
        np.array_split(starts, 2),
        np.array_split(ways, 2),
    )
    return np.concatenate(halves)


@njit(cache=True, nogil=True)
def _blocked(boxes: Floats, corners: Floats, starts: Floats, ways: Floats) -> Flags:
    """``blocked`` of a tree's boxes and corners."""
    leaves = len(boxes) // 2
    met = np.zeros(len(starts), dtype=np.bool_)
    stack = np.empty(64, dtype=np.int64)
    inverse = np.empty(3)
    for r in range(len(starts)):
        start, way = starts[r], ways[r]
        for k in range(3):
            inverse[k] = 1.0 / way[k] if way[k] != 0 else np.inf
        stack[0], count = 1, 1
        while count > 0 and not met[r]:
            count -= 1
            node = stack[count]
            near, far = 0.0, 1.0
            for k in range(3):
                low, high = boxes[node, k] - start[k], boxes[node, 3 + k] - start[k]
                if way[k] == 0:
                    if low > 0 or high < 0:
                        near = 2.0
                    continue
                low, high = low * inverse[k], high * inverse[k]
                near, far = max(near, min(low, high)), min(far, max(low, high))
            if near > far:
                continue
            if node < leaves:
                stack[count], stack[count + 1] = 2 * node, 2 * node + 1
                count += 2
                continue
            first = (node - leaves) * LEAF
            for t in range(first, min(first + LEAF, len(corners))):
                if _meets(corners[t], start, way):
                    met[r] = True
                    break
    return met


@njit(cache=True, nogil=True)
def _meets(corners: Floats, start: Floats, way: Floats) -> bool:
    """Whether the straight way from a start (3,) meets a triangle (3, 3) (Moeller and Trumbore 1997)."""
    ax, ay, az = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    bx, by, bz = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1], corners[2, 2] - corners[0, 2]
    px, py, pz = way[1] * bz - way[2] * by, way[2] * bx - way[0] * bz, way[0] * by - way[1] * bx
    volume = ax * px + ay * py + az * pz
    if volume == 0:
        return False
    sx, sy, sz = start[0] - corners[0, 0], start[1] - corners[0, 1], start[2] - corners[0, 2]
    u = (sx * px + sy * py + sz * pz) / volume
    if u < 0 or u > 1:
        return False
    qx, qy, qz = sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax
    v = (way[0] * qx + way[1] * qy + way[2] * qz) / volume
    if v < 0 or u + v > 1:
        return False
    along = (bx * qx + by * qy + bz * qz) / volume
    return 0 <= along <= 1
