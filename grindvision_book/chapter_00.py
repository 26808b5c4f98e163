"""Draws the two papers' flow charts, and the papers' own methods beside ours, from the scoreboard."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from grindvision_book.machinery.session import COLOURS

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Step:
    """One box of a flow chart: ``name``, ``what`` (formula or section), ``chapters``, its ``column`` and ``row``.

    ``kind`` is ``data`` (what goes in and out), ``cloud``, ``calibration`` or ``path``. ``after`` names the steps that
    feed it.
    """

    name: str
    what: str
    chapters: str
    column: float
    row: float
    kind: str
    after: tuple[str, ...] = ()


GRINDING = (
    Step("sample scan", "good part", "01", 0, 0, "data"),
    Step("test scan", "part to grind", "01", 1, 0, "data"),
    Step("voxel grid", "Eqs 1-2", "01", 0.5, 1, "cloud", ("sample scan", "test scan")),
    Step("normals, FPFH", "Eqs 3-5", "05", 0.5, 2, "cloud", ("voxel grid",)),
    Step("SAC-IA", "coarse, Eq 6", "05", 0.5, 3, "cloud", ("normals, FPFH",)),
    Step("ICP", "fine, section 3.4", "05", 0.5, 4, "cloud", ("SAC-IA",)),
    Step("difference", "FLANN, section 3.5", "06", 1.75, 4, "cloud", ("ICP",)),
    Step("path points", "boxes, section 3.6", "06", 1.75, 3, "path", ("difference",)),
    Step("into the base frame", "T_base_scanner", "07", 1.75, 2, "path", ("path points", "accurate calibration")),
    Step("path for the robot", "Table 4, Figure 9", "07, 08", 1.75, 1, "data", ("into the base frame",)),
    Step("spheres, tracker", "9 spheres x 6 poses", "03", 3.0, 4, "data"),
    Step("coarse calibration", "three points, Eqs 7-8", "03", 3.0, 3, "calibration", ("spheres, tracker",)),
    Step("accurate calibration", "Eqs 9-18", "03, 04", 3.0, 2, "calibration", ("coarse calibration",)),
)

WELDING = (
    Step("depth cloud", "RGB-D camera", "10", 0, 0, "data"),
    Step("smoothing", "moving least squares", "10", 1, 0, "cloud", ("depth cloud",)),
    Step("normals", "planes in 5 mm", "10", 2, 0, "cloud", ("smoothing",)),
    Step("histograms", "to own, to mean normal", "10", 3, 0, "cloud", ("normals",)),
    Step("descriptor", "variation, threshold", "10", 3, 1, "cloud", ("histograms",)),
    Step("groove points", "largest cluster", "10", 2, 1, "data", ("descriptor",)),
    Step("slabs", "50 along the groove", "11", 1, 1, "path", ("groove points",)),
    Step("waypoints", "geometric medians", "11", 0, 1, "path", ("slabs",)),
    Step("orientations", "normals of the seam", "11", 0, 2, "path", ("waypoints",)),
    Step("torch trajectory", "6 degrees of freedom", "11", 1, 2, "data", ("orientations",)),
)

_FILL = {"data": "#ffffff", "cloud": "#dcecf7", "calibration": "#fbe9cf", "path": "#d8efe7"}
_EDGE = {
    "data": COLOURS["printed"],
    "cloud": COLOURS["ours"],
    "calibration": COLOURS["paper_variant"],
    "path": COLOURS["truth"],
}
_MEANING = {
    "data": "goes in or comes out",
    "cloud": "works on clouds",
    "calibration": "calibrates",
    "path": "makes the path",
}
_WIDTH, _HEIGHT, _ACROSS, _DOWN = 1.72, 0.66, 2.1, 1.0


def draw_pipeline(steps: Sequence[Step], title: str) -> Figure:
    """Flow chart of ``steps``: a box each with its chapter, arrows from what feeds it, a legend of the colours."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch

    columns, rows = max(step.column for step in steps), max(step.row for step in steps)
    width, height = _ACROSS * columns + _WIDTH, _DOWN * rows + _HEIGHT
    fig, axes = plt.subplots(figsize=(7.6, 7.6 * (height + 1.0) / width))
    places = {step.name: (step.column * _ACROSS, -step.row * _DOWN) for step in steps}
    for step in steps:
        for feeder in step.after:
            _arrow(axes, places[feeder], places[step.name])
        _box(axes, step, places[step.name])
    kinds = [kind for kind in _MEANING if any(step.kind == kind for step in steps)]
    handles = [Patch(facecolor=_FILL[kind], edgecolor=_EDGE[kind], label=_MEANING[kind]) for kind in kinds]
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=len(handles), frameon=False)
    axes.set_title(title)
    axes.set(
        xlim=(-_WIDTH / 2 - 0.05, width - _WIDTH / 2 + 0.05), ylim=(_HEIGHT / 2 - height - 0.05, _HEIGHT / 2 + 0.05)
    )
    axes.set_aspect("equal")
    axes.set_axis_off()
    return fig


