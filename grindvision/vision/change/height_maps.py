"""Height maps over the good surface: the frame of a piece, the ground under its nodes, heights from a scan's points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import inverse, move_points, rotate_vectors
from grindvision.geometry.height_map import HeightMap
from grindvision.geometry.transforms import rigid
from grindvision.records import by_content
from grindvision.vision.surface.signed_distance import signed_distances
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

STEEPEST = float(np.cos(np.radians(45)))
"""Cosine between the normals of a piece and their mean below which it is cut: one plane no longer holds the map."""

MAX_NODES = 1_000_000
"""A map of more nodes gets a wider spacing."""

MIN_WEIGHT = 0.5
"""Sum of the weights of the points about a node from which its height counts as measured."""


@by_content
@dataclass(frozen=True)
class MeasuredHeights:
    """Heights (R, C) in mm over the nodes of a map.

    ``weights`` (R, C): effective number of points behind each, 0 where there are none; ``counts`` (R, C): points whose
    nearest node it is, ``squares_mm2`` (R, C) the mean square of what they differ by from the heights.
    """

    heights_mm: Floats
    weights: Floats
    counts: Floats
    squares_mm2: Floats


def flat_parts(feet: Floats, normals: Floats) -> Iterator[Integers]:
    """Indices of the points (N, 3) part by part, so that the ``normals`` (N, 3) of each fit in one map."""
    waiting = [np.arange(len(feet))]
    while waiting:
        part = waiting.pop()
        mean = normals[part].mean(axis=0)
        length = np.linalg.norm(mean)
        if len(part) < 30 or (length > 0.3 and np.quantile(normals[part] @ mean / length, 0.02) > STEEPEST):
            yield part
            continue
        spread = normals[part] - mean
        side = spread @ np.linalg.eigh(spread.T @ spread)[1][:, -1] > 0
        if side.all() or not side.any():
            yield part
            continue
        waiting += [part[~side], part[side]]


def map_frame(feet: Floats, normals: Floats, margin_mm: float) -> tuple[Floats, Floats]:
    """T_scan_map (4, 4) of a piece's feet (N, 3), and the map's size (2,) in mm along x and y, a margin around them."""
    up = normals.mean(axis=0)
    up /= np.linalg.norm(up)
    middle = feet.mean(axis=0)
    flat = (feet - middle) - ((feet - middle) @ up)[:, None] * up
    along = np.linalg.eigh(flat.T @ flat)[1][:, -1]
    along = along - (along @ up) * up
    along *= np.sign(along[np.abs(along).argmax()]) / np.linalg.norm(along)
    axes = np.column_stack([along, np.cross(up, along), up])
    places = (feet - middle) @ axes[:, :2]
    low = places.min(axis=0) - margin_mm
    return rigid(axes, middle + axes[:, :2] @ low), places.max(axis=0) + margin_mm - low


def empty_map(surface: Surfels, T_scan_map: Floats, size_mm: Floats, spacing_mm: float) -> HeightMap:
    """The ground of a map: where the normals of its plane meet the ``surface``, in the frame of the scan."""
    spacing_mm = max(spacing_mm, float(np.sqrt(size_mm[0] * size_mm[1] / MAX_NODES)))
    rows, columns = (max(int(np.ceil(size / spacing_mm)) + 1, 3) for size in size_mm)
    x, y = np.meshgrid(np.arange(rows) * spacing_mm, np.arange(columns) * spacing_mm, indexing="ij")
    places = np.column_stack([x.ravel(), y.ravel()])
    elevation = _first_elevation(surface, T_scan_map, places)
    normals = np.full((len(places), 3), np.nan)
    found = np.isfinite(elevation)
    for _ in range(4):
        at = np.flatnonzero(found)
        points = move_points(T_scan_map, np.column_stack([places[at], elevation[at]]))
        distances, up, _ = signed_distances(surface, points, 2 * surface.grid.size_mm)
        up = rotate_vectors(inverse(T_scan_map), up)
        good = np.isfinite(distances) & (up[:, 2] > 0.3)
        found[at[~good]] = False
        elevation[at[good]] -= distances[good] / up[good, 2]
        normals[at[good]] = up[good]
    elevation[~found], normals[~found] = np.nan, np.nan
    shape = (rows, columns)
    return HeightMap(
        T_scan_map, spacing_mm, elevation.reshape(shape), normals.reshape(*shape, 3), np.full(shape, np.nan)
    )


def _first_elevation(surface: Surfels, T_scan_map: Floats, places: Floats) -> Floats:
    """Elevation (N,) of the plane of the surfel next to each place (N, 2), the highest ones first; NaN where there is
    none."""
    from scipy.spatial import cKDTree

    centres = move_points(inverse(T_scan_map), surface.points)
    normals = rotate_vectors(inverse(T_scan_map), surface.normals)
    size = surface.grid.size_mm
    reach = float(np.ptp(places, axis=0).max())
    low, high = places.min(axis=0) - 2 * size, places.max(axis=0) + 2 * size
    near = ((centres[:, :2] > low) & (centres[:, :2] < high)).all(axis=1)
    near &= (normals[:, 2] > 0.3) & (np.abs(centres[:, 2]) < reach)
    if not near.any():
        return np.full(len(places), np.nan)
    centres, normals = centres[near], normals[near]
    away, at = cKDTree(centres[:, :2]).query(places, distance_upper_bound=1.5 * size)
    shown = np.isfinite(away)
    at = np.where(shown, at, 0)
    offsets = places - centres[at, :2]
    sloped = centres[at, 2] - (offsets * normals[at, :2]).sum(axis=1) / normals[at, 2]
    return np.where(shown, sloped, np.nan)


def measure_heights(all_points: Floats, surface: Surfels, empty: HeightMap, highest_mm: float) -> MeasuredHeights:
    """Heights of points (N, 3) over the nodes of a map: at each a plane through those about it, the nearer ones first.

    Points farther than ``highest_mm`` above the ``surface``, or as deep below it, are of another face.
    """
    spacing, shape = empty.spacing_mm, empty.shape
    back = inverse(empty.T_scan_map)
    reach = highest_mm + 2 * spacing
    corners = np.array([[0.0, 0.0], [(shape[0] - 1) * spacing, (shape[1] - 1) * spacing]])
    inside = _in_box(move_points(back, all_points), corners + [[-reach], [reach]], empty.ground_mm, reach)
    points = all_points[inside]
    distances, up, _ = signed_distances(surface, points, max(2 * surface.grid.size_mm, highest_mm))
    kept = np.isfinite(distances) & (np.abs(distances) <= highest_mm)
    feet = move_points(back, points[kept] - distances[kept, None] * up[kept])
    return _planes_at_nodes(feet[:, :2] / spacing, distances[kept], shape)


def _in_box(points: Floats, sides: Floats, ground: Floats, reach: float) -> NDArray[np.bool_]:
    low, high = np.nanmin(ground, initial=np.inf) - reach, np.nanmax(ground, initial=-np.inf) + reach
    inside = ((points[:, :2] > sides[0]) & (points[:, :2] < sides[1])).all(axis=1)
    return inside & (points[:, 2] > low) & (points[:, 2] < high)


def _planes_at_nodes(places: Floats, heights: Floats, shape: tuple[int, int]) -> MeasuredHeights:
    """Local planes through heights (N,) at places (N, 2), in nodes, each weighted by its nearness to the node."""
    first = np.floor(places).astype(np.int64)
    sums = np.zeros((10, shape[0] * shape[1]))
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        node = first + corner
        inside = ((node >= 0) & (node < shape)).all(axis=1)
        x, y = (places[inside] - node[inside]).T
        h, at = heights[inside], node[inside, 0] * shape[1] + node[inside, 1]
        w = (1 - np.abs(x)) * (1 - np.abs(y))
        terms = (w, w * x, w * y, w * x * x, w * x * y, w * y * y, w * h, w * x * h, w * y * h, w * w)
        for row, term in zip(sums, terms, strict=True):
            row += np.bincount(at, term, len(row))
    w, wx, wy, wxx, wxy, wyy, wh, wxh, wyh, ww = sums
    eased = 0.02 * w + 1e-12  # where the points lie on one side or in one line, the plane is held level
    matrix = np.stack([w, wx, wy, wx, wxx + eased, wxy, wy, wxy, wyy + eased], axis=-1).reshape(-1, 3, 3)
    shown = w > MIN_WEIGHT
    fitted = np.full(len(w), np.nan)
    planes = np.linalg.solve(matrix[shown], np.column_stack([wh, wxh, wyh])[shown, :, None])[:, :, 0]
    fitted[shown] = planes[:, 0]
    effective = np.where(shown, w**2 / np.maximum(ww, 1e-300), 0.0)
    left = _residuals(places, heights, fitted.reshape(shape))
    return MeasuredHeights(fitted.reshape(shape), effective.reshape(shape), *left)


def _residuals(places: Floats, heights: Floats, fitted: Floats) -> tuple[Floats, Floats]:
    """Number (R, C) of the points by their nearest node, and mean square of what their heights (N,) differ by from
    those between the nodes."""
    from scipy.ndimage import map_coordinates

    left = heights - map_coordinates(fitted, places.T, order=1, mode="constant", cval=np.nan)
    known = np.isfinite(left)
    at = np.ravel_multi_index(tuple(np.rint(places[known]).astype(np.int64).T), fitted.shape)
    sums, counts = (np.bincount(at, what, fitted.size) for what in (left[known] ** 2, None))
    return counts.reshape(fitted.shape).astype(float), (sums / np.maximum(counts, 1)).reshape(fitted.shape)
