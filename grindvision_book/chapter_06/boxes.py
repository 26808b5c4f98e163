"""The paper's way from two registered scans to path points (sections 3.5 and 3.6), and how far it is from the print."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.geometry import move_points, vector_angle
from grindvision.geometry.curves import Curve
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest
from grindvision.vision.change.change_detection import find_change_paper
from grindvision.vision.change.oriented_box import BoxPath, box_path
from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]

#: The paper's kind of threshold; with PCL, which squares the distance, 0.71 mm.
THRESHOLD_MM = 0.5
#: Only what lies this near to the bead is compared: a careful user would crop, as the paper's part filled both scans.
CROP_MM = 2.0


def paper_path(
    piece: Floats,
    test: Scan,
    sample: Scan,
    T_sample_test: Floats,
    points: int,
    threshold_mm: float = THRESHOLD_MM,
    squared: bool = True,
) -> BoxPath:
    """Path of the paper's boxes on one bead, frame of the test scan; normals are those of the test scan's surfels.

    Args:
        piece: points (N, 3) of the bead, of which only the place counts: the test scan is cropped to it.
        threshold_mm, squared: see ``find_change_paper``.

    Raises:
        DegenerateError: fewer than four points are farther than the threshold from the sample.
    """
    low, high = piece.min(axis=0) - CROP_MM, piece.max(axis=0) + CROP_MM
    crop = test.points[_between(test.points, low, high)]
    near = crop[nearest(build_cells(piece, CROP_MM), crop, CROP_MM)[1] < CROP_MM]
    moved = move_points(T_sample_test, near)
    reach = 5 * threshold_mm
    around = _between(sample.points, moved.min(axis=0) - reach, moved.max(axis=0) + reach)

    def search(cloud: Floats, queries: Floats) -> Floats:
        return nearest(build_cells(cloud, 2 * threshold_mm), queries, reach)[1]

    far = find_change_paper(moved, sample.points[around], threshold_mm, squared, search)
    path = box_path(near[far], near, np.zeros_like(near), points)
    surfels = _between(test.surfels.points, low - CROP_MM, high + CROP_MM)
    at = cKDTree(test.surfels.points[surfels]).query(path.points)[1]
    return replace(path, normals=test.surfels.normals[surfels][at])


@dataclass(frozen=True)
class Misses:
    """How far printed path points (n, 3) and normals are from a found path.

    ``nearest_mm`` (n,) to the path's curve, ``one_to_one_mm`` (n,) to the point of the same number, ``normals_deg``
    (n,) between the normals of the same number.
    """

    nearest_mm: Floats
    one_to_one_mm: Floats
    normals_deg: Floats


def misses(printed: tuple[Floats, Floats], points: Floats, normals: Floats, curve: Floats | None = None) -> Misses:
    """Compare printed points and normals (n, 3) with found ones; the path's curve runs through ``curve`` (M, 3), or
    through the found points. Found ones that run the other way are turned round."""
    if (points[-1] - points[0]) @ (printed[0][-1] - printed[0][0]) < 0:
        points, normals = points[::-1], normals[::-1]
    return Misses(
        nearest_mm=Curve(points if curve is None else curve).distances(printed[0]),
        one_to_one_mm=np.linalg.norm(points - printed[0], axis=1),
        normals_deg=np.degrees(vector_angle(normals, printed[1])),
    )


def _between(points: Floats, low: Floats, high: Floats) -> NDArray[np.bool_]:
    inside = np.ones(len(points), dtype=bool)
    for column, least, most in zip(points.T, low, high, strict=True):
        inside &= (column > least) & (column < most)
    return inside