def as_table(steps: Sequence[Step]) -> pd.DataFrame:
    """The steps as ``step, what, chapters, kind, after``: what the flow chart shows."""
    import pandas as pd

    rows = [(step.name, step.what, step.chapters, step.kind, "; ".join(step.after)) for step in steps]
    return pd.DataFrame(rows, columns=["step", "what", "chapters", "kind", "after"])


def _box(axes: Axes, step: Step, at: tuple[float, float]) -> None:
    from matplotlib.patches import FancyBboxPatch

    corner = (at[0] - _WIDTH / 2 + 0.06, at[1] - _HEIGHT / 2 + 0.06)
    shape = FancyBboxPatch(
        corner, _WIDTH - 0.12, _HEIGHT - 0.12, boxstyle="round,pad=0.06", facecolor=_FILL[step.kind],
        edgecolor=_EDGE[step.kind], linewidth=1.4, zorder=3,
    )  # fmt: skip
    axes.add_patch(shape)
    axes.text(at[0], at[1] + 0.12, step.name, ha="center", va="center", fontsize=9.2, weight="bold", zorder=4)
    axes.text(at[0], at[1] - 0.12, step.what, ha="center", va="center", fontsize=8, zorder=4)
    axes.text(
        at[0] + _WIDTH / 2 - 0.02, at[1] + _HEIGHT / 2 - 0.02, step.chapters, ha="right", va="center", fontsize=7.5,
        color="white", zorder=5, bbox={"boxstyle": "round,pad=0.22", "fc": _EDGE[step.kind], "ec": "none"},
    )  # fmt: skip


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Arrow between the nearest edges of two boxes."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    sideways = abs(dx) > _WIDTH and abs(dy) < 0.1
    gap = (_WIDTH / 2 if dx > 0 else -_WIDTH / 2, 0.0) if sideways else (0.0, _HEIGHT / 2 if dy > 0 else -_HEIGHT / 2)
    if not sideways and abs(dx) > _WIDTH:
        gap = (_WIDTH / 2 if dx > 0 else -_WIDTH / 2, 0.0)
    tail, head = (start[0] + gap[0], start[1] + gap[1]), (end[0] - gap[0], end[1] - gap[1])
    style = {
        "arrowstyle": "-|>",
        "color": "#555555",
        "linewidth": 1.3,
        "mutation_scale": 12,
        "shrinkA": 1,
        "shrinkB": 2,
    }
    axes.annotate("", head, tail, arrowprops=style, zorder=2)


_OF_TABLE_2 = "largest error of the 14 corrections in {}, Eq 18"
_AFTER = "{} after accurate calibration"
_WIDEST = "widest spread in 95 % of cells of corresponding points in {}"

