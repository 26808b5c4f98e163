"""How much larger one of two registered scans is: two scanners, an old calibration, a warm part."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import move_points, rotate_vectors, rotation_about
from grindvision.geometry.hash_grid import random_order
from grindvision.vision.registration.deformable import block_covariance
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.scan import Scan
from grindvision.vision.surface.signed_distance import signed_distances

Floats = NDArray[np.float64]

#: Fraction of what a change of scale does to the distances that no motion could do as well; below, as on three faces of
#: a box, which look the same at any scale, nothing can be said of it.
MIN_SCALE_FRACTION = 0.02

#: The steps end when the scale changes by less.
AT_REST = 0.0002


def relative_scale(
    source: Scan, target: Scan, registration: FineRegistration, n_surfels: int = 2000, steps: int = 12, seed: int = 0
) -> tuple[float, float]:
    """How many times larger the source is than the target, and the standard deviation of that for errors
    that are alike over a quarter of the scan, as those of a scanner are; infinite where the surface does not tell.

    Point-to-plane steps for translation, rotation and scale from the registered pose, with Tukey's weights: beads do
    not count. ``seed`` chooses the surfels that are looked at.
    """
    surface, transform = target.surfels, registration.T_target_source
    chosen = random_order(source.surfels.grid.keys, np.random.default_rng(seed))[:n_surfels]
    places = move_points(transform, source.surfels.points[chosen])
    facing = rotate_vectors(transform, source.surfels.normals[chosen])
    scale, deviation = 1.0, np.inf
    for _ in range(steps):
        distances, normals, _ = signed_distances(surface, places, 2 * surface.grid.size_mm)
        shown = np.isfinite(distances) & ((facing * normals).sum(axis=1) > 0.7)
        if shown.sum() < 50:
            return 1.0, np.inf
        centre = places[shown].mean(axis=0)
        away, up, left = places[shown] - centre, normals[shown], -distances[shown]
        design = np.column_stack([up, np.cross(away, up), (away * up).sum(axis=1)])
        weights = np.ones(len(left))
        for _ in range(4):
            square = (design * weights[:, None]).T @ design
            change = np.linalg.lstsq(square, (design * weights[:, None]).T @ left, rcond=1e-12)[0]
            rest = left - design @ change
            sigma = 1.4826 * float(np.median(np.abs(rest))) + 1e-9
            weights = np.clip(1 - (rest / (4.685 * sigma)) ** 2, 0, None) ** 2
        motions, scaling = np.hsplit(design * np.sqrt(weights)[:, None], [6])
        alone = scaling - motions @ np.linalg.lstsq(motions, scaling)[0]
        if (alone**2).sum() < MIN_SCALE_FRACTION * (scaling**2).sum():
            return 1.0, np.inf
        scale *= 1 + change[6]
        deviation = float(np.sqrt(block_covariance(places[shown], design, rest, weights, square, across=4)[6, 6]))
        rotation = rotation_about(change[3:6], float(np.linalg.norm(change[3:6]))) if change[3:6].any() else np.eye(3)
        places = (1 + change[6]) * (places - centre) @ rotation.T + centre + change[:3]
        if abs(change[6]) < AT_REST:
            break
    return 1 / scale, deviation
