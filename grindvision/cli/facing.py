"""From which side a cloud of two to be compared was scanned, where its file has normals."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

from grindvision.errors import GrindvisionWarning

if TYPE_CHECKING:
    from grindvision.clouds import Cloud

FACES_CAMERA = "normals face the camera of each view"
"""The comment in a PLY header by which `merge` says so; normals that other software estimates may have any sign."""

HEADER_BYTES = 2000
"""A comment stands within so many bytes."""

AWAY = 0.5
"""Where fewer of the normals than this face the origin, they say that no scanner stood there."""


def viewpoint_of(path: str, cloud: Cloud, stated: Sequence[float] | None, option: str) -> Sequence[float] | None:
    """Where a cloud was seen from (3,), mm: as ``stated``; else a far place that the normals of its file face, where
    `merge` turned them to its cameras or nothing else tells the side; None leaves it to the points.

    Warns:
        GrindvisionWarning: the normals face away from the origin, which is taken for the scanner.
    """
    if stated is not None or cloud.normals is None or cloud.mesh:
        return stated
    import numpy as np

    from grindvision.vision.surface.facing_side import viewpoint_by_normals
    from grindvision.vision.surface.normals import guess_viewpoint

    known = np.isfinite(cloud.points).all(axis=1) & np.isfinite(cloud.normals).all(axis=1)
    known &= np.linalg.norm(cloud.normals, axis=1) > 0
    points, normals = cloud.points[known], cloud.normals[known]
    if len(points) == 0:
        return None
    found = viewpoint_by_normals(points, normals)
    if found is None:
        return None
    place: list[float] = found.tolist()
    if _says_so(path) or guess_viewpoint(points) is None:
        return place
    if float(((points * normals).sum(axis=1) < 0).mean()) < AWAY:
        warnings.warn(
            f"{path}: its normals face away from the origin, which is taken for the scanner's place all the same, as"
            f" normals that were estimated have any sign: if it did not stand there, all is seen inside out, and a"
            f" pit passes for stock; then give {option} {' '.join(f'{value:.0f}' for value in place)}",
            GrindvisionWarning,
            stacklevel=2,
        )
    return None


def _says_so(path: str) -> bool:
    with open(path, "rb") as file:
        return f"comment {FACES_CAMERA}".encode() in file.read(HEADER_BYTES).partition(b"end_header")[0]
