"""report.png of ``grindvision groove``: the cloud with its groove and path from above, the path's course, a cut."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grindvision.cli.pictures import save_png
from grindvision.cli.verdict import draw_verdict
from grindvision.extras import extra
from grindvision.relief import draw_relief, name_colour

with extra("plot"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

if TYPE_CHECKING:
    from grindvision.cli.weld_job import WeldRuns
    from grindvision.motion import WeldFill
    from grindvision.vision.seam.weld import Weld

GROOVE, PATH, GREY, WELD, TACK = "#0072B2", "#D55E00", "#bbbbbb", "#000000", "#E69F00"
LABEL = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}


def draw(weld: Weld, points: np.ndarray, warnings: Sequence[str], path: Path, welding: WeldRuns | None = None) -> None:
    """Draw the verdict, the cloud (N, 3) seen against the path's mean normal, the path's course and a cut."""
    points, labels = points.reshape(-1, 3), weld.labels.ravel()
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    up = weld.path.normals.mean(axis=0)
    up = up / np.linalg.norm(up)
    middle = weld.path.points.mean(axis=0)
    flat = weld.path.points - middle
    flat = flat - np.outer(flat @ up, up)
    along = np.linalg.svd(flat, full_matrices=False)[2][0]
    axes_across = np.stack([along, np.cross(up, along)], axis=1)
    figure = Figure(figsize=(11, 10), layout="constrained")
    if welding is None:
        panels = figure.subplot_mosaic([["view", "view"], ["course", "cut"]], height_ratios=(3, 1))
    else:
        panels = figure.subplot_mosaic([["view"] * 3, ["course", "torch", "cut"]], height_ratios=(3, 1))
    view, course = panels["view"], panels["course"]
    size_mm = 0.0
    for chosen, colour, name in ((finite, GREY, "cloud"), (finite[labels[finite]], GROOVE, "seam")):
        seen = points[chosen] - middle
        size_mm = draw_relief(view, seen @ axes_across, seen @ up, colour, size_mm=size_mm)
        name_colour(view, colour, name)
    for number, seam in enumerate(weld.paths, start=1):
        way = (seam.points - middle) @ axes_across
        view.plot(*way.T, ".-", ms=4, lw=1, color=PATH, label=f"path {number}" if len(weld.paths) > 1 else "path")
        view.annotate("start", way[0], textcoords="offset points", xytext=(4, 6), bbox=LABEL)
    if welding is not None:
        _draw_welds(view, panels["torch"], welding, middle, axes_across)
    view.set(aspect="equal", xlabel="along the seam, mm", ylabel="across, mm")
    view.legend(frameon=True, framealpha=0.9, edgecolor="none", loc="upper right")
    heights = (weld.path.points - middle) @ up
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(weld.path.points, axis=0), axis=1))])
    course.plot(lengths, heights, ".-", color=PATH)
    course.set(xlabel="way along the path, mm", ylabel="height of the path, mm")
    _draw_cut(panels["cut"], weld, points[finite], labels[finite])
    if welding is not None and welding.fill is not None:
        _draw_fill(panels["cut"], welding.fill)
    draw_verdict(figure, *_verdict(weld), warnings)
    save_png(figure, path)


def _draw_cut(axes: Axes, weld: Weld, points: np.ndarray, labels: np.ndarray) -> None:
    """Points within a thin slice across the path's middle."""
    at = len(weld.path.points) // 2
    origin, up = weld.path.points[at], weld.path.normals[at]
    along = weld.path.points[min(at + 1, len(weld.path.points) - 1)] - weld.path.points[at - 1]
    along = along - up * (along @ up)
    along = along / np.linalg.norm(along)
    across = np.cross(up, along)
    if weld.grooves:
        reach = 1.5 * float(np.median(weld.grooves[0].width_mm))
    elif weld.seams:
        reach = float(np.clip(1.5 * np.median(weld.seams[0].legs_mm, axis=1).min(), 5.0, 30.0))
    else:
        reach = 1.5 * float(np.ptp(points[labels] @ across))
    kept = np.flatnonzero(np.abs(points @ along - origin @ along) < reach / 20)
    places = (points[kept] - origin) @ np.stack([across, up], axis=1)
    near = (np.abs(places) < [reach, 1.5 * reach]).all(axis=1)
    places, inside = places[near], labels[kept][near]
    for chosen, colour in ((~inside, GREY), (inside, GROOVE)):
        axes.plot(*places[chosen].T, ".", ms=3, color=colour)
    axes.plot(0, 0, "o", ms=7, color=PATH, mec="black")
    axes.set(xlim=(-reach, reach), xlabel="across the path's middle, mm", ylabel="height over the path, mm")


