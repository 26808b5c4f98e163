"""Figure 7: two scans of one part apart, roughly together and together, as shaded surfaces with their distances."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.geometry import move_points, rotate_vectors
from grindvision.vision.surface.surfels import Surfels
from grindvision_book.machinery.session import COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

#: Points drawn of each scan, and the distance in mm at which a colour is full.
DRAWN, FULL_MM = 5000, 2.0

_LIGHT = np.array([-0.4, 0.3, 0.87])


def distances_mm(points: Floats, surface: Surfels, reach_mm: float = 6.0) -> Floats:
    """Signed distances (N,) of points from the plane of the nearest surfel; NaN beyond the surface's edge."""
    near, at = cKDTree(surface.points).query(points)
    along = np.einsum("ij,ij->i", points - surface.points[at], surface.normals[at])
    aside = np.sqrt(np.maximum(near**2 - along**2, 0))
    return np.where(aside < reach_mm, along, np.nan)


def draw_figure_7(
    sample: Surfels,
    test: Surfels,
    T_coarse: Floats,
    T_accurate: Floats,
    difference: Floats,
    path: Floats,
    path_normals: Floats,
) -> tuple[Figure, pd.DataFrame]:
    """The five panels and what is drawn in them, in the frame of the sample scan, mm.

    Args:
        sample, test: surfels of both scans, each in its own frame.
        T_coarse, T_accurate: T_sample_test (4, 4) after the first alignment and after ICP.
        difference: points (N, 3) of what the test part has too much, frame of the test scan.
        path, path_normals: (K, 3), frame of the test scan.
    """
    from matplotlib import pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize, to_rgb

    view = _view(sample)
    some, few = _some(sample), _some(test)
    blue, orange = np.array(to_rgb(COLOURS["sample"])), np.array(to_rgb(COLOURS["test"]))
    fig = plt.figure(figsize=(10.5, 6.2))
    grid = fig.add_gridspec(2, 6, height_ratios=[1, 1])
    axes = [fig.add_subplot(grid[0, 2 * k : 2 * k + 2]) for k in range(3)]
    axes += [fig.add_subplot(grid[1, :3]), fig.add_subplot(grid[1, 3:])]
    points, normals = sample.points[some], sample.normals[some]
    both = np.vstack([points, test.points[few]]), np.vstack([normals, test.normals[few]])
    own = np.repeat([blue, orange], [len(some), len(few)], axis=0)
    _surface(axes[0], *both, own, view)
    frames = [_rows("a", "sample", points), _rows("a", "test", test.points[few])]
    shown = {"(b) coarse, by the paper's SAC-IA": T_coarse, "(c) accurate, after ICP": T_accurate}
    for one, (title, T_sample_test) in zip(axes[1:3], shown.items(), strict=True):
        moved = move_points(T_sample_test, test.points[few])
        apart = distances_mm(moved, sample)
        _surface(one, moved, rotate_vectors(T_sample_test, test.normals[few]), _colours(apart), view)
        one.set_title(f"{title}\nmedian distance {np.nanmedian(np.abs(apart)):.2f} mm", fontsize=11)
        frames.append(_rows(title[1], "test", moved, apart))
    axes[0].set_title("(a) unregistered:\neach scan in its own frame", fontsize=11)
    found = move_points(T_accurate, difference)
    height = distances_mm(found, sample)
    _surface(axes[3], points, normals, np.full((len(points), 3), 0.82), view, size=18.0)
    _dots(axes[3], found @ view.T, _colours(height), size=5)
    axes[3].set_title("(d) the difference on the good part", fontsize=11)
    frames.append(_rows("d", "difference", found, height))
    _path(axes[4], found, height, move_points(T_accurate, path), rotate_vectors(T_accurate, path_normals), view)
    frames.append(_rows("e", "path", move_points(T_accurate, path)))
    bar = ScalarMappable(Normalize(-FULL_MM, FULL_MM), "coolwarm")
    fig.colorbar(
        bar, ax=axes, location="right", shrink=0.5, aspect=30, label="test scan above the sample's surface, mm"
    )
    return fig, pd.concat(frames)


def _view(sample: Surfels) -> Floats:
    """Rows (3, 3): right, up and towards the eye; obliquely from the scanner's side."""
    part = np.linalg.svd(sample.points - sample.points.mean(axis=0), full_matrices=False)[2]
    up = part[2] * np.sign(-part[2, 2])
    right = part[0]
    back = np.cross(up, right)
    tilt = np.radians(50)
    return np.array([right, np.sin(tilt) * back + np.cos(tilt) * up, np.sin(tilt) * up - np.cos(tilt) * back])


def _some(surfels: Surfels) -> NDArray[np.int64]:
    return np.arange(0, len(surfels.points), max(len(surfels.points) // DRAWN, 1))


def _colours(distances: Floats) -> Floats:
    """Colours (N, 3) of distances in mm; grey where there is none."""
    from matplotlib import pyplot as plt

    colours = plt.get_cmap("coolwarm")(np.clip(distances / (2 * FULL_MM) + 0.5, 0, 1))[:, :3]
    return np.where(np.isfinite(distances)[:, None], colours, 0.7)


def _surface(axes: Axes, points: Floats, normals: Floats, colours: Floats, view: Floats, size: float = 10.0) -> None:
    """Points so dense that they close, shaded by their normals; the nearest to the eye last."""
    seen = points @ view.T
    order = np.argsort(seen[:, 2])
    brightness = 0.45 + 0.55 * np.abs(normals @ view.T @ _LIGHT)
    shaded = np.clip(colours * brightness[:, None], 0, 1)
    _dots(axes, seen[order], shaded[order], size)
    axes.set_aspect("equal")
    axes.axis("off")


def _dots(axes: Axes, places: Floats, colours: Floats, size: float) -> None:
    axes.scatter(places[:, 0], places[:, 1], c=colours, s=size, marker="s", linewidths=0, rasterized=True)


def _path(axes: Axes, found: Floats, height: Floats, path: Floats, normals: Floats, view: Floats) -> None:
    """The bead seen from the side, with the path points and their normals."""
    along = path[-1] - path[0]
    along /= np.linalg.norm(along)
    up = normals.mean(axis=0) - (normals.mean(axis=0) @ along) * along
    side = np.array([along * np.sign(along @ view[0]), up / np.linalg.norm(up)])
    _dots(axes, found @ side.T, _colours(height), size=9)
    axes.plot(*(path @ side.T).T, "o", color=COLOURS["ours"], markersize=7)
    for start, end in zip(path @ side.T, (path + 5 * normals) @ side.T, strict=True):
        axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": COLOURS["ours"]})
    tips = (path + 6 * normals) @ side.T
    axes.plot(*tips.T, alpha=0)  # room for the arrows
    axes.set_title("(e) path points and normals on it", fontsize=11)
    axes.set_aspect("equal")
    axes.axis("off")


def _rows(panel: str, cloud: str, points: Floats, distances: Floats | None = None) -> pd.DataFrame:
    rows = pd.DataFrame(np.round(points, 3), columns=["x_mm", "y_mm", "z_mm"])
    return rows.assign(distance_mm=np.nan if distances is None else np.round(distances, 3), panel=panel, cloud=cloud)
