"""The figures of chapter 16."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from numpy.typing import NDArray

import grindvision_book as book
from grindvision_book.chapter_16.loop import Job

Floats = NDArray[np.float64]

BEFORE, AFTER, TRUTH, GREY = (book.COLOURS[name] for name in ("test", "ours", "truth", "grey"))

HIGHEST_MM = 1.6


def section_of(job: Job) -> int:
    """The row of nodes across the middle of the bead."""
    rows = np.flatnonzero(job.bead.any(axis=1))
    return int(rows[len(rows) // 2])


def draw_passes(job: Job, caption: str) -> None:
    """The true part before and after each pass: maps, and a section across the middle of the bead."""
    grid, row, steps = job.piece.map, section_of(job), job.left_mm
    fig, axes = plt.subplots(2, 3, figsize=(7.4, 3.5), sharex=True, sharey=True, layout="constrained")
    extent = (grid.x_mm[0], grid.x_mm[-1], grid.y_mm[0], grid.y_mm[-1])
    shown = None
    for number, (axis, left) in enumerate(zip(axes.flat, steps, strict=False)):
        shown = axis.imshow(left.T, origin="lower", extent=extent, cmap="viridis", vmin=0, vmax=HIGHEST_MM)
        axis.grid(False)
        axis.axvline(grid.x_mm[row], color="white", lw=0.7, ls="--")
        axis.set_title("before" if number == 0 else f"after pass {number}", fontsize=9)
    for axis in axes[1]:
        axis.set_xlabel("along (mm)")
    for axis in axes[:, 0]:
        axis.set_ylabel("across (mm)")
    assert shown is not None
    fig.colorbar(shown, ax=axes, label="height (mm)", shrink=0.9, pad=0.02)
    columns = {f"after_{number}_mm": left[row] for number, left in enumerate(steps)}
    book.save_figure(fig, "ground_passes", pd.DataFrame({"across_mm": grid.y_mm} | columns).round(3), caption)


def draw_sections(job: Job, measured: Floats, sigma: Floats, caption: str) -> None:
    """A section of the bead: measured with its sigma, and the true part after each pass."""
    grid, row = job.piece.map, section_of(job)
    fig, axis = plt.subplots(figsize=(6.4, 3.0), layout="constrained")
    y, steps = grid.y_mm, [left[row] for left in job.left_mm]
    near = slice(*(np.flatnonzero(job.bead[row])[[0, -1]] + [-8, 9]))
    axis.fill_between(
        y[near], (measured - sigma)[row, near], (measured + sigma)[row, near], color=BEFORE, alpha=0.3, lw=0,
        label="measured, one sigma to each side",
    )  # fmt: skip
    for number, step in enumerate(steps):
        last = number == len(steps) - 1
        label = {0: "true part, before", len(steps) - 1: "true part, after the last pass"}.get(number)
        colour = TRUTH if number == 0 else AFTER
        axis.plot(y[near], step[near], color=colour, lw=1.5 if last or number == 0 else 0.7, label=label)
    axis.axhline(0, color=GREY, lw=0.8)
    axis.set(xlabel="across (mm)", ylabel="over the good surface (mm)", ylim=(-0.15, 2.1))
    axis.legend(fontsize=8, loc="upper left", frameon=False)
    drawn = {"across_mm": y[near], "measured_mm": measured[row, near], "sigma_mm": sigma[row, near]}
    drawn |= {f"after_{number}_mm": step[near] for number, step in enumerate(steps)}
    book.save_figure(fig, "ground_section", pd.DataFrame(drawn).round(3), caption)


def draw_limits(registered: pd.DataFrame, offsets: pd.DataFrame, wheels: pd.DataFrame, caption: str) -> None:
    """What the registration, the wheel's offset, its width and the depth of cut do to volume and ground part."""
    fig, axes = plt.subplots(2, 2, figsize=(7.2, 5.2), layout="constrained")
    axis = axes[0, 0]
    axis.plot(registered["error_mm"], registered["without_datum_mm3"], "o--", color=GREY, label="without a datum")
    axis.plot(registered["error_mm"], registered["volume_mm3"], "o-", color=AFTER, label="datum beside the bead")
    axis.set(xlabel="registration error along the normal (mm)", ylabel="volume (mm$^3$)", ylim=(0, None))
    axis.legend(fontsize=8)
    axis = axes[0, 1]
    _left_and_gouge(axis, offsets["offset_mm"], offsets)
    axis.set(xlabel="wheel runs too high by (mm)", ylabel="mm")
    axis.legend(fontsize=8)
    for axis, name, label in (
        (axes[1, 0], "width_mm", "width of the wheel (mm)"),
        (axes[1, 1], "depth_mm", "depth of cut (mm)"),
    ):
        some = wheels[wheels["varied"] == name]
        _left_and_gouge(axis, some["value"], some)
        axis.set(xlabel=label, ylabel="mm", ylim=(-0.02, 0.45))
    columns = ["varied", "value", "volume_mm3", "without_datum_mm3", "left_95_mm", "gouge_mm", "passes"]
    drawn = pd.concat(
        [
            registered.rename(columns={"error_mm": "value"}).assign(varied="registration_mm"),
            offsets.rename(columns={"offset_mm": "value"}).assign(varied="offset_mm"),
            wheels,
        ]
    )
    book.save_figure(fig, "ground_limits", drawn[columns].round(3), caption)


def _left_and_gouge(axis: Axes, x: pd.Series, rows: pd.DataFrame) -> None:
    axis.plot(x, rows["left_95_mm"].clip(lower=0), "o-", color=AFTER, label="left on 95 % of the bead at most")
    axis.plot(x, rows["gouge_mm"], "o-", color=BEFORE, label="deepest cut below the surface")


def draw_loop(loops: dict[str, Sequence[Job]], caption: str) -> None:
    """What is left, and how deep the part is cut, job by job, for wheels that are zeroed in different ways."""
    fig, axes = plt.subplots(1, 2, figsize=(7.2, 3.0), layout="constrained")
    rows = []
    colours = (GREY, BEFORE, AFTER)
    for (name, loop), colour in zip(loops.items(), colours, strict=True):
        number = np.arange(1, len(loop) + 1)
        left, gouge = ([getattr(job, what) for job in loop] for what in ("left_95_mm", "gouge_mm"))
        axes[0].plot(number, left, "o-", color=colour, label=name)
        axes[1].plot(number, gouge, "o-", color=colour, label=name)
        rows += [(name, *row) for row in zip(number, left, gouge, strict=True)]
    for axis, limit, label in zip(
        axes, (0.15, 0.05), ("left on 95 % of the bead (mm)", "deepest cut (mm)"), strict=True
    ):
        axis.axhline(limit, color="black", lw=0.8, ls=":")
        axis.set(xlabel="job", ylabel=label, ylim=(0, None))
        axis.xaxis.get_major_locator().set_params(integer=True)
    axes[0].legend(fontsize=8)
    drawn = pd.DataFrame(rows, columns=["wheel", "job", "left_95_mm", "gouge_mm"])
    book.save_figure(fig, "ground_loop", drawn.round(3), caption)
