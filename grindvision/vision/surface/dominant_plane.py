"""How much of a scanned surface lies in one plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.hash_grid import random_order
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]

#: Of the plane's patches the directions agree within this angle; planes are tried through so many patches.
PLANE_COSINE, PLANES_TRIED = np.cos(np.radians(15)), 100


def plane_fraction(surfels: Surfels, seed: int = 0) -> float:
    """Fraction of the surface that lies in one plane, to a tenth of the cell size and roughness.

    ``seed`` chooses the patches through which planes are tried.
    """
    points, normals = surfels.points, surfels.normals
    within = 0.1 * surfels.grid.size_mm + 3 * float(np.median(surfels.noise_mm))

    def in_plane(place: Floats, up: Floats) -> NDArray[np.bool_]:
        return (np.abs((points - place) @ up) < within) & (np.abs(normals @ up) > PLANE_COSINE)

    tried = random_order(surfels.grid.keys, np.random.default_rng(seed))[:PLANES_TRIED]
    best = max((in_plane(points[at], normals[at]) for at in tried), key=np.count_nonzero)
    for _ in range(3):  # a patch's own direction is too poor far away from it
        if best.sum() < 3:
            break
        place = points[best].mean(axis=0)
        best = in_plane(place, np.linalg.svd(points[best] - place, full_matrices=False)[2][2])
    return float(best.mean())
