"""From where a scan was taken: frames from which its surfaces are seen nearly straight on."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import check_points, inverse, move_points, rigid, vector_angle
from grindvision.geometry.bounds import diagonal_mm
from grindvision.kernels import njit
from grindvision.vision.surface.surfels import build_surfels

Floats = NDArray[np.float64]

#: Edge of the surfels that give the viewing direction, as a fraction of the cloud's diagonal.
SURFEL_FRACTION = 1 / 60

#: A camera at the origin looks along its z axis, forward or (in graphics) backward: what it sees, all but this fraction
#: of strays, lies within this angle of it, half the field of the widest depth cameras. How a surface is tilted or how
#: far the background goes on says nothing against it.
CAMERA_FIELD_RAD, STRAYS = np.radians(60), 0.01

#: Length of the mean of all normals, each turned to the origin, below which the origin is no camera. A camera that
#: looks into a corner of 60 deg sees normals whose mean is half as long as they are: it is believed above the second
#: length, where at most this fraction of the surface is seen more flatly than scanners measure.
MIN_AGREEMENT, MIN_IN_CORNER, FLAT_RAD, MAX_FLAT = 0.6, 0.45, np.radians(80), 0.1

#: Normals within this angle belong to one main direction, if they are at least this fraction of all.
MODE_CONE_RAD, MODE_FRACTION = np.radians(45), 0.12


def field_frames(points: ArrayLike, viewpoint_mm: ArrayLike | None = None) -> list[list[Floats]]:
    """Frames from which a cloud's surfaces are seen nearly straight on, for each side it may have been scanned from.

    A frame is a transform (4, 4) ``T_field_cloud`` whose z axis is one of the main directions of the surface normals
    (the largest first) and whose x axis is the cloud's long side. There is one list of frames when the scanned side is
    known, from ``viewpoint_mm`` (3,) or because the origin stands where a camera would and z points as a camera's does
    (a robot's base does so by chance only); otherwise two, for both sides.

    Raises:
        DegenerateError: the points span no surface.
    """
    points = check_points(points, "points", min_points=10)
    diagonal = diagonal_mm(points)
    if not diagonal > 0:
        raise DegenerateError(f"all {len(points)} points lie in one spot; they span no surface")
    T_own_cloud = _own_frame(points)
    surfels = build_surfels(_moved(points, T_own_cloud), diagonal * SURFEL_FRACTION)
    if not surfels.normals.any():
        raise DegenerateError(f"the {len(points)} points span no surface: they lie along lines; scan an area")
    centre = surfels.points.mean(axis=0)
    towards = move_points(T_own_cloud, np.zeros(3) if viewpoint_mm is None else viewpoint_mm)
    rays = towards - surfels.points
    normals = _facing(surfels.normals, rays)
    flat = float((vector_angle(normals, rays) > FLAT_RAD).mean())
    least = MIN_IN_CORNER if flat < MAX_FLAT else MIN_AGREEMENT
    bearing = np.quantile(vector_angle(T_own_cloud[:3, 2], rays), [STRAYS, 1 - STRAYS])
    in_view = bearing[1] < CAMERA_FIELD_RAD or bearing[0] > np.pi - CAMERA_FIELD_RAD
    if viewpoint_mm is not None or (in_view and np.linalg.norm(normals.mean(axis=0)) > least):
        return [[_frame(surfels.points, centre, up) @ T_own_cloud for up in _main_directions(normals)]]
    directions = _main_directions(_facing(surfels.normals, _dominant(surfels.normals)[None, :]))
    return [[_frame(surfels.points, centre, side * up) @ T_own_cloud for up in directions] for side in (1, -1)]


def _own_frame(points: Floats) -> Floats:
    """``T_own_cloud`` (4, 4) along the cloud's own axes, so that no result depends on the frame it came in."""
    centre, second, third = _moments(points)
    axes = np.linalg.eigh(second)[1][:, ::-1]
    skewness = np.einsum("ijk,im,jm,km->m", third, axes, axes, axes)
    axes = axes * np.where(skewness >= 0, 1, -1)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return inverse(rigid(axes, centre))


def _facing(normals: Floats, towards: Floats) -> Floats:
    return normals * np.sign(np.einsum("ij,ij->i", normals, np.broadcast_to(towards, normals.shape)))[:, None]


def _dominant(normals: Floats) -> Floats:
    return np.linalg.eigh(normals.T @ normals)[1][:, 2]


def _main_directions(normals: Floats) -> list[Floats]:
    """Unit directions around which the normals gather: the mean normal led to the nearest peak, then what is left."""
    left, directions = normals[np.linalg.norm(normals, axis=1) > 0.5], []
    least = MODE_FRACTION * len(left)
    while len(left) > max(least, 3):
        up, near = left.mean(axis=0), np.zeros(len(left), dtype=bool)
        for _ in range(20):
            up, before = up / max(np.linalg.norm(up), 1e-12), near
            near = left @ up > np.cos(MODE_CONE_RAD)
            up = left[near].sum(axis=0) if near.any() else left[np.argmax(left @ up)]
            if (near == before).all() and near.any():
                break
        up = up / np.linalg.norm(up)
        near = left @ up > np.cos(MODE_CONE_RAD)
        if near.sum() > least:
            directions.append(up)
        left = left[~near] if near.any() else left[:0]
    return directions or [normals.mean(axis=0) / np.linalg.norm(normals.mean(axis=0))]


def _frame(points: Floats, centre: Floats, up: Floats) -> Floats:
    """Field frame with z along ``up``; x is the long side of the points in the plane across it."""
    flat = points - centre
    flat = flat - np.outer(flat @ up, up)
    along = np.linalg.eigh(flat.T @ flat)[1][:, 2]
    skewness = ((flat @ along) ** 3).sum()
    along = along - up * (along @ up)
    along *= (1 if skewness >= 0 else -1) / np.linalg.norm(along)
    rotation = np.stack([along, np.cross(up, along), up], axis=1)
    return inverse(rigid(rotation, centre))


@njit(cache=True, nogil=True)
def _moments(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean (3,) of points (N, 3), and the sums of their second (3, 3) and third powers (3, 3, 3) about it."""
    centre = np.zeros(3)
    for p in range(len(points)):
        for k in range(3):
            centre[k] += points[p, k]
    centre /= len(points)
    second, third, about = np.zeros((3, 3)), np.zeros((3, 3, 3)), np.empty(3)
    for p in range(len(points)):
        for k in range(3):
            about[k] = points[p, k] - centre[k]
        for i in range(3):
            for j in range(i + 1):
                product = about[i] * about[j]
                second[i, j] += product
                for k in range(j + 1):
                    third[i, j, k] += product * about[k]
    for i in range(3):
        for j in range(3):
            a, b = max(i, j), min(i, j)
            second[i, j] = second[a, b]
            for k in range(3):
                third[i, j, k] = third[max(a, k), min(max(b, k), a), min(b, k)]
    return centre, second, third


@njit(cache=True, nogil=True)
def _moved(points: Floats, frame: Floats) -> Floats:
    """Points (N, 3) in another frame (4, 4), without the copies that a product of matrices makes."""
    result = np.empty(points.shape)
    for p in range(len(points)):
        for k in range(3):
            moved = frame[k, 0] * points[p, 0] + frame[k, 1] * points[p, 1] + frame[k, 2] * points[p, 2]
            result[p, k] = moved + frame[k, 3]
    return result
