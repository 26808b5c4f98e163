"""Scans of parts made of boxes: sharp edges, concave corners, trays, flash; no ray tracer needed, the truth beside."""

import numpy as np

from grindvision.geometry import inverse, move_points, rigid

STEPPED = (
    ((-40, -30, 0), (40, 30, 10)),
    ((-30, -20, 9), (5, 24, 20)),
    ((10, -12, 9), (34, 18, 26)),
    ((-30, -27, 9), (-12, -22, 15)),
)
"""Steps that meet a floor, and each other, in concave corners."""

TRAY = (
    ((-60, -40, 0), (60, 40, 4)),
    ((-60, -40, 0), (-56, 40, 18)),
    ((56, -40, 0), (60, 40, 18)),
    ((-60, -40, 0), (60, -36, 18)),
    ((-60, 36, 0), (60, 40, 18)),
    ((18, 10, 3), (34, 24, 10)),
    ((-34, 14, 3), (-30, 36, 13)),
)
"""A tray with a block and a rib in it, which alone tell its ends and its sides apart."""


def looking_at(middle, tilt_rad, azimuth_rad, distance_mm=400.0, roll_rad=0.0):
    """T_part_scanner (4, 4) of a scanner that looks along its z at ``middle``, tilted from the part's z axis."""
    up = np.array([np.sin(tilt_rad) * np.cos(azimuth_rad), np.sin(tilt_rad) * np.sin(azimuth_rad), np.cos(tilt_rad)])
    side = np.array([-np.sin(azimuth_rad), np.cos(azimuth_rad), 0.0])
    other = np.cross(-up, side)
    x = np.cos(roll_rad) * side + np.sin(roll_rad) * other
    return rigid(np.column_stack([x, np.cross(-up, x), -up]), np.asarray(middle, dtype=float) + distance_mm * up)


def scan_of(boxes, T_part_scanner, spacing_mm, rng, noise_mm=0.02, least_cosine=0.15):
    """Points (N, 3), in the scanner's frame, of what it sees of the union of boxes, about ``spacing_mm`` apart."""
    eye = T_part_scanner[:3, 3]
    lows, highs = (np.array([box[end] for box in boxes], dtype=float) for end in (0, 1))
    found = []
    for low, high in zip(lows, highs, strict=True):
        for axis in range(3):
            for sign, level in ((-1.0, low[axis]), (1.0, high[axis])):
                across = [k for k in range(3) if k != axis]
                sizes = (high - low)[across]
                count = max(int(sizes.prod() / spacing_mm**2), 1)
                points = np.empty((count, 3))
                points[:, across] = low[across] + rng.uniform(0, 1, (count, 2)) * sizes
                points[:, axis] = level
                ways = eye - points
                cosines = sign * ways[:, axis] / np.linalg.norm(ways, axis=1)
                # so many pixels see a surface that leans away
                kept = (cosines > least_cosine) & (rng.uniform(size=count) < cosines)
                lifted = points[kept] + sign * 1e-6 * np.eye(3)[axis]
                found.append(lifted[~_hidden(lifted, eye, lows, highs)])
    points = move_points(inverse(T_part_scanner), np.concatenate(found))
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    return points + rays * rng.normal(0, noise_mm, (len(points), 1))


def _hidden(points, eye, lows, highs):
    """Whether a box stands between each point (N, 3), or around it, and the eye."""
    ways = eye - points
    ways = np.where(np.abs(ways) < 1e-12, 1e-12, ways)
    hidden = np.zeros(len(points), dtype=bool)
    for low, high in zip(lows, highs, strict=True):
        ends = np.sort(np.stack([(low - points) / ways, (high - points) / ways]), axis=0)
        first, last = ends[0].max(axis=1), ends[1].min(axis=1)
        hidden |= (first < last) & (last > 1e-9) & (first < 1)
    return hidden
