"""Pictures and measures of groove detection: clouds seen by the camera, sections across a groove, the overlap rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from numpy.typing import ArrayLike, NDArray

from grindvision.relief import draw_relief
from grindvision.vision.seam.groove_lines import DetectedGroove

Floats = NDArray[np.float64]

#: Colour of a shaded surface where it looks at the eye.
SURFACE = "#bbbbbb"


def overlap_percent(found: ArrayLike, truth: ArrayLike) -> float:
    """Points both found and true, over points found or true (peng2020, Section V-B), in percent."""
    found, truth = np.asarray(found, dtype=bool), np.asarray(truth, dtype=bool)
    return float(100 * (found & truth).sum() / max((found | truth).sum(), 1))


def sample_rows(count: int, wanted: int) -> NDArray[np.int64]:
    """About ``wanted`` row numbers spread evenly over ``count`` rows in a scrambled order, the same every time."""
    return np.sort(np.random.default_rng(0).permutation(count)[:wanted])


def even_rows(points: ArrayLike, wanted: int) -> NDArray[np.int64]:
    """About ``wanted`` rows of points (N, 3), one for each square of a lattice over x and y."""
    places = np.asarray(points, dtype=float)[:, :2]
    side = np.sqrt(np.prod(np.ptp(places, axis=0)) / wanted)
    away = np.abs((places / side) % 1 - 0.5).max(axis=1)
    nearest = np.argsort(away, kind="stable")
    _, first = np.unique(np.floor(places[nearest] / side), axis=0, return_index=True)
    return np.sort(nearest[first])


def painted(names: ArrayLike, colours: Mapping[str, str], normals: ArrayLike) -> Floats:
    """Colours (N, 3) of points by the name of their group; "neither" is grey, shaded by the normals (N, 3)."""
    from matplotlib.colors import to_rgb

    names = np.asarray(names)
    groups, group = np.unique(names, return_inverse=True)
    result = np.array([to_rgb(colours[name]) for name in groups.tolist()])[group]
    bare = names == "neither"
    light = np.array([-0.5, -0.6, -0.62])
    result[bare] = 0.5 + 0.42 * np.abs(np.asarray(normals)[bare] @ light)[:, None]
    return result


def draw_cloud(
    axes: Axes, points: ArrayLike, colours: ArrayLike, title: str = "", size: float = 1.5, **options: Any
) -> PathCollection:
    """Scatter points (N, 3) of the camera frame as the camera sees them: x to the right, y down."""
    points = np.asarray(points)
    drawn = axes.scatter(points[:, 0], points[:, 1], c=colours, s=size, linewidths=0, rasterized=True, **options)
    _look_through_camera(axes, title)
    return drawn


def draw_surface(axes: Axes, points: ArrayLike, colour: str, title: str = "", size_mm: float = 0.0) -> float:
    """Draw points (N, 3) of the camera frame as a shaded surface, as the camera sees them; returns its cells' size, mm.

    ``size_mm`` as ``draw_relief`` takes it.
    """
    points = np.asarray(points, dtype=float)
    _look_through_camera(axes, title)
    return draw_relief(axes, points[:, :2], -points[:, 2], colour, size_mm=size_mm)


def _look_through_camera(axes: Axes, title: str) -> None:
    axes.set(aspect="equal", title=title, xticks=[], yticks=[])
    if not axes.yaxis_inverted():
        axes.invert_yaxis()
    for side in axes.spines.values():
        side.set_visible(False)


def normal_colours(normals: ArrayLike) -> Floats:
    """A colour (N, 3) for every unit normal facing the camera: x and y turn into red and green."""
    normals = np.asarray(normals)
    return np.clip(np.column_stack([0.5 + 0.5 * normals[:, 0], 0.5 + 0.5 * normals[:, 1], -0.9 * normals[:, 2]]), 0, 1)


def groups(found: ArrayLike, truth: ArrayLike, names: Sequence[str] = ("neither", "missed", "extra", "both")) -> Floats:
    """Name (N,) of every point: true groove missed, found in excess, both, or neither."""
    return np.array(names)[np.asarray(truth, dtype=int) + 2 * np.asarray(found, dtype=int)]


def cross_section(points: ArrayLike, groove: DetectedGroove, station: int, thickness_mm: float) -> pd.DataFrame:
    """Points of a slice across a groove: ``across_mm`` from the root and ``height_mm`` above the surface's edges.

    The last three rows (``kind`` edge, root, edge) are the fitted section, the others ``kind`` point.
    """
    points = np.asarray(points, dtype=float)
    root, up = groove.root[station], groove.normals[station]
    along = groove.root[min(station + 1, len(groove.root) - 1)] - groove.root[max(station - 1, 0)]
    along = along - up * (along @ up)
    along /= np.linalg.norm(along)
    side = np.cross(up, along)
    level = np.mean([(groove.left[station] - root) @ up, (groove.right[station] - root) @ up])
    lines = np.array([groove.left[station], root, groove.right[station]])

    def placed(places: Floats, kind: Sequence[str]) -> pd.DataFrame:
        away = places - root
        return pd.DataFrame({"kind": kind, "across_mm": away @ side, "height_mm": away @ up - level})

    away = points - root
    near = (np.abs(away @ along) < thickness_mm / 2) & (np.abs(away @ side) < 1.6 * groove.width_mm[station])
    near &= np.abs(away @ up) < 2.5 * groove.depth_mm[station]
    return pd.concat(
        [placed(points[near], ["point"] * int(near.sum())), placed(lines, ["edge", "root", "edge"])], ignore_index=True
    )
