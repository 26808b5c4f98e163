"""Figures of chapter 14."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt

import grindvision_book as book
from grindvision_book.chapter_14.compared import METHODS
from grindvision_book.chapter_14.joined import Joined, section

COLOURS = book.COLOURS
_LINES = dict(zip(METHODS, ("grey", "paper_variant", "ours"), strict=True))


def draw_methods(table: pd.DataFrame, caption: str) -> None:
    """Share of the sequences whose error stays below a value, for each method: place and rotation."""
    fig, axes = plt.subplots(1, 2, figsize=(7.2, 2.9), sharey=True)
    percent, rows = np.linspace(0, 100, 51), []
    for place, column, unit in zip(axes, ("off_mm", "off_deg"), ("mm", "deg"), strict=True):
        for name, colour in _LINES.items():
            errors = table.loc[table["method"] == name, column].to_numpy()
            values = np.percentile(errors, percent)
            label = f"{name}: {np.median(errors):.2f} {unit}"
            place.plot(values, percent, color=COLOURS[colour], label=label)
            rows.append(pd.DataFrame({"method": name, "unit": unit, "percent": percent, "error": values}))
        place.set(xlabel=f"error of the camera's {'place' if unit == 'mm' else 'rotation'} ({unit})", xlim=(0, None))
        place.legend(fontsize=7, title="median", loc="lower right")
    axes[0].set_ylabel("share of the sequences (%)")
    book.save_figure(fig, "hand_eye_methods", pd.concat(rows), caption)


def draw_spread(table: pd.DataFrame, caption: str) -> None:
    """Error of the camera's place against how far the poses turn, beside what the fit states."""
    fig, place = plt.subplots(figsize=(7.0, 3.0))
    place.loglog(table["turn_deg"], table["off_mm"], "o-", color=COLOURS["ours"], label="error, median")
    place.loglog(table["turn_deg"], table["stated_mm"], "s--", color=COLOURS["grey"], label="stated, one sigma, median")
    turns = table["turn_deg"].to_numpy()
    base = table["off_mm"].iloc[-1] * turns[-1]
    place.loglog(turns, base / turns, ":", color=COLOURS["truth"], label="in proportion to 1/turn")
    all_refused = table.loc[table["refused"] == 1, "turn_deg"]
    if len(all_refused):
        place.axvspan(
            all_refused.min() / 1.2, all_refused.max() * 1.2, color=COLOURS["test"], alpha=0.15, label="refused"
        )
    place.set(xlabel="poses turn by up to (deg)", ylabel="camera's place (mm)")
    place.set_xticks(turns, [f"{turn:g}" for turn in turns])
    place.minorticks_off()
    place.legend(fontsize=8)
    book.save_figure(fig, "hand_eye_spread", table, caption)


def draw_views(found: Joined, caption: str) -> None:
    """A section through all views in the base frame, by a drawing's place of the camera and by the one found."""
    fig, axes = plt.subplots(1, 2, figsize=(7.2, 2.9), sharex=True, sharey=True)
    rows = []
    for place, meeting, name in zip(axes, (found.before, found.after), ("by a drawing", "found"), strict=True):
        for number, points in enumerate(section(meeting, found.views), start=1):
            order = np.argsort(points[:, 0])
            place.plot(*points[order].T, ".", markersize=2, label=f"view {number}")
            rows.append(
                pd.DataFrame({"camera": name, "view": number, "x_mm": points[order, 0], "z_mm": points[order, 1]})
            )
        place.set(title=f"camera's place {name}", xlabel="x, base (mm)")
    axes[0].set_ylabel("z, base (mm)")
    book.save_figure(fig, "hand_eye_views", pd.concat(rows), caption)
