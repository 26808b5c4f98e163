"""Whether a cloud is one picture of its scanner: seen from there, its points stand one to a pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

COS_STEEP, COS_FRONT = 0.2, 0.6
"""Cosines of the angle between normal and ray below which a surface is steep, and above which it is seen from the
front."""

MIN_STEEP, MIN_SURFELS = 0.001, 30
"""A smaller share of steep surfels, or fewer, says nothing: rims, and steps between them, are in every scan."""

OF_PLANE = 4
"""A plane is fitted to so many points at least: where fewer are expected, these were found or there is none."""

MAX_DENSITY = 1.2
"""Points per solid angle on steep surface, less those of a plane, against those on the front: 0.25 to 1.05 in smoothed
pictures, in raw ones hardly any surface is steep; 1.4 to 5 in clouds that were merged from several views, that have
moved out of their scanner's frame, or that hold echoes."""

SAMPLES, REACH_CELLS, THICK_CELLS = 300, 2.0, 0.75
"""So many surfels of each kind are looked at; points are counted within so many cells, and so near to their plane."""


def is_one_picture(surfels: Surfels, viewpoint_mm: ArrayLike) -> bool:
    """Whether the points of a scan may be one picture from a viewpoint (3,), each pixel with one point.

    The pixels of a picture stand evenly in angle: on a surface seen at a slant its points are as few per area as the
    cosine says. Steep surface that holds more was seen from elsewhere. True where no surface is steep.
    """
    rays = np.asarray(viewpoint_mm, dtype=float) - surfels.points
    distances = np.linalg.norm(rays, axis=1)
    cosines = np.abs((rays * surfels.normals).sum(axis=1)) / np.maximum(distances, 1e-300)
    shown = np.abs(surfels.normals).sum(axis=1) > 0  # others are those of a few points, as at any rim
    steep, front = np.flatnonzero(shown & (cosines < COS_STEEP)), np.flatnonzero(shown & (cosines > COS_FRONT))
    if len(steep) < max(MIN_SURFELS, MIN_STEEP * len(surfels)) or len(front) < MIN_SURFELS:
        return True
    steep, front = (some[:: -(-len(some) // SAMPLES)] for some in (steep, front))
    # of a plane as large, the solid angle goes with the cosine and with the inverse square of the distance
    usual = np.median(_points_around(surfels, front) * distances[front] ** 2 / cosines[front])
    found = np.maximum(_points_around(surfels, steep) - OF_PLANE, 0) * distances[steep] ** 2
    return bool(found.sum() <= MAX_DENSITY * usual * cosines[steep].sum())


def _points_around(surfels: Surfels, chosen: Integers) -> Integers:
    """How many points (K,) lie about the ``chosen`` surfels (K,), near their planes."""
    size = surfels.grid.size_mm
    reach = REACH_CELLS * size
    around = within_radius(build_cells(surfels.points, reach), surfels.points[chosen], reach)
    of = np.repeat(np.arange(len(chosen)), np.diff(around.starts))
    away = surfels.points[around.indices] - surfels.points[chosen][of]
    near = np.abs((away * surfels.normals[chosen][of]).sum(axis=1)) < THICK_CELLS * size
    return np.bincount(of[near], weights=surfels.counts[around.indices][near], minlength=len(chosen)).astype(np.int64)
