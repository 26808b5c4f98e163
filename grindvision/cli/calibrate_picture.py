"""report.png of ``grindvision calibrate``: errors before and after, where they point, what can be known."""

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
    from grindvision.calibration import Calibration, HeldOut


def draw(result: Calibration, unseen: HeldOut, warnings: Sequence[str], path: Path) -> None:
    """Draw report.png: the verdict, errors before and after, where they point, what can be known."""
    before, after = "#999999", "#0072B2"
    figure = Figure(figsize=(11, 8), layout="constrained")
    (errors, arrows), (values, words) = figure.subplots(2, 2)

    for residuals, colour, label in ((unseen.before_mm, before, "before"), (unseen.after_mm, after, "after")):
        lengths = np.sort(np.linalg.norm(residuals, axis=1))
        errors.step(lengths, np.arange(1, len(lengths) + 1) / len(lengths), color=colour, label=label, where="post")
    errors.set(xscale="log", xlabel="error of unseen points, mm", ylabel="share of points below", ylim=(0, 1))
    errors.legend(frameon=False)

    for axis, colour, marker in ((0, "#E69F00", "o"), (1, "#009E73", "s"), (2, after, "^")):
        arrows.plot(unseen.rows + 1, unseen.after_mm[:, axis], marker, color=colour, ms=3, label="xyz"[axis])
    arrows.axhline(0, color="black", lw=0.5)
    arrows.set(xlabel="row of the measurement file", ylabel="residual after, tracker frame, mm")
    arrows.legend(frameon=False, ncols=3)

    singular, rank = result.identifiability.singular_values, result.identifiability.rank
    numbers = np.arange(1, len(singular) + 1)
    values.semilogy(numbers[:rank], singular[:rank], "o", color=after, label="known")
    floor = singular[rank - 1] / 100
    values.semilogy(numbers[rank:], np.maximum(singular[rank:], floor), "x", color="#D55E00", label="not known")
    values.set(xlabel="combination of unknowns", ylabel="singular value, 1/mm", title=f"rank {rank} of {len(singular)}")
    values.legend(frameon=False)

    words.axis("off")
    lines = [f"arm of {result.arm.n} joints, {len(singular)} unknowns", str(result.spreads).replace("; ", "\n"), ""]
    lines += ["Cannot be told apart:"] * bool(result.identifiability.sentences)
    lines += [f"  {sentence}" for sentence in result.identifiability.sentences]
    words.text(0, 1, "\n".join(line[:95] for line in lines), va="top", fontsize=9, transform=words.transAxes)
    after_mm, before_mm = unseen.after, unseen.before
    verdict = f"Calibrated: unseen points are {after_mm.mean:.3f} mm off on average, {after_mm.max:.3f} mm at most"
    if after_mm.mean >= before_mm.mean:
        verdict = "Calibration did not help"
    facts = f"Before: {before_mm.mean:.3f} mm on average, {before_mm.max:.3f} mm at most. Unseen: {unseen.how}."
    draw_verdict(figure, verdict, facts, warnings)
    with write_whole(path) as temporary:
        figure.savefig(temporary, dpi=110)
