"""report.png of ``grindvision groove``: the cloud with its groove and path from above, and the path's course."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from grindvision.files import write_whole

if TYPE_CHECKING:
    from grindvision.vision.weld import Weld

GROOVE, PATH, GREY = "#0072B2", "#D55E00", "#bbbbbb"
MOST_DOTS = 40_000


def draw(weld: Weld, points: np.ndarray, path: Path) -> None:
    """Draw the cloud (N, 3) against the mean normal of the path, the groove's points and way points on it."""
    points, labels = points.reshape(-1, 3), weld.labels.ravel()
    kept = np.flatnonzero(np.isfinite(points).all(axis=1))
    kept = kept[:: max(len(kept) // MOST_DOTS, 1)]
    up = weld.path.normals.mean(axis=0)
    up = up / np.linalg.norm(up)
    middle = weld.path.points.mean(axis=0)
    flat = weld.path.points - middle
    flat = flat - np.outer(flat @ up, up)
    along = np.linalg.svd(flat, full_matrices=False)[2][0]
    axes_across = np.stack([along, np.cross(up, along)], axis=1)
    figure = Figure(figsize=(11, 9), layout="constrained")
    figure.suptitle(str(weld), fontsize=10)
    view, course = figure.subplots(2, 1, height_ratios=(3, 1))
    for chosen, colour, name in ((~labels[kept], GREY, "cloud"), (labels[kept], GROOVE, "groove")):
        seen = (points[kept][chosen] - middle) @ axes_across
        view.plot(*seen.T, ".", ms=1, color=colour)
        view.plot([], [], "o", color=colour, label=name)
    for number, seam in enumerate(weld.paths, start=1):
        way = (seam.points - middle) @ axes_across
        view.plot(*way.T, ".-", ms=4, lw=1, color=PATH, label=f"path {number}" if len(weld.paths) > 1 else "path")
        view.annotate("start", way[0], textcoords="offset points", xytext=(4, 6), color=PATH)
    view.set(aspect="equal", xlabel="along the groove, mm", ylabel="across, mm")
    view.legend(frameon=False, loc="upper right")
    heights = (weld.path.points - middle) @ up
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(weld.path.points, axis=0), axis=1))])
    course.plot(lengths, heights, ".-", color=PATH)
    course.set(xlabel="way along the path, mm", ylabel="height, mm")
    with write_whole(path) as temporary:
        figure.savefig(temporary, dpi=100)
