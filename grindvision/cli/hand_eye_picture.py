"""report.png of ``grindvision hand-eye``: where every pose puts the target, and by how much it is off."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grindvision.cli.verdict import draw_verdict
from grindvision.extras import extra
from grindvision.files import write_whole

with extra("plot"):
    from matplotlib.figure import Figure

if TYPE_CHECKING:
    from grindvision.calibration.hand_eye import HandEye


def draw(found: HandEye, names: Sequence[str], told: Sequence[str], path: Path) -> None:
    """Draw report.png: the verdict, the target's places about their mean, and every pose's error."""
    figure = Figure(figsize=(11, 5), layout="constrained")
    places, bars = figure.subplots(1, 2)
    for plane, label in (((0, 1), "x and y"), ((0, 2), "x and z")):
        places.plot(*found.residuals_mm[:, plane].T, "o" if plane[1] == 1 else "s", label=label, alpha=0.8)
    places.axhline(0, color="0.8", zorder=0)
    places.axvline(0, color="0.8", zorder=0)
    places.set(title="where the poses put the target", xlabel="x, mm", ylabel="y or z, mm", aspect="equal")
    places.set_adjustable("datalim")
    places.legend()
    numbers = np.arange(1, len(names) + 1)
    bars.bar(numbers - 0.2, np.linalg.norm(found.residuals_mm, axis=1), 0.4, label="in the fit")
    bars.bar(numbers + 0.2, found.left_out_mm, 0.4, label="took no part")
    bars.set(title="error of the target's place", xlabel="pose", ylabel="mm")
    bars.legend()
    verdict = f"The target's places meet within {found.rms_mm:.2f} mm rms"
    facts = (
        f"Camera known to +- {found.sigma_mm.max():.2f} mm and +- {found.sigma_deg.max():.2f} deg (one sigma) from"
        f" {len(names)} poses."
    )
    draw_verdict(figure, verdict, facts, told)
    with write_whole(path) as temporary:
        figure.savefig(temporary, dpi=110)
