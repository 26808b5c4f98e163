"""report.png of ``grindvision calibrate-field``: the depth error at the nearest and at the farthest plate."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grindvision.cli.pictures import save_png
from grindvision.cli.verdict import draw_verdict
from grindvision.extras import extra

with extra("plot"):
    from matplotlib.figure import Figure

if TYPE_CHECKING:
    from grindvision.vision.depth_calibration.field_correction import FieldCorrection
    from grindvision.vision.depth_calibration.field_errors import PredictedFieldErrors


def draw(
    field: FieldCorrection,
    unseen: tuple[float, float] | None,
    predicted: PredictedFieldErrors | None,
    told: Sequence[str],
    path: Path,
) -> None:
    """Draw report.png: the verdict, and the depth error at the nearest and at the farthest plate."""
    figure = Figure(figsize=(11, 5), layout="constrained")
    panels = figure.subplots(1, 2)
    max_mm = np.abs(field.error_grid_mm).max()
    for panel, layer, distance in zip(panels, (0, -1), field.low[2:].tolist() + field.high[2:].tolist(), strict=True):
        (left, bottom), (right, top) = field.low[:2] * distance, field.high[:2] * distance
        image = panel.imshow(
            field.error_grid_mm[:, :, layer].T,
            extent=(left, right, bottom, top),
            origin="lower",
            cmap="RdBu_r",
            vmin=-max_mm,
            vmax=max_mm,
        )
        panel.set(title=f"{distance:.0f} mm away", xlabel="x, mm, scanner frame", ylabel="y, mm")
    figure.colorbar(image, ax=panels, label="depth error that is taken off, mm", shrink=0.8)
    verdict, facts = "Calibrated, but not tested", "Scan at least three plates to test it."
    if unseen is not None:
        verdict = f"Calibrated: a plate that took no part is off flat by {unseen[1]:.2f} mm rms"
        facts = f"Before: {unseen[0]:.2f} mm rms. Noise is in both numbers."
        if predicted is not None:
            facts += f" A corrected point, over the volume: {predicted.mean_mm:.2f} mm rms predicted in depth."
        if unseen[1] >= unseen[0]:
            verdict = "Calibration did not help"
    draw_verdict(figure, verdict, facts, told)
    save_png(figure, path, dpi=110)
