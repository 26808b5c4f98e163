"""Figures of chapter 15: shaded clouds with their seams, a section through a joint, error and sigma along a seam."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from numpy.typing import NDArray

import grindvision_book as book
from grindvision_book.chapter_10 import SURFACE, draw_surface
from grindvision_book.chapter_15.study import Looked

Floats = NDArray[np.float64]
COLOURS = book.COLOURS

#: A section is a slice so thick, mm.
SLICE_MM = 4.0


def draw_shaded(axes: Axes, looked: Looked) -> None:
    """A cloud as the camera sees it, shaded, with the true and the found seam."""
    draw_surface(axes, looked.scene.points, SURFACE)
    truth = looked.scene.root_mm
    axes.scatter(truth[:, 0], truth[:, 1], s=5, color=COLOURS["truth"], linewidths=0, zorder=3, label="true seam")
    if looked.seam is not None:
        root = looked.seam.root
        line = np.concatenate([root, root[:1]]) if looked.seam.closed else root
        axes.plot(line[:, 0], line[:, 1], color=COLOURS["ours"], lw=1.3, zorder=4, label="found")


def draw_gallery(looks: Mapping[str, Looked], caption: str) -> None:
    """One view of each kind."""
    fig, axes = plt.subplots(3, 3, figsize=(8.4, 7.6), layout="constrained")
    rows = []
    for place, (kind, looked) in zip(axes.flat, looks.items(), strict=True):
        draw_shaded(place, looked)
        words = "not found" if looked.seam is None else looked.seam.size
        place.set_title(f"{kind}\n{words}", fontsize=8)
        if looked.seam is not None:
            stations = pd.DataFrame(looked.seam.root, columns=["x_mm", "y_mm", "z_mm"]).round(4)
            rows.append(stations.assign(joint=kind, found_as=looked.seam.kind))
    axes[0, 0].legend(fontsize=7, loc="lower left", markerscale=2)
    book.save_figure(fig, "joints_gallery", pd.concat(rows), caption)


def section(looked: Looked, station: int) -> Floats:
    """Points (K, 2) of a slice across the seam at one of its stations: along the first face and above it, mm."""
    seam = looked.seam
    assert seam is not None
    root = seam.root[station]
    outward, normal = _first_face(looked, station)
    along = np.cross(outward, normal)
    away = looked.scene.points - root
    inside = (np.abs(away @ along) < SLICE_MM / 2) & (np.linalg.norm(away, axis=1) < 40)
    return np.column_stack([away[inside] @ outward, away[inside] @ normal])


def _first_face(looked: Looked, station: int) -> tuple[Floats, Floats]:
    """Unit direction away from the seam along the first face, and the face's normal, at a station."""
    seam = looked.seam
    assert seam is not None
    line = np.gradient(seam.root, axis=0)[station]
    normal = seam.faces[0, station]
    outward = np.cross(line / np.linalg.norm(line), normal)
    return outward * (1.0 if outward @ seam.normals[station] > 0 else -1.0), normal


def draw_sections(looks: Mapping[str, Looked], caption: str) -> None:
    """A slice across each joint: its points, the lines of both faces, and the root with ten times its sigma."""
    fig, axes = plt.subplots(1, len(looks), figsize=(8.4, 3.0), layout="constrained")
    tables = []
    for place, (name, looked) in zip(axes, looks.items(), strict=True):
        seam = looked.seam
        assert seam is not None
        station = len(seam.root) // 2
        points = section(looked, station)
        place.plot(points[:, 0], points[:, 1], ".", color=COLOURS["grey"], ms=1.5, rasterized=True)
        angle = np.radians(seam.opening_deg[station])
        reach = np.array([0.0, 32.0])
        place.plot(reach, 0 * reach, color=COLOURS["ours"], lw=1.2)
        place.plot(reach * np.cos(angle), reach * np.sin(angle), color=COLOURS["ours"], lw=1.2, label="faces at root")
        ring = Circle((0, 0), 10 * seam.sigma_mm[station], fill=False, color=COLOURS["paper_variant"], lw=1.5)
        place.add_patch(ring)
        place.plot([], [], color=COLOURS["paper_variant"], label="root, 10 sigma")
        place.set(aspect="equal", xlabel="along one face (mm)", title=name, xlim=(-38, 38), ylim=(-14, 40))
        tables.append(pd.DataFrame(points.round(3), columns=["along_mm", "above_mm"]).assign(joint=name))
    axes[0].set_ylabel("above it (mm)")
    axes[0].legend(fontsize=7, loc="upper left")
    book.save_figure(fig, "joints_sections", pd.concat(tables), caption)


def draw_stations(looks: Mapping[str, Looked], caption: str) -> None:
    """Along the seam: how far each station lies from the true line as the camera shows it, and twice its sigma."""
    fig, axes = plt.subplots(1, len(looks), figsize=(8.4, 2.8), sharey=True, layout="constrained")
    tables = []
    for place, (name, looked) in zip(axes, looks.items(), strict=True):
        seam = looked.seam
        assert seam is not None
        at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(seam.root, axis=0), axis=1))])
        truth = looked.scene.root_mm
        off, shown = looked.off_mm(truth), looked.off_mm(truth + looked.scene.root_errors_mm)
        place.fill_between(at, 0, 2 * seam.sigma_mm, color=COLOURS["truth"], alpha=0.25, lw=0, label="2 sigma, stated")
        place.plot(at, off, color=COLOURS["grey"], lw=1, label="from the true seam")
        place.plot(at, shown, color=COLOURS["ours"], lw=1.3, label="from it as the camera shows it")
        place.set(xlabel="along the seam (mm)", title=name, ylim=(0, 1.6))
        table = {"along_mm": at, "off_mm": off, "off_shown_mm": shown, "sigma_mm": seam.sigma_mm}
        tables.append(pd.DataFrame(table).round(4).assign(joint=name))
    axes[0].set_ylabel("across the seam (mm)")
    axes[0].legend(fontsize=7)
    book.save_figure(fig, "joints_stations", pd.concat(tables), caption)


def draw_noise(rows: pd.DataFrame, caption: str) -> None:
    """Lateral error and stated sigma against the camera's noise."""
    fig, axes = plt.subplots(figsize=(6.2, 3.0), layout="constrained")
    marks = {"t-joint": ("ours", "o"), "saddle": ("paper_variant", "s")}
    for kind, part in rows.groupby("joint", sort=False):
        colour, mark = marks[str(kind)]
        axes.plot(part["noise"], part["lateral_mean_mm"], color=COLOURS[colour], marker=mark, label=f"{kind}, mean off")
        axes.plot(
            part["noise"], part["sigma_mm"], color=COLOURS[colour], marker=mark, mfc="none", ls="--",
            label=f"{kind}, stated sigma",
        )  # fmt: skip
    axes.set(xlabel="noise, in units of the D415's", ylabel="across the seam (mm)")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False, fontsize=8)
    book.save_figure(fig, "joints_noise", rows, caption)
