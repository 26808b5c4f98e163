"""report.png of ``grindvision detect``: four views in the manner of the first paper's Figure 7."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grindvision.cli.pictures import save_png
from grindvision.cli.verdict import draw_verdict
from grindvision.extras import extra
from grindvision.geometry import inverse, move_points
from grindvision.relief import draw_relief, name_colour, rasterised
from grindvision.words import counted

with extra("plot"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

if TYPE_CHECKING:
    from grindvision.vision.change.detection import Detection

SAMPLE, TEST, HIGHLIGHT, GREY, LIGHT_GREY = "#56B4E9", "#E69F00", "#D55E00", "#999999", "#dddddd"


def draw(found: Detection, warnings: Sequence[str], path: Path) -> None:
    """Draw the verdict, the pair before and after registration, the signed difference, and the path."""
    test, sample = found.test.surfels.points, found.sample.surfels.points
    registered = move_points(inverse(found.T_sample_test), sample)
    view = _View(test, found.test.surfels.normals)
    figure = Figure(figsize=(12, 10))
    # laid out by hand: half the time of a constrained layout
    margins = {"left": 0.06, "right": 0.985, "bottom": 0.06, "wspace": 0.15, "hspace": 0.2}
    (before, after), (signed, path_view) = figure.subplots(2, 2, gridspec_kw=margins)
    for axes, title, other in ((before, "before registration", sample), (after, "after registration", registered)):
        draw_relief(axes, view(other), view.heights(other), SAMPLE)
        draw_relief(axes, view(test), view.heights(test), TEST, opacity=0.6)
        name_colour(axes, SAMPLE, "sample")
        name_colour(axes, TEST, "test")
        axes.set_title(title)
        axes.legend(frameon=True, framealpha=0.9, edgecolor="none", loc="upper right")
    _draw_difference(signed, view, found)
    _draw_path(path_view, view, found)
    for axes in (before, after, signed, path_view):
        axes.set_aspect("equal")
        axes.set(xlabel="along the scan's longer side, mm", ylabel="across, mm")
    draw_verdict(figure, *_verdict(found), warnings)
    save_png(figure, path)


def _verdict(found: Detection) -> tuple[str, str]:
    registration = found.registration
    facts = (
        f"Registration: confidence {found.confidence:.2f}, overlap {registration.overlap:.0%},"
        f" rms {registration.rms_mm:.3f} mm. Frame: scanner frame of the test scan."
    )
    standing = len(found.difference.clusters) or len(found.difference.specks)
    if not found.beads and standing:
        return f"No path: {counted(standing, 'piece stands', 'pieces stand')} out, none to be followed", facts
    if not found.beads:
        level, cell = found.difference.level_of_detection_mm, found.test.surfels.grid.size_mm
        return f"Nothing to grind: no difference above {level:.2f} mm, compared in cells of {cell:.2g} mm", facts
    bead = found.beads[0]
    size = f"{bead.length_mm:.1f} x {bead.width_mm:.1f} mm, {bead.height_mm:.2f} mm high"
    beads = counted(len(found.beads), "bead")
    largest = "it measures" if len(found.beads) == 1 else "the largest measures"
    return f"Found {beads} to grind, {len(found.path_points)} path points; {largest} {size}", facts


class _View:
    """Looks at a scan along its direction of least spread, from the side to which the normals point."""

    def __init__(self, points: np.ndarray, normals: np.ndarray) -> None:
        self.middle = points.mean(axis=0)
        _, axes = np.linalg.eigh(np.cov((points - self.middle).T))
        self.axes = axes[:, [2, 1]] * np.sign(axes[np.abs(axes[:, [2, 1]]).argmax(axis=0), [2, 1]])
        self.towards_eye = np.cross(*self.axes.T)
        if self.towards_eye @ normals.mean(axis=0) < 0:
            self.axes[:, 1] *= -1
            self.towards_eye *= -1

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return (points - self.middle) @ self.axes

    def heights(self, points: np.ndarray) -> np.ndarray:
        return (points - self.middle) @ self.towards_eye


def _draw_difference(axes: Axes, view: _View, found: Detection) -> None:
    difference = found.difference
    limit = max(4 * difference.level_of_detection_mm, *(cluster.peak_mm for cluster in difference.clusters), 0)
    shown = difference.comparable & np.isfinite(difference.signed_mm)
    places = view(difference.surfels)
    everywhere = rasterised(places, np.zeros(len(places)))
    everywhere.draw(axes, everywhere.cells, cmap="gray", vmin=-1.5, vmax=1.0)
    heights = rasterised(places[shown], difference.signed_mm[shown], everywhere.size_mm)
    colours = heights.draw(axes, heights.cells, cmap="RdBu_r", vmin=-limit, vmax=limit)
    axes.figure.colorbar(colours, ax=axes, label="above the good surface, mm", shrink=0.8)
    axes.set_title(f"difference; seen above {difference.level_of_detection_mm:.2f} mm, grey: not compared", fontsize=11)


def _draw_path(axes: Axes, view: _View, found: Detection) -> None:
    if not found.beads:
        points = found.test.surfels.points
        draw_relief(axes, view(points), view.heights(points), LIGHT_GREY)
        axes.plot(*view(found.difference.points).T, ".", ms=2, color=TEST)
        axes.set_title("no path" if found.difference.clusters or found.difference.specks else "nothing to grind")
        return
    bead = found.beads[0]
    reach = 0.75 * bead.length_mm + 3 * bead.width_mm
    middle = view(bead.points).mean(axis=0)
    near = np.abs(view(found.test.points) - middle).max(axis=1) < reach
    points = found.test.points[near]
    size_mm = draw_relief(axes, view(points), view.heights(points), LIGHT_GREY)
    draw_relief(axes, view(found.difference.points), view.heights(found.difference.points), TEST, size_mm=size_mm)
    for one in found.beads:
        ridge = np.vstack([one.ridge, one.ridge[:1]]) if one.closed else one.ridge
        axes.plot(*view(ridge).T, color=HIGHLIGHT, lw=1)
        axes.plot(*view(one.points).T, "o", ms=5, color=HIGHLIGHT, mec="black")
    for number, place in enumerate(view(bead.points), start=1):
        axes.annotate(str(number), place, xytext=(4, 4), textcoords="offset points")
    axes.set(xlim=middle[0] + np.array([-reach, reach]), ylim=middle[1] + np.array([-reach, reach]))
    axes.set_title("path" if len(found.beads) == 1 else f"path on the largest of {len(found.beads)} beads")
