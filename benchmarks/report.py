"""Tables and pictures of a race: csv, md, svg and png, written race by race."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

import grindvision_book
from benchmarks.racing import Measurement
from grindvision.files import write_text, write_whole
from grindvision_book import COLOURS
from grindvision_book.machinery.figures import csv_text, markdown_table

KINDS = {"ours": "grindvision", "paper_variant": "grindvision, the paper's variant", "peer": "peer"}
STYLE = Path(grindvision_book.__file__).parent / "machinery" / "book.mplstyle"
ORIGIN = "Inputs are synthetic, made by grindvision's own cell from the seed below; times and memory are measured."
LABELS = {
    "median_s": "median time (s), from min to max",
    "peak_mib": "peak memory (MiB)",
    "rotation_deg": "turn error (deg)",
    "shift_mm": "shift error (mm)",
    "path_mean_mm": "path error, mean (mm)",
    "path_max_mm": "path error, largest (mm)",
    "overlap_percent": "overlap (%)",
    "bead_percent": "bead found (%)",
    "error_mean_mm": "held-out error (mm)",
    "matches_percent": "right matches (%)",
    "centroid_error_mm": "centroid error (mm)",
}
HIDDEN = ("kind", "cpu_s", "stages_s")
"""Columns of the csv that the Markdown table leaves out."""


def table_of(measurements: Sequence[Measurement], accuracy: Sequence[str], lap: str = "") -> pd.DataFrame:
    """One row per case and racer: times, ratio, memory, failures, and the accuracy of the answers.

    ``median_s``, ``min_s``, ``max_s`` are wall times over ``rounds``; ``cpu_s`` the median over all threads;
    ``of_fastest_peer`` the median over that of the fastest peer that did not fail; ``peak_mib`` the process after its
    first run, ``growth_mib`` of it since the imports. ``failures`` and accuracy are of all ``judged`` runs, timed or
    not: the median; of a ``max`` the largest.
    Where a ``lap`` is named, ``<lap>_s`` is the median of this stage alone, with its own ratio.
    """
    rows = []
    for (label, _), judged in _grouped(measurements).items():
        good = [one.accuracy for one in judged if not one.error]
        own = [one for one in judged if one.timed]
        seconds = [one.wall_s for one in own]
        rows.append(
            {
                "case": label,
                "points": int(np.median([one.case.points for one in own])),
                "racer": own[0].racer.name,
                "kind": own[0].racer.kind,
                "rounds": len(own),
                "median_s": float(np.median(seconds)),
                "min_s": min(seconds),
                "max_s": max(seconds),
                "cpu_s": float(np.median([one.cpu_s for one in own])),
                "of_fastest_peer": np.nan,
                **({f"{lap}_s": _median_lap(own, lap), f"{lap}_of_fastest_peer": np.nan} if lap else {}),
                "peak_mib": own[0].peak_mib,
                "growth_mib": own[0].growth_mib,
                "judged": len(judged),
                "failures": sum(one.failed for one in judged),
                **{name: _summary(name, [one[name] for one in good]) for name in accuracy},
                "stages_s": _stages(own),
            }
        )
    table = pd.DataFrame(rows)
    for _, own in table.groupby("case"):
        peers = own[own["kind"] == "peer"]
        right = peers[peers["failures"] < 0.5 * peers["judged"]]
        if len(peers):
            best = right if len(right) else peers
            for column, ratio in {"median_s": "of_fastest_peer", f"{lap}_s": f"{lap}_of_fastest_peer"}.items():
                if column in table:
                    table.loc[own.index, ratio] = own[column] / best[column].min()
    return table


def write_results(
    folder: Path, name: str, title: str, table: pd.DataFrame, notes: Sequence[str], facts: dict[str, str],
    fig: Figure | None = None,
) -> None:  # fmt: skip
    """Write ``bench_name.csv``, the page ``bench_name.md``, and the picture that belongs to them."""
    write_text(folder / f"bench_{name}.csv", csv_text(table))
    shown = table.drop(columns=[column for column in HIDDEN if column in table])
    machine = "; ".join(f"{what} {value}" for what, value in facts.items())
    picture = [] if fig is None else [f"![{title}: the numbers are in the table below](bench_{name}.png)", ""]
    notes = [*notes, ORIGIN, f"Run on: {machine}."]
    lines = [f"# {title}", "", *picture, markdown_table(shown), "", *(f"- {note}" for note in notes), ""]
    write_text(folder / f"bench_{name}.md", "\n".join(lines))
    if fig is not None:
        save_picture(fig, title, folder / f"bench_{name}")


def save_picture(fig: Figure, title: str, stem: Path) -> None:
    """Save as svg and png, whole or not at all, and close."""
    about = {"Title": stem.name, "Description": f"{title}; synthetic scans, measured times"}
    of_svg = {**about, "Source": "races", "Date": None, "Creator": None}
    with plt.style.context(STYLE):
        for suffix, metadata in {".svg": of_svg, ".png": {**about, "Software": None}}.items():
            with write_whole(stem.with_suffix(suffix)) as path:
                fig.savefig(path, metadata=metadata)
    plt.close(fig)


def race_picture(title: str, table: pd.DataFrame, drawn: Sequence[str]) -> Figure:
    """Dots with their range for the times, then memory and accuracy, one line per racer, grouped by case."""
    cases = list(dict.fromkeys(table["case"]))
    places = np.concatenate([np.flatnonzero(table["case"] == case) + 1.2 * cases.index(case) for case in cases])
    panels = ["median_s", "peak_mib", *drawn]
    with plt.style.context(STYLE):
        fig, axes = plt.subplots(
            1, len(panels), figsize=(4.2 + 2.1 * len(panels), 2.4 + 0.2 * places[-1]), sharey=True, squeeze=False,
            width_ratios=[1.5] + [1] * (len(panels) - 1),
        )  # fmt: skip
    for panel, column in zip(axes[0], panels, strict=True):
        _dots(panel, table, places, column)
    first = axes[0, 0]
    first.set_yticks(places, table["racer"])
    first.set_ylim(places[-1] + 0.6, -1.3)
    for case in cases:
        own = table["case"] == case
        text = f"{case}" if not own.any() else f"{case}: {table.loc[own, 'points'].iloc[0]:,} points"
        first.annotate(
            text, (0, places[own.to_numpy()][0] - 0.85), xycoords=("axes fraction", "data"), fontsize=9, weight="bold"
        )
    handles = [Line2D([], [], marker="o", ls="", color=COLOURS[kind]) for kind in KINDS if kind in set(table["kind"])]
    words = [KINDS[kind] for kind in KINDS if kind in set(table["kind"])]
    if lap := _lap_of(table):
        handles.append(Line2D([], [], marker="o", ls="", color=COLOURS["grey"], fillstyle="none"))
        words.append(f"the stage alone ({lap})")
    fig.legend(handles, words, loc="outside lower center", ncols=4)
    fig.suptitle(title, x=0.01, ha="left", fontsize=11)
    return fig


def growth_picture(title: str, table: pd.DataFrame) -> tuple[Figure, pd.DataFrame]:
    """Time against points, both logarithmic, with each racer's slope; and the slopes."""
    slopes = []
    with plt.style.context(STYLE):
        fig, axes = plt.subplots(figsize=(7.0, 5.0))
    for marker, (name, own) in zip("osD^vP", table.groupby("racer", sort=False), strict=False):
        own = own[own["failures"] < own["judged"]].sort_values("points")
        if len(own) < 2:
            continue
        points, seconds = own["points"].to_numpy(float), own["median_s"].to_numpy(float)
        slope = np.polyfit(np.log(points), np.log(seconds), 1)[0]
        last = np.log(seconds[-1] / seconds[-2]) / np.log(points[-1] / points[-2])
        slopes.append({"racer": name, "slope": slope, "slope_of_last_step": last})
        kind = own["kind"].iloc[0]
        label = f"{name}: slope {slope:.2f}, last step {last:.2f}"
        axes.plot(points, seconds, f"{marker}-", color=COLOURS[kind], lw=2.4 if kind == "ours" else 1.2, label=label)
    axes.set(xscale="log", yscale="log", xlabel="points per scan", ylabel="median time (s)")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_title(title)
    fig.legend(loc="outside lower center", fontsize=8)
    return fig, pd.DataFrame(slopes)


