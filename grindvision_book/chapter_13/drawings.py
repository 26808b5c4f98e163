"""Figures of chapter 13."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt

import grindvision_book as book
from grindvision_book.chapter_13.arms import ArmErrors
from grindvision_book.chapter_13.sphere import SeenSphere
from grindvision_book.chapter_13.views import WRONG_DEG, Plate

COLOURS = book.COLOURS
_STATES = {"right": ("o", COLOURS["ours"]), "wrong": ("X", COLOURS["test"]), "refused": ("s", COLOURS["grey"])}


def draw_arms(arms: Mapping[str, ArmErrors], others: Mapping[str, tuple[float, str]], caption: str) -> None:
    """Distribution of the errors on unseen poses, an axis an arm; ``others``: what another method left there."""
    fig, axes = plt.subplots(1, len(arms), figsize=(7.2, 3.7), sharey=True, squeeze=False)
    rows = []
    for place, (name, found) in zip(axes[0], arms.items(), strict=True):
        stages = (
            ("base and tool", found.placed, "grey"),
            ("all geometry", found.geometry, "ours"),
            ("waves and sag too", found.beyond, "paper_variant"),
        )
        for stage, errors, colour in stages:
            percent = np.linspace(0, 100, 101)
            lengths = np.percentile(errors, percent)
            label = f"{stage}: mean {errors.mean():.3f} mm"
            place.plot(lengths, percent, color=COLOURS[colour], label=label)
            rows.append(pd.DataFrame({"arm": name, "stage": stage, "percent": percent, "error_mm": lengths}))
        value, whose = others[name]
        place.axvline(value, color=COLOURS["peer"], linestyle="--", label=f"{whose}: mean {value:.3f} mm")
        place.set(title=name.upper(), xlabel="error on unseen poses (mm)", xscale="log")
        place.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.24))
    axes[0, 0].set_ylabel("share of the poses (%)")
    book.save_figure(fig, "measured_arms", pd.concat(rows), caption)


def draw_sphere(seen: SeenSphere, caption: str) -> None:
    """Radius of every view beside SciPy's, and where each pose puts the sphere through the hand-eye matrix."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(7.2, 2.8))
    number = np.arange(1, len(seen.fits) + 1)
    used = np.linalg.norm(seen.camera.residuals_mm, axis=1)
    left.plot(number, seen.radii_mm, "o", color=COLOURS["ours"], label="ours")
    left.plot(number, seen.scipy_radii_mm, "+", color=COLOURS["peer"], markersize=10, label="SciPy, same points")
    left.set(xlabel="view", ylabel="radius (mm)", xticks=number)
    left.legend()
    right.bar(number - 0.2, used, 0.4, color=COLOURS["ours"], label="in the fit")
    right.bar(number + 0.2, seen.camera.left_out_mm, 0.4, color=COLOURS["paper_variant"], label="left out of it")
    right.set(xlabel="pose", ylabel="sphere off its place (mm)", xticks=number)
    right.set_ylim(0, 1.3 * seen.camera.left_out_mm.max())
    right.legend(ncols=2, loc="upper center")
    rows = {"view": number, "radius_mm": seen.radii_mm, "scipy_radius_mm": seen.scipy_radii_mm}
    rows |= {
        "residue_mm": np.array([fit.rms_mm for fit in seen.fits]),
        "in_fit_mm": used,
        "left_out_mm": seen.camera.left_out_mm,
    }
    book.save_figure(fig, "measured_sphere", pd.DataFrame(rows), caption)


def draw_views(pairs: pd.DataFrame, caption: str) -> None:
    """Every pair of neighbouring views: the angle that the registration finds, less the controller's."""
    names = list(dict.fromkeys(pairs["set"]))
    fig, axes = plt.subplots(1, len(names), figsize=(7.2, 2.7), sharey=True, squeeze=False)
    for place, name in zip(axes[0], names, strict=True):
        of_set = pairs[pairs["set"] == name].reset_index(drop=True)
        for state, (marker, colour) in _STATES.items():
            chosen = of_set[of_set["state"] == state]
            height = np.clip(chosen["off_deg"].fillna(0.0), -1.5, 1.5)
            place.plot(chosen.index + 1, height, marker, color=colour, linestyle="none", label=state)
        place.axhspan(-WRONG_DEG, WRONG_DEG, color=COLOURS["truth"], alpha=0.12)
        counts = ", ".join(f"{(of_set['state'] == state).sum()} {state}" for state in _STATES)
        place.set_title(f"{name}: {counts}", fontsize=8)
        place.set(xlabel="pair of views", ylim=(-1.9, 1.6), xticks=np.arange(1, len(of_set) + 1))
    axes[0, 0].set_ylabel("angle less the controller's (deg)")
    axes[0, 0].legend(fontsize=7, loc="lower center", ncols=3, columnspacing=0.8, handletextpad=0.1)
    book.save_figure(fig, "measured_views", pairs.drop(columns="said"), caption)


def draw_plate(plate: Plate, caption: str, cell_mm: float = 3.0) -> None:
    """Mean height of the plate above its plane in cells, in its first and third view."""
    fig, axes = plt.subplots(1, 2, figsize=(7.2, 2.8), sharex=True, sharey=True)
    tables = []
    for place, view in zip(axes, (1, 3), strict=True):
        points = plate.heights[view - 1]
        corners = np.floor(points[:, :2] / cell_mm) * cell_mm
        cells = pd.DataFrame({"u_mm": corners[:, 0], "v_mm": corners[:, 1], "height_mm": points[:, 2]})
        cells = cells.groupby(["u_mm", "v_mm"], as_index=False)["height_mm"].mean().round(3)
        grid = cells.pivot(index="v_mm", columns="u_mm", values="height_mm")
        seen = place.pcolormesh(grid.columns, grid.index, grid, cmap="viridis", vmin=-0.8, vmax=0.8, rasterized=True)
        place.set(title=f"view {view}", aspect="equal", xlabel="along the plate (mm)")
        tables.append(cells.assign(view=view))
    axes[0].set_ylabel("across (mm)")
    fig.colorbar(seen, ax=axes, label="height above the plane (mm)", shrink=0.8)
    book.save_figure(fig, "measured_plate", pd.concat(tables), caption)
