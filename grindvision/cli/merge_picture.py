"""report.png of ``grindvision merge``: the views in one frame from three sides, and how far every pair is apart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grindvision.cli.verdict import draw_verdict
from grindvision.extras import extra
from grindvision.files import write_whole

with extra("plot"):
    from matplotlib import colormaps
    from matplotlib.figure import Figure

if TYPE_CHECKING:
    from grindvision.vision.registration.meeting import Meeting

#: Points of a view that are drawn, at most.
DRAWN = 4000


def draw(
    meeting: Meeting, views: Sequence[np.ndarray], frame: str, worst: str, told: Sequence[str], path: Path
) -> None:
    """Draw report.png: the verdict, the joined views along each axis, and the distances of all pairs."""
    figure = Figure(figsize=(12, 10), layout="constrained")
    axes = figure.subplots(2, 2)
    colours = colormaps["turbo"](np.linspace(0.05, 0.95, len(views)))
    for place, (a, b) in zip(axes.flat, ((0, 1), (0, 2), (1, 2)), strict=False):
        for view, colour in zip(views, colours, strict=True):
            shown = view[:: max(1, len(view) // DRAWN)]
            place.plot(shown[:, a], shown[:, b], ".", markersize=1, color=colour, rasterized=True)
        place.set(xlabel=f"{'xyz'[a]}, mm", ylabel=f"{'xyz'[b]}, mm", aspect="equal")
        place.set_adjustable("datalim")
    axes[0, 0].set_title(f"the views in the {frame} frame, a colour each")
    pairs = axes[1, 1]
    image = pairs.imshow(meeting.pair_mm, cmap="viridis", vmin=0)
    figure.colorbar(image, ax=pairs, label="median distance, mm")
    ticks = np.arange(len(views))
    pairs.set(title="pairs, where they overlap", xticks=ticks, yticks=ticks, xlabel="view", ylabel="view")
    pairs.set_xticklabels([str(tick + 1) for tick in ticks])
    pairs.set_yticklabels([str(tick + 1) for tick in ticks])
    draw_verdict(figure, str(meeting), f"{worst[0].upper()}{worst[1:]}.", told)
    with write_whole(path) as temporary:
        figure.savefig(temporary, dpi=100)