def _grouped(measurements: Sequence[Measurement]) -> dict[tuple[str, str], list[Measurement]]:
    groups: dict[tuple[str, str], list[Measurement]] = {}
    for one in measurements:
        groups.setdefault((one.case.label, one.racer.name), []).append(one)
    return groups


def _summary(name: str, values: Sequence[float]) -> float:
    values = [value for value in values if np.isfinite(value)]
    if not values:
        return np.nan
    return float(max(values) if "max" in name else np.median(values))


def _stages(own: Sequence[Measurement]) -> str:
    return ", ".join(f"{name} {_median_lap(own, name):.3f}" for name in own[-1].laps_s)


def _median_lap(own: Sequence[Measurement], name: str) -> float:
    return float(np.median([one.laps_s.get(name, np.nan) for one in own]))


def _lap_of(table: pd.DataFrame) -> str:
    """The stage that has columns of its own, or nothing."""
    return next((name.removesuffix("_of_fastest_peer") for name in table if name.endswith("_of_fastest_peer")), "")


def _dots(axes: Axes, table: pd.DataFrame, places: np.ndarray, column: str) -> None:
    values, timed = table[column].to_numpy(float), column == "median_s"
    colours = [COLOURS[kind] for kind in table["kind"]]
    shown = values
    if timed:
        axes.hlines(places, table["min_s"], table["max_s"], colors=colours, lw=2, alpha=0.5)
        if lap := _lap_of(table):
            alone = table[f"{lap}_s"].to_numpy(float)
            axes.scatter(alone, places, edgecolors=colours, facecolors="white", s=30, linewidths=1.2, zorder=3)
            shown = np.concatenate([values, alone])
    axes.scatter(values, places, c=colours, s=30, zorder=3)
    _set_limits(axes, shown[np.isfinite(shown)], room=3.0 if timed else 1.5)
    if timed:
        for value, place, failures, judged in zip(values, places, table["failures"], table["judged"], strict=True):
            text = f"{value:.3g} s" + (f", {failures} of {judged} fail" if failures else "")
            axes.annotate(text, (value, place), (6, 4), textcoords="offset points", fontsize=7)
    axes.set_xlabel(LABELS.get(column, column))


def _set_limits(axes: Axes, values: np.ndarray, room: float) -> None:
    """From zero, or logarithmic where values differ much; with ``room`` on the right of a logarithmic axis."""
    if not len(values):
        return
    if values.min() > 0 and values.max() / values.min() > 12:
        axes.set_xscale("log")
        axes.set_xlim(values.min() / 1.5, values.max() * room)
        axes.xaxis.set_major_locator(LogLocator(subs=(1,) if values.max() / values.min() > 200 else (1, 3)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_xlim(0, room**0.25 * values.max() or 1)
        axes.xaxis.set_major_locator(MaxNLocator(3))
        axes.xaxis.set_major_formatter("{x:g}")
