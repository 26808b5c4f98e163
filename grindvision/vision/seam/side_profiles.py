"""Compiled kernels: which points tell how a groove's sides end, and their median cross-section."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.kernels import njit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Multiples of the golden ratio are spread evenly and hit no period.
GOLDEN = (np.sqrt(5) - 1) / 2
#: A bin of fewer points has no median.
MIN_IN_BIN = 6


@njit(cache=True, nogil=True)
def scattered(count: int, some: int) -> Integers:
    """At most ``some`` numbers of ``count`` rows, by the golden ratio: every n-th would leave lines of a scan out."""
    if count <= some:
        return np.arange(count)
    numbers = np.empty(some, np.int64)
    for k in range(some):
        numbers[k] = int(k * GOLDEN % 1.0 * count)
    return numbers


@njit(cache=True, nogil=True)
def scattered_within(points: Floats, some: int, low: Floats, high: Floats) -> Floats:
    """Those of at most ``some`` points that are ``scattered`` over a cloud (N, 3) that lie between two corners (3,)."""
    numbers = scattered(len(points), some)
    kept, inside = np.empty((len(numbers), 3)), 0
    for p in numbers:
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        if low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]:
            kept[inside, 0], kept[inside, 1], kept[inside, 2] = x, y, z
            inside += 1
    return kept[:inside]


@njit(cache=True, nogil=True)
def bin_medians(place: Floats, height: Floats, edges: Floats) -> Floats:
    """Medians (B, 4) of points at ``place`` (N,) between each two of ``edges``, of bins that hold enough: their places,
    heights and distances from the median height, and their number."""
    bins = len(edges) - 1
    number = np.searchsorted(edges, place, side="right") - 1
    starts = np.zeros(bins + 1, np.int64)
    for b in number:
        if 0 <= b < bins:
            starts[b + 1] += 1
    starts = np.cumsum(starts)
    filled, places, heights = starts[:-1].copy(), np.empty(starts[-1]), np.empty(starts[-1])
    for p in range(len(place)):
        b = number[p]
        if 0 <= b < bins:
            places[filled[b]], heights[filled[b]] = place[p], height[p]
            filled[b] += 1
    medians, kept = np.empty((bins, 4)), 0
    for b in range(bins):
        here = slice(starts[b], starts[b + 1])
        if starts[b + 1] - starts[b] >= MIN_IN_BIN:
            middle = np.median(heights[here])
            medians[kept, 0], medians[kept, 1] = np.median(places[here]), middle
            medians[kept, 2], medians[kept, 3] = np.median(np.abs(heights[here] - middle)), len(heights[here])
            kept += 1
    return medians[:kept]
