"""What of a seam a camera sees: lines behind nearer surfaces, and faces as narrow as the pixels mixed at an edge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.geometry import unit_vectors
from grindvision.vision.seam.joints import Seam
from grindvision.vision.seam.seam_curve import around

Floats = NDArray[np.float64]

#: What is seen towards a place is the median depth of so many points about its ray.
NEIGHBOURS = 5
#: A step's foot is hidden where the camera sees something nearer by this fraction of the step: behind the edge of the
#: upper surface it is nearer by more than the whole of it, beside a wall that is seen by the camera's blur alone.
HIDDEN_FRACTION = 0.55
#: Cameras match windows of pixels: at the edge of a nearer body a band as wide as such a window joins the near surface
#: to the far one. A face is one if it looks narrower than so many cells and is seen more flatly than this cosine.
BAND_CELLS, BAND_FACING = 1.35, 0.55


def in_front_mm(places: Floats, points: Floats, eye: Floats) -> Floats:
    """By how much (K,), mm, the points (N, 3) that a camera at ``eye`` (3,) sees towards places (K, 3) are nearer."""
    rays, seen = places - eye, points - eye
    depth, seen_depth = np.linalg.norm(rays, axis=1), np.linalg.norm(seen, axis=1)
    near = cKDTree(seen / seen_depth[:, None]).query(rays / depth[:, None], min(NEIGHBOURS, len(points)))[1]
    return np.asarray(depth - np.median(seen_depth[near.reshape(len(places), -1)], axis=1))


def with_sight(seam: Seam, points: Floats, eye: Floats | None) -> Seam:
    """A step with the doubt that its foot is hidden from a camera at ``eye`` (3,), if it is."""
    step = float(np.median(seam.step_mm))
    if eye is None or not step > 0:
        return seam
    near = points[around(points, seam.root, 4 * step)]
    if len(near) < NEIGHBOURS or np.median(in_front_mm(seam.root, near, eye)) < HIDDEN_FRACTION * step:
        return seam
    doubt = (
        f"lies behind the edge of the upper surface, {step:.1f} mm below it, where the camera does not see it: it is"
        " there only if the wall below the edge is upright; scan it from the other side"
    )
    return replace(seam, glancing=True, doubts=(*seam.doubts, doubt))


def narrow_face(faces: Floats, legs_mm: Floats, root: Floats, cell_mm: float, eye: Floats | None) -> str:
    """What to say of a corner whose one face may be the band of mixed pixels at an edge; nothing if neither may.

    ``faces`` (2, S, 3) are the faces' normals at the root (S, 3), ``legs_mm`` (2, S) how far they reach.
    """
    if eye is None:
        return ""
    facing = np.median(np.einsum("ksi,si->ks", faces, unit_vectors(eye - root)), axis=1)
    looks = np.median(legs_mm, axis=1) * np.maximum(facing, 0.0)
    for side in range(2):
        if facing[side] < BAND_FACING and looks[side] < BAND_CELLS * cell_mm:
            flat = np.degrees(np.arccos(np.clip(facing[side], 0.0, 1.0)))
            return (
                f"has a face that looks {looks[side]:.1f} mm wide only, seen at {flat:.0f} deg from straight on: a"
                " camera joins the edge of a nearer body to what lies behind it by such a band; scan from where both"
                " faces are seen"
            )
    return ""