#: Rows of the scoreboard side by side: name, item, the paper's method, ours (None: the rows of Table 2 themselves).
VARIANTS: tuple[tuple[str, str, str, str | None], ...] = (
    *((f"Table 2, largest error in {one}", "table2", _OF_TABLE_2.format(one), None) for one in ("angle", "length")),
    *(
        (f"Figure 5, {one}", "fig05", f"{_AFTER.format(one)}, Eq 18", _AFTER.format(one))
        for one in ("mean error", "largest error", "standard deviation")
    ),
    (
        "Tables 3 and 4, points to path",
        "table3",
        "printed points to the path of the boxes, largest",
        "printed point {} to rebuilt path",
    ),
    (
        "Tables 3 and 4, point to point",
        "table3",
        "printed points to the boxes' points one to one, largest",
        "printed points to rebuilt points one to one, largest",
    ),
    (
        "Table 3, normal to normal",
        "table3",
        "mended printed normals to the boxes' one to one, largest",
        "mended printed normals to rebuilt ones one to one, largest",
    ),
    *(
        (f"Figure {fig[3:]}, spread in {plane}", fig, f"{_WIDEST.format(plane)}, boxes", _WIDEST.format(plane))
        for fig, plane in (("fig10", "XY"), ("fig11", "XZ"), ("fig12", "YZ"))
    ),
    (
        "Figures 9 to 12, compound error",
        "fig09",
        "compound error of a path point, boxes",
        "compound error of a path point",
    ),
    (
        "Figures 10 to 12, cells inside",
        "fig10-12",
        "cells with all points inside all squares of 0.5 mm, boxes",
        "cells with all points inside all squares of 0.5 mm",
    ),
    *(
        (f"Table II, {kind}, radii {radii}", "peng_table2", f"overlap on the {kind}, method of the paper{words}",
         f"overlap on the {kind}, ours")
        for kind in ("line", "curve", "box", "cylinder")
        for radii, words in (("8/2/2", ""), ("10/5/5", ", radii 10/5/5"))
    ),
    *(
        (f"Table I, {kind}", "peng_table1", f"cloud to trajectory, {kind}, the paper's method here",
         f"cloud to trajectory, {kind}")
        for kind in ("line", "curve", "box", "cylinder")
    ),
)  # fmt: skip


def paper_variants(scores: pd.DataFrame) -> pd.DataFrame:
    """The papers' own methods beside ours: ``what``, ``unit``, ``printed``, ``bound`` (where nothing is printed),
    ``paper_method``, ``ours``, and the verdicts of both; NaN where no chapter has answered.
    """
    import pandas as pd

    rows, found = scores.set_index(["item", "quantity"]), []
    for what, item, theirs, ours in VARIANTS:
        row = rows.loc[(item, theirs)]
        if ours is None:
            part = scores[(scores["item"] == item) & (scores["unit"] == row["unit"]) & scores["paper"].notna()]
            our_value, our_verdict = part["difference"].abs().max(), ""
        elif "{}" in ours:
            part = rows.loc[[(item, ours.format(k)) for k in range(1, 7)]]
            our_value, our_verdict = part["rebuilt"].max(), part["verdict"].iloc[part["rebuilt"].to_numpy().argmax()]
        else:
            our_value, our_verdict = rows.loc[(item, ours), ["rebuilt", "verdict"]]
        bound = row["tolerance"] if row["paper"] != row["paper"] else float("nan")
        found.append((what, row["unit"], row["paper"], bound, row["rebuilt"], our_value, row["verdict"], our_verdict))
    columns = ["what", "unit", "printed", "bound", "paper_method", "ours", "paper_method_verdict", "ours_verdict"]
    return pd.DataFrame(found, columns=columns)


def draw_variants(variants: pd.DataFrame) -> Figure:
    """Every row as a share of the printed value, or of the bound where nothing is printed, on a logarithmic axis."""
    import matplotlib.pyplot as plt
    import numpy as np

    fig, axes = plt.subplots(figsize=(8.4, 0.27 * len(variants) + 1.2), layout="constrained")
    height = np.arange(len(variants))
    share = variants["printed"].fillna(variants["bound"])
    axes.axvline(1, color=COLOURS["printed"], lw=1.2, label="printed value, or bound")
    for column, colour, mark, label in (
        ("paper_method", "paper_variant", "s", "the paper's method"),
        ("ours", "ours", "o", "ours"),
    ):
        axes.plot(variants[column] / share, height, mark, color=COLOURS[colour], label=label)
    axes.set_yticks(height, variants["what"])
    axes.set(xscale="log", xlabel="value / printed value, or / bound", ylim=(len(variants) - 0.5, -0.5))
    axes.grid(axis="y", alpha=0.4)
    fig.legend(loc="outside upper center", ncols=3)
    return fig
