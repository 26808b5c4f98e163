"""Draws paths found from several orientations in the layout of Figures 9 to 12 of diao2018."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Side of the squares that the paper draws round corresponding points.
SQUARE_MM = 0.5

#: Half the width of an enlarged view of one point.
_VIEW_MM = 0.42

_MARKERS = ("o", "s", "^", "D")
_SHADES = (0.0, 0.32, 0.6, 0.85)


def draw_curves(paths: pd.DataFrame, arrow_mm: float = 6.0) -> Figure:
    """Figure 9: every orientation's path in the base frame, normals as arrows, the same scale on all axes.

    Args:
        paths: ``orientation, point, x_mm, y_mm, z_mm, nx, ny, nz``, up to four orientations.
        arrow_mm: length of a normal's arrow.
    """
    import matplotlib.pyplot as plt
    from matplotlib.ticker import MaxNLocator

    fig = plt.figure(figsize=(7.0, 4.6))
    axes = fig.add_subplot(projection="3d")
    for (name, path), colour, marker in zip(paths.groupby("orientation"), _colours(), _MARKERS, strict=False):
        at, normals = path[["x_mm", "y_mm", "z_mm"]].to_numpy(), path[["nx", "ny", "nz"]].to_numpy()
        axes.plot(*at.T, color=colour, marker=marker, markersize=4, linewidth=1.2, label=name)
        axes.quiver(*at.T, *(arrow_mm * normals).T, color=colour, linewidth=0.9, arrow_length_ratio=0.2)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)")
    at = paths[["x_mm", "y_mm", "z_mm"]].to_numpy()
    everything = np.concatenate([at, at + arrow_mm * paths[["nx", "ny", "nz"]].to_numpy()])
    low, high = everything.min(axis=0) - 1, everything.max(axis=0) + 1
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.1)
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.zaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.labelpad = 8
    axes.view_init(elev=24, azim=-62)
    axes.legend(title="orientation", loc="upper right")
    return fig


def draw_projection(paths: pd.DataFrame, across: str, up: str) -> Figure:
    """Figures 10 to 12: the paths projected on two axes of the base frame.

    Above as the paper draws it: each axis with its own scale, so the squares of 0.5 mm look like rectangles. Below each
    point enlarged with equal axes, where a square is a square.

    Args:
        paths: as in ``draw_curves``.
        across, up: axes, ``x``, ``y`` or ``z``.
    """
    import matplotlib.pyplot as plt

    numbers = sorted(paths["point"].unique())
    fig = plt.figure(figsize=(7.0, 5.2))
    grid = fig.add_gridspec(2, len(numbers), height_ratios=(2.6, 1.0))
    whole = fig.add_subplot(grid[0, :])
    _draw_points(whole, paths, across, up, lines=True)
    whole.set(xlabel=f"{across} (mm)", ylabel=f"{up} (mm)")
    fig.legend(*whole.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    for column, number in enumerate(numbers):
        here = paths[paths["point"] == number]
        centre = _middle(here, across, up)
        _draw_square(whole, centre)
        view = fig.add_subplot(grid[1, column])
        _draw_points(view, here, across, up, lines=False)
        _draw_square(view, centre)
        view.set_title(f"point {number}", fontsize="small")
        view.set_aspect("equal")
        view.set(xlim=centre[0] + np.array([-1, 1]) * _VIEW_MM, ylim=centre[1] + np.array([-1, 1]) * _VIEW_MM)
        view.set(xticks=[], yticks=[])
        whole.annotate(
            str(number),
            (centre[0], centre[1]),
            xytext=(-9, 9),
            textcoords="offset points",
            ha="center",
            fontsize="small",
        )
    return fig


def draw_squares(axes: Axes, paths: pd.DataFrame, across: str, up: str) -> pd.DataFrame:
    """Every point of the paths about the middle of those that correspond, each with its square, to one scale.

    Args:
        axes: to draw into.
        paths: as in ``draw_curves``.
        across, up: axes of the base frame, ``x``, ``y`` or ``z``.

    Returns:
        What is drawn: ``orientation, point`` and the two distances from the middle, mm.
    """
    import pandas as pd

    parts = []
    for number, here in paths.groupby("point"):
        row, column = divmod(int(number) - 1, 3)
        place, centre = np.array([column, -row]) * 2 * _VIEW_MM, _middle(here, across, up)
        off = here[[f"{across}_mm", f"{up}_mm"]] - centre
        _draw_points(axes, (off + place).assign(orientation=here["orientation"]), across, up, lines=False)
        _draw_square(axes, place)
        axes.annotate(str(number), (place[0], place[1] + 0.29), ha="center", va="bottom", fontsize="small")
        parts.append(here[["orientation", "point"]].join(off))
    axes.set(aspect="equal", xticks=[], yticks=[], xlim=(-0.45, 2.13), ylim=(-1.6, 0.55))
    axes.set_axis_off()
    count = paths["orientation"].nunique()
    marks, names = axes.get_legend_handles_labels()
    spaces = {"handlelength": 0.6, "handletextpad": 0.3, "columnspacing": 0.8}
    axes.legend(marks[:count], names[:count], loc="lower center", ncols=count, fontsize=7, **spaces)
    return pd.concat(parts)


def _draw_points(axes: Axes, paths: pd.DataFrame, across: str, up: str, lines: bool) -> None:
    for (name, path), colour, marker in zip(paths.groupby("orientation"), _colours(), _MARKERS, strict=False):
        style = {"linewidth": 1.0} if lines else {"linestyle": "none"}
        x, y = path[f"{across}_mm"].to_numpy(), path[f"{up}_mm"].to_numpy()
        axes.plot(x, y, color=colour, marker=marker, markersize=4, label=name, **style)
        if lines:
            u, v = 2 * path[f"n{across}"].to_numpy(), 2 * path[f"n{up}"].to_numpy()
            axes.update_datalim(np.column_stack([x + u, y + v]))
            axes.quiver(x, y, u, v, color=colour, width=0.002, angles="xy", scale_units="xy", scale=1.0)


def _draw_square(axes: Axes, centre: NDArray[np.float64]) -> None:
    from matplotlib.patches import Rectangle

    left, bottom = centre - SQUARE_MM / 2
    axes.add_patch(Rectangle((left, bottom), SQUARE_MM, SQUARE_MM, fill=False, edgecolor="0.35", linewidth=0.9))


def _middle(points: pd.DataFrame, across: str, up: str) -> NDArray[np.float64]:
    both = points[[f"{across}_mm", f"{up}_mm"]].to_numpy()
    return (both.min(axis=0) + both.max(axis=0)) / 2


def _colours() -> list[tuple[float, ...]]:
    import matplotlib as mpl

    return [mpl.colormaps["viridis"](shade) for shade in _SHADES]
