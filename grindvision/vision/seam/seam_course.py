"""Whether a corner was followed as far as its two surfaces go on meeting within the scan.

Both faces are extended as what they are, plane or cylinder. Where surfels of the one lie near the other, and both are
seen there, the corner goes on; what the root line does not reach was left out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from grindvision.geometry import vector_angle
from grindvision.geometry.graphs import edge_graph
from grindvision.vision.seam.face_fit import Scale, fit_faces, intersections, root_normals
from grindvision.vision.seam.face_shapes import CYLINDER, FREE_FORM, FaceShape, face_surfels
from grindvision.vision.seam.joint_extent import (
    ALIKE_FRACTION,
    ALIKE_RAD,
    END_STATIONS,
    MIN_FACING,
    STRETCH_CELLS,
    facing,
)
from grindvision.vision.seam.joint_fit import JointFit, prolonged, shown_stations, turned_stations
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Surfels lie on a surface within so many times the noise and this fraction of a cell, normals within this of its own.
ON_NOISE, ON_CELLS, ON_RAD = 4.0, 0.12, np.radians(20.0)
#: The corner is there where surfels of each face lie within so many cells of the other surface; both must be seen.
MEETING_CELLS = 2.5
#: A corner goes on with what lies within so many cells; the root line shows what is within so many.
LINK_CELLS, SHOWN_CELLS = 5.0, 3.5
#: Behind an end the same corner is looked for over so many cells, farther than a line is carried on across a hole.
#: There it turns as at the end and lies within so many cells of the prolonged line.
BEYOND_CELLS, OFF_CELLS = 18.0, 1.2
#: A stretch beside the line shows itself by so many surfels of each face.
MIN_SURFELS = 4


def left_out_mm(
    fit: JointFit, shapes: tuple[FaceShape, FaceShape], scene: tuple[Surfels, Floats], others: list[Floats]
) -> float:
    """Length, mm, over which the faces of a corner meet in the scan beyond what its root line follows.

    ``scene``: the surfels and their normals (M, 3); ``others``: root lines of other seams, which show their own part.
    """
    surfels, normals = scene
    if FREE_FORM in (shapes[0].name, shapes[1].name):
        return 0.0
    size = surfels.grid.size_mm
    tolerance = ON_NOISE * float(np.median(surfels.noise_mm)) + ON_CELLS * size
    heights, on = [], []
    for shape, (points, outward) in zip(shapes, face_surfels(fit, surfels, normals), strict=True):
        height, out = _height(shape, points, outward, surfels.points)
        heights.append(height)
        on.append((np.abs(height) < tolerance) & (vector_angle(normals, out) < ON_RAD))
    near = [on[k] & (np.abs(heights[1 - k]) < MEETING_CELLS * size) & ~on[1 - k] for k in (0, 1)]
    if min(int(one.sum()) for one in near) < MIN_SURFELS:
        return 0.0
    first, second = (surfels.points[one] for one in near)
    reach = 2 * MEETING_CELLS * size
    first = first[cKDTree(second).query(first)[0] < reach]
    second = second[cKDTree(first).query(second)[0] < reach] if len(first) else second[:0]
    first, second = (one[~_along(one, others, SHOWN_CELLS * size)] for one in (first, second))
    return _length_beside(np.concatenate([first, second]), len(first), fit, size)


def _along(places: Floats, others: list[Floats], reach: float) -> Flags:
    """Which places (K, 3) lie beside one of the other lines (S, 3)."""
    if not others or not len(places):
        return np.zeros(len(places), dtype=bool)
    return np.asarray(cKDTree(np.concatenate(others)).query(places)[0] < reach)


def beyond_ends_mm(
    points: Floats, fit: JointFit, way: tuple[bool, Floats | None], scale: Scale, others: list[Floats]
) -> float:
    """Length, mm, over which the points (N, 3) show the same corner in line behind the ends of its root.

    Holes in the scan end a root line; what lies behind them may be its continuation, if none of the ``others`` is.
    ``way``: is the corner concave, and where the scanner stands (3,), if that is known.
    """
    concave, towards = way
    if fit.closed:
        return 0.0
    curve, faces = prolonged(fit.curve, fit.faces, BEYOND_CELLS * scale.cell)
    sides = fit_faces(points, curve, faces, scale)
    if sides is None:
        return 0.0
    displacement, slopes = intersections(curve, faces, sides)
    shown = shown_stations(sides, displacement, scale) & turned_stations(faces, slopes, sides, concave)
    normals = root_normals(faces, slopes)
    shown &= facing(curve.stations, normals, sides, towards) > MIN_FACING
    turn = vector_angle(*normals)
    away, place = cKDTree(fit.root).query(curve.stations)
    usual = median_filter(fit.dihedral_rad, size=END_STATIONS, mode="nearest")[place]
    shown &= np.abs(turn - usual) < np.maximum(ALIKE_FRACTION * usual, ALIKE_RAD)
    shown &= np.linalg.norm(displacement, axis=1) < OFF_CELLS * scale.cell
    shown &= ~_along(curve.stations, others, SHOWN_CELLS * scale.cell)
    beyond = np.flatnonzero(shown & (away > 1.5 * scale.cell))
    runs = np.split(beyond, np.flatnonzero(np.diff(beyond) > 1) + 1)
    runs = [run for run in runs if len(run) * curve.step_mm > STRETCH_CELLS * scale.cell]
    inside = np.flatnonzero(away < 0.5 * curve.step_mm + 1e-9)
    if not runs or not len(inside):
        return 0.0
    ends = max(inside[0] - runs[0][0], 0) + max(runs[-1][-1] - inside[-1], 0)
    return float(ends * curve.step_mm)


def _height(shape: FaceShape, points: Floats, facing: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Heights (M,) of places (M, 3) over a face's surface, which is fitted to its points (K, 3), and its normals."""
    middle, mean = points.mean(axis=0), facing.mean(axis=0)
    if shape.name != CYLINDER or shape.axis is None:
        normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
        normal = normal * np.sign(normal @ mean)
        return (places - middle) @ normal, np.broadcast_to(normal, places.shape)
    axis = np.asarray(shape.axis)
    flat = np.linalg.svd(axis[None])[2][1:]
    u, v = ((points - middle) @ one for one in flat)
    solution = np.linalg.lstsq(np.column_stack([2 * u, 2 * v, np.ones(len(u))]), u * u + v * v, rcond=None)[0]
    centre = middle + solution[:2] @ flat
    away = places - centre
    away = away - np.outer(away @ axis, axis)
    distance = np.linalg.norm(away, axis=1)
    outside = np.sign((middle - centre) @ mean)
    return outside * (distance - shape.radius_mm), outside * away / np.maximum(distance, 1e-9)[:, None]


def _length_beside(places: Floats, of_first: int, fit: JointFit, size: float) -> float:
    """Length, mm, of the part of a corner's places (K, 3) that goes on from its root line and lies beside it.

    The first ``of_first`` places are the one face's, the others the other's; both count.
    """
    if of_first == 0 or of_first == len(places):
        return 0.0
    away = cKDTree(fit.root).query(places)[0]
    pairs = cKDTree(places).query_pairs(LINK_CELLS * size, output_type="ndarray")
    graph = edge_graph(pairs[:, 0], pairs[:, 1], np.ones(len(pairs)), len(places))
    name = connected_components(graph, directed=False)[1]
    reached = np.isin(name, np.unique(name[away < SHOWN_CELLS * size]))
    out = reached & (away > SHOWN_CELLS * size)
    face = np.arange(len(places)) < of_first
    shown = reached & ~out
    parts = [(out & side).sum() / max((shown & side).sum(), 1) for side in (face, ~face)]
    if min(int((out & side).sum()) for side in (face, ~face)) < MIN_SURFELS:
        return 0.0
    return float(min(parts) * fit.length_mm)
