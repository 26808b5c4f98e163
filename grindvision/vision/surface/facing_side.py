"""From which side a cloud was scanned, by normals that its file has: each turned to the camera that saw its point."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.geometry.bounds import diagonal_mm

Floats = NDArray[np.float64]

#: Directions that are tried, all round.
DIRECTIONS = 400

#: A side is believed that so many of the normals face: strays and edges may face elsewhere.
MIN_FACING = 0.95

#: A far viewpoint's distance, in diagonals of the cloud.
FAR = 20.0

#: Points near each place of a path whose normals are asked.
ASKED = 30


def viewpoint_by_normals(points: ArrayLike, normals: ArrayLike) -> Floats | None:
    """A far viewpoint (3,), mm, that nearly all normals (N, 3) of points (N, 3) face; None where there is none, as of
    views from all round and of normals of any sign."""
    points, normals = np.asarray(points, dtype=float), np.asarray(normals, dtype=float)
    some = slice(None, None, max(len(points) // 5000, 1))
    height = 1 - 2 * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    azimuth = np.pi * (1 + np.sqrt(5)) * np.arange(DIRECTIONS)
    flat = np.sqrt(1 - height**2)
    ways = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height])
    facing = (normals[some] @ ways.T > 0).mean(axis=0)
    best = int(np.argmax(facing))
    if facing[best] < MIN_FACING:
        return None
    # The middle of all directions that nearly all normals face is farthest from seeing any of them edge-on.
    middle = ways[facing >= facing[best] - 0.01].mean(axis=0)
    return np.asarray(points.mean(axis=0) + FAR * diagonal_mm(points) * middle / np.linalg.norm(middle))


def faces_with(points: ArrayLike, normals: ArrayLike, places: ArrayLike, outward: ArrayLike) -> float:
    """Fraction of the normals (N, 3) of points (N, 3) near ``places`` (K, 3) that lie on the side of ``outward`` (K, 3)
    there."""
    near = cKDTree(points).query(places, k=min(ASKED, len(np.asarray(points))))[1].reshape(len(np.asarray(places)), -1)
    return float((np.einsum("kni,ki->kn", np.asarray(normals)[near], np.asarray(outward)) > 0).mean())
