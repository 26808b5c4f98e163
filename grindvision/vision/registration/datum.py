"""A pose by named faces alone: the datum, as a drawing has it. What lies elsewhere may stand out as a whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import AmbiguousError, DegenerateError, InputError
from grindvision.geometry import move_points
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest
from grindvision.vision.registration.free_motions import motion_names
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

REACH_CELLS = 1.0
"""Surface within so many cells of a datum's point belongs to the datum."""

MIN_SURFELS = 50
"""A datum that both scans show with fewer surfels fixes no pose."""

UNFIXED = 0.002
"""A motion that so small a part of the datum's surface resists is free."""


def in_datum(points: Floats, datum_mm: ArrayLike, cell_mm: float) -> Flags:
    """Which points (N, 3) belong to a datum: lie in the box between two corners (2, 3), or near its points (K, 3).

    Raises:
        InputError: the datum is neither.
    """
    datum = np.asarray(datum_mm, dtype=float)
    if datum.ndim != 2 or datum.shape[1] != 3 or len(datum) < 2 or not np.isfinite(datum).all():
        raise InputError(f"a datum of shape {datum.shape}; give the corners (2, 3) of a box or points (K, 3) of faces")
    if len(datum) == 2:
        return ((points >= datum.min(axis=0)) & (points <= datum.max(axis=0))).all(axis=1)
    reach = REACH_CELLS * cell_mm
    return np.asarray(nearest(build_cells(datum, reach), points, reach)[0] >= 0)


def refine_on_datum(
    source: Scan, target: Scan, registration: FineRegistration, datum_mm: ArrayLike
) -> tuple[FineRegistration, Flags]:
    """The pose T_target_source by the part of the surface in a datum, given in the frame of the target, and which of
    the source's surfels (M,) lie there.

    Raises:
        InputError: no datum. DegenerateError: next to nothing of it is in both scans. AmbiguousError: it leaves a
            motion free, which is named.
    """
    surfels, size = target.surfels, target.surfels.grid.size_mm
    chosen = in_datum(surfels.points, datum_mm, size)
    moved = move_points(registration.T_target_source, source.surfels.points)
    at, _ = nearest(build_cells(surfels.points, 3 * size), moved, 3 * size)
    mine = (at >= 0) & chosen[at]
    if mine.sum() < MIN_SURFELS:
        raise DegenerateError(
            f"both scans show only {int(mine.sum())} cells of the datum, {MIN_SURFELS} are needed; give it in SAMPLE's"
            " frame and in mm, on faces that both scans show"
        )
    places, normals = source.surfels.points[mine], source.surfels.normals[mine]
    found = registration
    for floor in (0.5, 0.1, 0.0):  # the pose by all faces may be off by what one of the datum is
        found = icp_planes(places, normals, surfels, found.T_target_source, 2 * size, floor * size)
    extent = float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))
    scale = np.array([1, 1, 1, 1 / extent, 1 / extent, 1 / extent])
    values, directions = np.linalg.eigh(found.information * np.outer(scale, scale))
    free = values < UNFIXED * np.trace(found.information[:3, :3])
    if free.any():
        names = motion_names(directions[:, free] * scale[:, None] * extent, extent, found.centre_mm)
        raise AmbiguousError(
            f"the datum leaves a motion free: {'; '.join(names)}; add a face that holds it (SAMPLE's frame)"
        )
    return found, mine
