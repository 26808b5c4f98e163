"""The picture of ``grindvision calibrate``: did it work, where does it hold, what can be known."""

from __future__ import annotations

import textwrap
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
    from matplotlib.axes import Axes

    from grindvision.calibration import Calibration, HeldOut, PredictedErrors

BEFORE, AFTER, BEYOND = "#999999", "#0072B2", "#009E73"


def draw(result: Calibration, unseen: HeldOut, predicted: PredictedErrors, warnings: Sequence[str], path: Path) -> None:
    """Draw report.png: the verdict, errors before and after, residuals, where it holds, what can be known."""
    figure = Figure(figsize=(12.5, 8), layout="constrained")
    axes = figure.subplots(2, 3)
    _draw_errors(axes[0, 0], unseen)
    _draw_residuals(axes[0, 1], unseen)
    _draw_reach(axes[0, 2], predicted, (0, 1))
    _draw_values(axes[1, 0], result)
    _draw_words(axes[1, 1], result)
    _draw_reach(axes[1, 2], predicted, (None, 2))
    after, before = unseen.after, unseen.before
    state = "Calibrated, with doubts" if warnings else "Calibrated"
    verdict = f"{state}: unseen points are {after.mean:.3f} mm off on average, {after.max:.3f} mm at most"
    if after.mean >= before.mean:
        verdict = "Calibration did not help"
    facts = f"Before: {before.mean:.3f} mm on average, {before.max:.3f} mm at most. Unseen: {unseen.how}."
    if unseen.beyond is not None and result.beyond is not None:
        facts += f" With {result.beyond.kind}: {unseen.beyond.mean:.3f} mm."
    draw_verdict(figure, verdict, facts, warnings)
    save_png(figure, path, dpi=110)


def _draw_errors(axes: Axes, unseen: HeldOut) -> None:
    curves = [(unseen.before_mm, BEFORE, "before"), (unseen.after_mm, AFTER, "after")]
    if unseen.beyond_mm is not None:
        curves.append((unseen.beyond_mm, BEYOND, "with joint terms"))
    for residuals, colour, label in curves:
        lengths = np.sort(np.linalg.norm(residuals, axis=1))
        axes.step(lengths, np.arange(1, len(lengths) + 1) / len(lengths), color=colour, label=label, where="post")
    axes.set(xscale="log", xlabel="error of unseen points, mm", ylabel="fraction of points below", ylim=(0, 1))
    axes.legend(frameon=False)


def _draw_residuals(axes: Axes, unseen: HeldOut) -> None:
    for axis, colour, marker in ((0, "#E69F00", "o"), (1, "#009E73", "s"), (2, AFTER, "^")):
        axes.plot(unseen.rows + 1, unseen.after_mm[:, axis], marker, color=colour, ms=3, label="xyz"[axis])
    axes.axhline(0, color="black", lw=0.5)
    axes.set(xlabel="row of the measurement file", ylabel="residual after, tracker frame, mm")
    axes.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1))


def _draw_reach(axes: Axes, predicted: PredictedErrors, which: tuple[int | None, int]) -> None:
    """Points of the workspace coloured by the error predicted: from above, or distance from the axis and height."""
    across, up = which
    base = predicted.base_mm
    horizontal = np.hypot(base[:, 0], base[:, 1]) if across is None else base[:, across]
    order = np.argsort(predicted.rms_mm)
    mean = 0.9213 * predicted.rms_mm[order]
    top = float(np.quantile(mean, 0.98))
    dots = axes.scatter(
        horizontal[order], base[order, up], c=mean, s=5, cmap="viridis", vmin=0, vmax=top, rasterized=True
    )
    axes.figure.colorbar(dots, ax=axes, label="mean error predicted, mm")
    axes.set_aspect("equal", adjustable="datalim")
    name = "distance from joint 1's axis" if across is None else "x"
    axes.set(xlabel=f"{name}, base frame, mm", ylabel=f"{'xyz'[up]}, mm")
    axes.set_title("seen from above" if across is not None else "distance and height", fontsize=10)


def _draw_values(axes: Axes, result: Calibration) -> None:
    singular, rank = result.identifiability.singular_values, result.identifiability.rank
    numbers = np.arange(1, len(singular) + 1)
    axes.semilogy(numbers[:rank], singular[:rank], "o", color=AFTER, label="known")
    floor = singular[rank - 1] / 100
    label = "not known" if (singular[rank:] >= floor).all() else "zero (at the foot): not known"
    axes.semilogy(numbers[rank:], np.maximum(singular[rank:], floor), "x", color="#D55E00", label=label)
    axes.set(xlabel="combination of unknowns", ylabel="singular value, 1/mm", title=f"rank {rank} of {len(singular)}")
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 0.1))


def _draw_words(axes: Axes, result: Calibration) -> None:
    axes.axis("off")
    unknowns = len(result.unknowns)
    lines = [f"arm of {result.arm.n} joints, {unknowns} unknowns", str(result.sigmas).replace("; ", "\n"), ""]
    if result.beyond is not None:
        lines += [str(result.beyond).replace(": ", ":\n  "), ""]
    lines += ["Cannot be told apart:"] * bool(result.identifiability.sentences)
    lines += [f"  {sentence}" for sentence in result.identifiability.sentences]
    text = "\n".join(textwrap.fill(line, 58, subsequent_indent="    ") for line in "\n".join(lines).split("\n"))
    axes.text(0, 1, text, va="top", fontsize=8.5, transform=axes.transAxes, parse_math=False)