def _draw_welds(view: Axes, detail: Axes, welding: WeldRuns, middle: np.ndarray, axes_across: np.ndarray) -> None:
    """The tip's way in every weld on the cloud, tacks on top; the first run's way from nearby, seen along the torch."""
    for run in welding.runs:
        tacks = run.name == "tacks"
        places = (run.path.trajectory.positions_mm - middle) @ axes_across
        for weld in range(1, run.path.count + 1):
            way = places[run.path.welds == weld]
            view.plot(*way.T, lw=4 if tacks else 0.7, color=TACK if tacks else WELD, solid_capstyle="round")
    view.plot([], [], color=WELD, label="wire's tip")
    if welding.runs[-1].name == "tacks":
        view.plot([], [], lw=4, color=TACK, label="tack")
    run = welding.runs[0]
    first = np.flatnonzero(run.path.welds == 1)
    poses, arc = run.path.trajectory.T_base_tool[first], run.path.seam_mm[first]
    at = len(first) // 2
    reach_mm = 10.0 if run.path.weave is None else 2.5 * run.path.weave.length_mm
    near = np.abs(arc - arc[at]) <= reach_mm
    flat = (poses[near, :3, 3] - poses[at, :3, 3]) @ poses[at, :3, :2]
    if run.path.weave is not None:  # from the seam, not from where the swing stands there
        flat[:, 1] += run.path.weave.offsets_mm(arc[at] - arc[0])
    detail.plot(*flat.T, ".-", ms=4, lw=1, color=WELD)
    weave = "no weave" if run.path.weave is None else f"{run.path.weave.shape} weave"
    detail.set(xlabel=f"along the middle of {run.name}, mm", ylabel="wire's tip to the right, mm")
    detail.set_title(f"{weave}, {run.path.speed_mm_s:.3g} mm/s along the seam", fontsize="medium")
    detail.set_ylim(min(flat[:, 1].min(), -2.0) - 0.5, max(flat[:, 1].max(), 2.0) + 0.5)
    detail.invert_yaxis()


def _draw_fill(axes: Axes, fill: WeldFill) -> None:
    """Layers of the fill and the tip's places, numbered in the order they are welded."""
    section = fill.section
    for top in fill.layer_tops_mm:
        left, right = section.walls_mm(top)
        axes.plot([left, -right], [top, top], lw=1, color=WELD)
    for one in fill.passes:
        axes.plot(-one.right_mm, one.up_mm, "v", ms=9, color=WELD, mec="white")
        axes.annotate(
            str(one.number), (-one.right_mm, one.up_mm), textcoords="offset points", xytext=(0, 7), ha="center"
        )
    axes.set_title(
        f"{len(fill.passes)} passes of {fill.passes[0].area_mm2:.3g} mm\N{SUPERSCRIPT TWO}", fontsize="medium"
    )


def _verdict(weld: Weld) -> tuple[str, str]:
    if not weld.seams:
        return "Found a groove, by the paper's method", f"{weld}. Frame: the cloud's."
    first, count = weld.seams[0], len(weld.seams)
    found = f"Found 1 {first.kind}" if count == 1 else f"Found {count} seams; the first: {first.kind}"
    facts = f"{_sentence(str(weld.path))}. {_sentence(first.evidence)}. Frame: the cloud's."
    return f"{found}, {first.length_mm:.0f} mm long, {first.size}", facts


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
