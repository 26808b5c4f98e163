"""Clouds in report.png as surfaces: dots taken at a fixed step from the rows of a scan make moiré patterns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from grindvision.extras import extra
from grindvision.records import by_content

with extra("plot"):
    from matplotlib.colors import to_rgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Cells along the longer side at most: a panel of these reports has no more pixels.
MAX_CELLS = 420
#: Points per cell on average: with two few cells of a scanned surface stay empty, and those are filled.
POINTS_PER_CELL = 2
#: Slope that is drawn as 45 degrees: the steepest tenth of the surface, within these limits (flat plates would else
#: show nothing but their noise, steep ones black walls).
SLOPES = (0.25, 1.0)
#: Towards the light, from the upper left; and how bright a surface is that looks away from it.
LIGHT, AMBIENT = np.array([-0.45, 0.45, 0.77]), 0.5


@by_content
@dataclass(frozen=True)
class Raster:
    """Means of values over square cells: ``cells`` (rows, columns), NaN where no point lies, in mm in a panel."""

    cells: np.ndarray
    corner_mm: np.ndarray
    size_mm: float

    def draw(self, axes: Axes, image: np.ndarray, **how: Any) -> Any:
        """Show an image of these cells where they lie; the cloud's outline stays clear of the panel's frame."""
        rows, columns = self.cells.shape
        (left, low), (right, high) = self.corner_mm, self.corner_mm + self.size_mm * np.array([columns, rows])
        downwards = axes.yaxis_inverted()
        shown = axes.imshow(image, origin="lower", extent=(left, right, low, high), interpolation="nearest", **how)
        axes.yaxis.set_inverted(downwards)
        axes.use_sticky_edges = False
        axes.margins(0.03)
        axes.autoscale_view()
        return shown


def rasterised(places: np.ndarray, values: np.ndarray, size_mm: float = 0.0) -> Raster:
    """Means of the values (N,) of points at ``places`` (N, 2), mm, over cells of a size; 0: it follows from the points.

    An empty cell that points surround, as they leave them between the rows of a scan, takes its neighbours' mean.
    """
    low, high = places.min(axis=0), places.max(axis=0)
    sides = np.maximum(high - low, 1e-6)
    smallest = sides.max() / MAX_CELLS
    size_mm = float(max(size_mm or np.sqrt(POINTS_PER_CELL * sides.prod() / len(places)), smallest))
    at = np.floor((places - low) / size_mm).astype(int)
    columns, rows = at.max(axis=0) + 1
    cell = at[:, 1] * columns + at[:, 0]
    counts = np.bincount(cell, minlength=rows * columns).reshape(rows, columns).astype(float)
    sums = np.bincount(cell, values, rows * columns).reshape(rows, columns)
    holes = (counts == 0) & (_around((counts > 0).astype(float)) >= 5)
    counts, sums = np.where(holes, _around(counts), counts), np.where(holes, _around(sums), sums)
    return Raster(np.where(counts > 0, sums / np.maximum(counts, 1e-9), np.nan), low, size_mm)


def draw_relief(
    axes: Axes, places: np.ndarray, heights: np.ndarray, colour: str, opacity: float = 1.0, size_mm: float = 0.0
) -> float:
    """Draw points as a surface in one colour, lit from the upper left; returns the size of its cells, mm.

    Args:
        axes: panel with equal scales; whoever wants its second axis to run downwards inverts it before.
        places: (N, 2) in the panel's two axes, mm.
        heights: (N,) towards the eye, mm.
        colour: of the surface where it looks at the eye.
        opacity: 1 hides what was drawn before.
        size_mm: of the cells; 0: it follows from the points.
    """
    if len(places) == 0:
        return size_mm
    surface = rasterised(places, heights, size_mm)
    image = np.empty((*surface.cells.shape, 4), dtype=np.float32)
    brightness = _brightness(surface.cells, surface.size_mm, axes.yaxis_inverted())
    image[..., :3] = np.clip(brightness[..., None] * np.array(to_rgb(colour)), 0, 1)
    image[..., 3] = opacity * np.isfinite(surface.cells)
    surface.draw(axes, image)
    return surface.size_mm


def name_colour(axes: Axes, colour: str, label: str) -> None:
    """An entry in the legend for a surface of that colour."""
    axes.plot([], [], "o", ms=6, color=colour, label=label)


def _around(cells: np.ndarray) -> np.ndarray:
    """Sum over the eight neighbours of every cell."""
    framed = np.pad(cells, 1)
    rows, columns = cells.shape
    around = sum(framed[row : row + rows, column : column + columns] for row in range(3) for column in range(3))
    return np.asarray(around - cells)


def _brightness(surface: np.ndarray, size_mm: float, downwards: bool) -> np.ndarray:
    """How bright each cell is, 1 where the surface looks at the eye; where a slope is unknown it counts as level."""
    if min(surface.shape) < 2:
        return np.ones(surface.shape)
    up, right = (np.nan_to_num(slope) for slope in np.gradient(surface, size_mm))
    up = -up if downwards else up
    scale = np.clip(np.quantile(np.hypot(right, up), 0.9), *SLOPES)
    normals = np.stack([-right / scale, -up / scale, np.ones_like(right)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    lit = np.clip(normals @ LIGHT, 0, None) / LIGHT[2]
    return AMBIENT + (1 - AMBIENT) * lit
