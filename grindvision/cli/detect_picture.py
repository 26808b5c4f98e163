"""report.png of ``grindvision detect``: four views in the manner of the first paper's Figure 7."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from grindvision.cli.detect_shown import Shown, View
from grindvision.cli.pictures import save_png
from grindvision.cli.verdict import draw_verdict
from grindvision.extras import extra
from grindvision.relief import draw_relief, name_colour, rasterised

with extra("plot"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SAMPLE, TEST, HIGHLIGHT, GREY, LIGHT_GREY = "#56B4E9", "#E69F00", "#D55E00", "#999999", "#dddddd"

USUAL_TICKS = 8
"""An axis of such a panel has no more."""

TITLE_AT = 1.0
"""Upper end of a panel, where Matplotlib would put the title after it has measured all that is drawn there."""


@dataclass(frozen=True)
class Sheet:
    """The figure with its four panels."""

    figure: Figure
    before: Axes
    after: Axes
    signed: Axes
    path: Axes


def blank() -> Sheet:
    """A sheet with all that is the same in every picture: it can be made ready before anything is known."""
    figure = Figure(figsize=(12, 10))
    # laid out by hand: half the time of a constrained layout
    margins = {"left": 0.06, "right": 0.985, "bottom": 0.06, "wspace": 0.15, "hspace": 0.2}
    (before, after), (signed, path_view) = figure.subplots(2, 2, gridspec_kw=margins)
    for axes, title in ((before, "before registration"), (after, "after registration")):
        name_colour(axes, SAMPLE, "sample")
        name_colour(axes, TEST, "test")
        axes.set_title(title, y=TITLE_AT)
        axes.legend(frameon=True, framealpha=0.9, edgecolor="none", loc="upper right")
    for axes in (before, after, signed, path_view):
        axes.set(xlabel="along the scan's longer side, mm", ylabel="across, mm")
        for axis in (axes.xaxis, axes.yaxis):
            axis.get_major_ticks(USUAL_TICKS)  # makes them
    return Sheet(figure, before, after, signed, path_view)


def draw(found: Shown, warnings: Sequence[str], path: Path, sheet: Sheet | None = None) -> None:
    """Draw the verdict, the pair before and after registration, the signed difference, and the path; on a blank
    ``sheet``, if there is one already."""
    sheet = blank() if sheet is None else sheet
    view = View(found.test, found.normals)
    test = view(found.test), view.heights(found.test)
    for axes, other in ((sheet.before, found.sample), (sheet.after, found.registered)):
        draw_relief(axes, view(other), view.heights(other), SAMPLE)
        draw_relief(axes, *test, TEST, opacity=0.6)
    _draw_difference(sheet.signed, view, found)
    _draw_path(sheet.path, view, found)
    for axes in (sheet.before, sheet.after, sheet.signed, sheet.path):
        axes.set_aspect("equal")
    draw_verdict(sheet.figure, found.verdict, found.facts, warnings)
    save_png(sheet.figure, path)


def _draw_difference(axes: Axes, view: View, found: Shown) -> None:
    limit = max(4 * found.level_of_detection_mm, *found.peaks_mm, 0)
    known = found.comparable & np.isfinite(found.signed_mm)
    places = view(found.compared)
    everywhere = rasterised(places, np.zeros(len(places)))
    everywhere.draw(axes, everywhere.cells, cmap="gray", vmin=-1.5, vmax=1.0)
    heights = rasterised(places[known], found.signed_mm[known], everywhere.size_mm)
    colours = heights.draw(axes, heights.cells, cmap="RdBu_r", vmin=-limit, vmax=limit)
    axes.figure.colorbar(colours, ax=axes, label="above the good surface, mm", shrink=0.8)
    axes.set_title(
        f"difference; seen above {found.level_of_detection_mm:.2f} mm, grey: not compared", fontsize=11, y=TITLE_AT
    )


def _draw_path(axes: Axes, view: View, found: Shown) -> None:
    if not found.beads:
        draw_relief(axes, view(found.test), view.heights(found.test), LIGHT_GREY)
        axes.plot(*view(found.standing).T, ".", ms=2, color=TEST)
        axes.set_title("no path" if found.pieces else "nothing to grind", y=TITLE_AT)
        return
    bead = found.beads[0]
    middle = view(bead.points).mean(axis=0)
    size_mm = draw_relief(axes, view(found.near), view.heights(found.near), LIGHT_GREY)
    draw_relief(axes, view(found.standing), view.heights(found.standing), TEST, size_mm=size_mm)
    for one in found.beads:
        ridge = np.vstack([one.ridge, one.ridge[:1]]) if one.closed else one.ridge
        axes.plot(*view(ridge).T, color=HIGHLIGHT, lw=1)
        axes.plot(*view(one.points).T, "o", ms=5, color=HIGHLIGHT, mec="black")
    for number, place in enumerate(view(bead.points), start=1):
        axes.annotate(str(number), place, xytext=(4, 4), textcoords="offset points")
    reach = np.array([-found.reach_mm, found.reach_mm])
    axes.set(xlim=middle[0] + reach, ylim=middle[1] + reach)
    axes.set_title("path" if len(found.beads) == 1 else f"path on the largest of {len(found.beads)} beads", y=TITLE_AT)
