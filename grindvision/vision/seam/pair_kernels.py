"""Compiled kernels: the neighbours of each surfel split into two groups; whether two surfaces meet there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.kernels import njit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: How the normals around a place are spread: about two directions, or over all between them.
TIGHT, BLURRED = 1, 2
#: Kinds of a pair.
CONCAVE, CONVEX, STEP = 1, 2, 3
#: The least angle between two surfaces that meet, rad. Below it a weld seam is not told from a bend by normals.
MIN_DIHEDRAL_RAD = np.radians(12.0)
#: Spread inside the groups over the distance of the groups. Evenly spread values, halved, have 0.29.
MAX_SPREAD_RATIO = 0.24
#: Of two bent surfaces, whose normals are spread as well: the jump of the normals where they meet, as two trends give
#: it, over the distance of the groups' means and over the scatter about the trends; and the least jump. One surface
#: that bends jumps by a quarter of that distance at most.
MIN_JUMP_FRACTION, MIN_JUMP_SIGMAS, MIN_JUMP = 0.45, 4.0, 0.2
#: Slopes are held down as by this fraction of the weights, one cell away.
TREND_PRIOR = 0.05
#: A step's height in standard deviations of the heights on either side.
MIN_STEP_RATIO = 5.0
#: Reach of the planes of two bent surfaces, in cells.
CLOSE_CELLS = 1.5
#: Each group has at least so many surfels.
MIN_GROUP = 4


class Around(NamedTuple):
    """Neighbours of Q surfels: those of number q are ``indices[starts[q]:starts[q + 1]]``."""

    starts: Integers
    indices: Integers


@njit(cache=True, nogil=True)
def classify_pairs(
    points: Floats, normals: Floats, weights: Floats, around: Around, centres: Integers, size: float, usual: float
) -> tuple[Integers, Floats]:
    """Kind (M,) of the pair around each point, 0 where there is none, and its values (M, 14)."""
    count = len(points)
    kind, values = np.zeros(count, np.int64), np.zeros((count, 14))
    group = np.empty(count, np.int64)
    centre, axis = np.zeros(3), np.zeros(3)
    for q in range(len(centres)):
        i = centres[q]
        near = around.indices[around.starts[q] : around.starts[q + 1]]
        if len(near) < 2 * MIN_GROUP:
            continue
        spread = _main_axis(normals, weights, near, centre, axis)
        if spread > (np.sin(MIN_DIHEDRAL_RAD / 2) * 0.7) ** 2:
            split = _split_by_normal(normals, weights, near, centre, axis, group)
            bent = split == BLURRED and _jumps(points, normals, weights, near, group, i, size)
            reach = CLOSE_CELLS * size if bent else np.inf
            if (bent or split == TIGHT) and _crease(points, normals, weights, near, group, (i, size, reach), values):
                kind[i] = CONCAVE if values[i, 13] > 0 else CONVEX
                values[i, 13] = 0.0
                continue
        length = np.sqrt((centre**2).sum())
        if length > 0.9 and _step(points, weights, near, centre / length, group, usual, values[i]):
            kind[i] = STEP
    return kind, values


@njit(cache=True, nogil=True)
def _main_axis(normals: Floats, weights: Floats, near: Integers, centre: Floats, axis: Floats) -> float:
    """Weighted mean of normals into ``centre`` (3,), direction of largest spread into ``axis``; returns the spread."""
    total = 0.0
    centre[:] = 0.0
    for j in near:
        total += weights[j]
        for k in range(3):
            centre[k] += weights[j] * normals[j, k]
    centre /= total
    second = np.zeros((3, 3))
    for j in near:
        for a in range(3):
            for b in range(a + 1):
                second[a, b] += weights[j] * (normals[j, a] - centre[a]) * (normals[j, b] - centre[b])
    for a in range(3):
        for b in range(a):
            second[b, a] = second[a, b]
    second /= total
    largest = 0
    for a in range(1, 3):
        if second[a, a] > second[largest, largest]:
            largest = a
    axis[:] = second[largest]
    length = np.sqrt((axis**2).sum())
    if length < 1e-12:
        return 0.0
    for _ in range(12):
        axis /= length
        moved = second @ axis
        length = np.sqrt((moved**2).sum())
        if length < 1e-15:
            return 0.0
        axis[:] = moved
    axis /= length
    return length


@njit(cache=True, nogil=True)
def _split_by_normal(
    normals: Floats, weights: Floats, near: Integers, centre: Floats, axis: Floats, group: Integers
) -> int:
    """Put neighbours into two groups by their normals (2-means): 0 where one is empty, else ``TIGHT`` or ``BLURRED``.

    ``group`` is written for the members of ``near``.
    """
    first, second = np.zeros(3), np.zeros(3)
    for j in near:
        away = 0.0
        for k in range(3):
            away += (normals[j, k] - centre[k]) * axis[k]
        group[j] = 0 if away < 0 else 1
    for _ in range(5):
        first[:], second[:] = 0.0, 0.0
        one = two = 0.0
        for j in near:
            if group[j] == 0:
                one += weights[j]
                for k in range(3):
                    first[k] += weights[j] * normals[j, k]
            else:
                two += weights[j]
                for k in range(3):
                    second[k] += weights[j] * normals[j, k]
        if one == 0.0 or two == 0.0:
            return 0
        for k in range(3):
            first[k], second[k] = first[k] / one, second[k] / two
        for j in near:
            to_first = to_second = 0.0
            for k in range(3):
                to_first += (normals[j, k] - first[k]) ** 2
                to_second += (normals[j, k] - second[k]) ** 2
            group[j] = 0 if to_first < to_second else 1
    between = within = total = 0.0
    for k in range(3):
        between += (first[k] - second[k]) ** 2
    for j in near:
        total += weights[j]
        for k in range(3):
            mean = first[k] if group[j] == 0 else second[k]
            within += weights[j] * (normals[j, k] - mean) ** 2
    return 0 if between == 0.0 else TIGHT if within / total < MAX_SPREAD_RATIO**2 * between else BLURRED


@njit(cache=True, nogil=True)
def _jumps(
    points: Floats, normals: Floats, weights: Floats, near: Integers, group: Integers, i: int, size: float
) -> bool:
    """Whether the normals of two groups jump at point ``i``: each group has its own trend over the places.

    The trends are straight, over the distance across and along the line in which the groups' planes meet.
    """
    means, total = np.zeros((2, 3)), np.zeros(2)
    for j in near:
        total[group[j]] += weights[j]
        for k in range(3):
            means[group[j], k] += weights[j] * normals[j, k]
    for s in range(2):
        means[s] /= total[s]
    way = means[1] - means[0]
    distance = np.sqrt((way**2).sum())
    a, b = means[0], means[1]
    along = np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    length = np.sqrt((along**2).sum())
    if distance < MIN_JUMP or length < 1e-6:
        return False
    way, along = way / distance, along / length
    matrix, right, level = np.zeros((2, 3, 3)), np.zeros((2, 3)), np.zeros(2)
    row, squares = np.ones(3), 0.0
    for j in near:
        s, w = group[j], weights[j]
        place = (points[j] - points[i]) / size
        row[1], row[2] = _dot(place, way), _dot(place, along)
        value = _dot(normals[j], way)
        squares += w * value * value
        for p in range(3):
            right[s, p] += w * row[p] * value
            for q in range(3):
                matrix[s, p, q] += w * row[p] * row[q]
    for s in range(2):
        for p in range(1, 3):
            matrix[s, p, p] += TREND_PRIOR * total[s]
        trend = np.linalg.solve(matrix[s], right[s])
        level[s] = trend[0]
        squares -= 2 * (trend * right[s]).sum() - (trend * (matrix[s] @ trend)).sum()
    jump = level[1] - level[0]
    scatter = np.sqrt(max(squares, 0.0) / total.sum())
    return jump > max(MIN_JUMP, MIN_JUMP_FRACTION * distance) and jump > MIN_JUMP_SIGMAS * scatter


@njit(cache=True, nogil=True)
def _crease(
    points: Floats,
    normals: Floats,
    weights: Floats,
    near: Integers,
    group: Integers,
    place: tuple[int, float, float],
    values: Floats,
) -> bool:
    """Whether the planes of the two groups meet in a line near a point; its values go into its row.

    ``place`` is the point's number, the size of a cell and how far the planes reach, mm.

    Column 13 is 1 where the corner is concave and -1 where it is convex.
    """
    i, size, reach = place
    sums = np.zeros((2, 8))
    for j in near:
        row = sums[group[j]]
        weight = weights[j] * _closeness(points[j], points[i], reach)
        row[0] += weight
        row[7] += 1
        for k in range(3):
            row[1 + k] += weight * points[j, k]
            row[4 + k] += weight * normals[j, k]
    if sums[0, 7] < MIN_GROUP or sums[1, 7] < MIN_GROUP:
        return False
    for s in range(2):
        sums[s, 1:4] /= sums[s, 0]
        sums[s, 4:7] /= np.sqrt((sums[s, 4:7] ** 2).sum())
    a, b = sums[0, 4:7], sums[1, 4:7]
    cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    if cosine > np.cos(MIN_DIHEDRAL_RAD):
        return False
    along = np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    sine = np.sqrt((along**2).sum())
    if sine < 0.1:
        return False
    along /= sine
    way = sums[1, 1:4] - sums[0, 1:4]
    over_first, over_second = (way * a).sum(), -(way * b).sum()
    if over_first * over_second <= 0:
        return False
    apart = np.sqrt((way**2).sum())
    if apart < size or abs(over_first) < 0.1 * sine * apart or abs(over_second) < 0.1 * sine * apart:
        return False
    # place = p + x a + y b with both planes' equations met
    to_first = ((sums[0, 1:4] - points[i]) * a).sum()
    to_second = ((sums[1, 1:4] - points[i]) * b).sum()
    x = (to_first - cosine * to_second) / (1 - cosine**2)
    y = (to_second - cosine * to_first) / (1 - cosine**2)
    displacement = x * a + y * b
    if (displacement**2).sum() > (1.6 * size) ** 2:
        return False
    off = total = 0.0
    for j in near:
        row = sums[group[j]]
        height = 0.0
        for k in range(3):
            height += (points[j, k] - row[1 + k]) * row[4 + k]
        weight = weights[j] * _closeness(points[j], points[i], reach)
        off += weight * height * height
        total += weight
    if off / total > ((0.2 if reach == np.inf else 0.3) * size) ** 2:
        return False
    values[i, 0:3], values[i, 3:6] = points[i] + displacement, along
    values[i, 6:9], values[i, 9:12] = a, b
    values[i, 12] = np.arccos(min(max(cosine, -1.0), 1.0))
    values[i, 13] = 1.0 if over_first > 0 else -1.0
    return True


@njit(cache=True, nogil=True, inline="always")
def _closeness(point: Floats, centre: Floats, reach: float) -> float:
    """Weight of a neighbour by its distance."""
    return np.exp(-0.5 * ((point - centre) ** 2).sum() / reach**2)


@njit(cache=True, nogil=True)
def _step(
    points: Floats, weights: Floats, near: Integers, up: Floats, group: Integers, usual: float, values: Floats
) -> bool:
    """Whether the heights along ``up`` (3,) fall into two groups that lie side by side; the values go into a row."""
    low, high = np.inf, -np.inf
    for j in near:
        height = _dot(points[j], up)
        low, high = min(low, height), max(high, height)
    if (high - low) ** 2 < MIN_STEP_RATIO**2 * usual**2:
        return False
    below, above = low, high
    sums = np.zeros((2, 5))
    for _ in range(6):
        sums[:] = 0.0
        for j in near:
            height = _dot(points[j], up)
            group[j] = 0 if height - below < above - height else 1
            row = sums[group[j]]
            row[0] += weights[j]
            row[1] += weights[j] * height
        if sums[0, 0] == 0.0 or sums[1, 0] == 0.0:
            return False
        below, above = sums[0, 1] / sums[0, 0], sums[1, 1] / sums[1, 0]
    within = total = 0.0
    sums[:] = 0.0
    for j in near:
        mean = below if group[j] == 0 else above
        within += weights[j] * (_dot(points[j], up) - mean) ** 2
        total += weights[j]
        row = sums[group[j]]
        row[0] += 1
        for k in range(3):
            row[2 + k] += points[j, k]
    step = above - below
    if min(sums[0, 0], sums[1, 0]) < MIN_GROUP or step * step < MIN_STEP_RATIO**2 * (within / total + usual**2):
        return False
    way = sums[0, 2:5] / sums[0, 0] - sums[1, 2:5] / sums[1, 0]
    way -= up * (way * up).sum()
    length = np.sqrt((way**2).sum())
    if length < 0.3 * step:
        return False
    way /= length
    end_of_upper, start_of_lower = -np.inf, np.inf
    for j in near:
        across = _dot(points[j], way)
        if group[j] == 1:
            end_of_upper = max(end_of_upper, across)
        else:
            start_of_lower = min(start_of_lower, across)
    line = (end_of_upper + start_of_lower) / 2
    middle = sums[1, 2:5] / sums[1, 0]
    place = middle + way * (line - (middle * way).sum()) + up * (below - (middle * up).sum())
    values[0:3], values[6:9], values[9:12] = place, way, up
    values[3] = up[1] * way[2] - up[2] * way[1]
    values[4] = up[2] * way[0] - up[0] * way[2]
    values[5] = up[0] * way[1] - up[1] * way[0]
    values[12], values[13] = 0.0, step
    return True


@njit(cache=True, nogil=True, inline="always")
def _dot(a: Floats, b: Floats) -> float:
    """Scalar product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
