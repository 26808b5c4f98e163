"""report.png of ``grindvision simulate``: what was made, seen from above, its truth in orange."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from grindvision.cli.pictures import save_png
from grindvision.cli.verdict import draw_verdict
from grindvision.extras import extra
from grindvision.relief import draw_relief

with extra("plot"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

if TYPE_CHECKING:
    from grindvision.cell import CalibrationExperiment, GrindingScene, JointScene, WeldScene

GREY, MARKED, TRUTH, TEST_ROWS = "#bbbbbb", "#0072B2", "#D55E00", "#E69F00"


def draw(made: Any, subject: str, seed: int, path: Path) -> None:
    """Draw what ``simulate`` made of a subject."""
    if subject == "joints":
        rows = -(-len(made) // 2)
        size = (11.0, 4.5 * rows + 1)
    else:
        rows, size = {"grinding": (1, (11, 5)), "welding": (2, (11, 9.5)), "calibration": (1, (11, 5.5))}[subject]
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, 2).ravel()
    draw_subject: dict[str, Callable[..., str]] = {
        "grinding": _draw_grinding,
        "welding": _draw_welding,
        "calibration": _draw_calibration,
        "joints": _draw_joints,
    }
    facts = draw_subject[subject](axes, made)
    draw_verdict(figure, f"Simulated: {subject}, seed {seed}. Synthetic, nothing here was measured", facts, ())
    save_png(figure, path)


def _draw_grinding(axes: np.ndarray, scene: GrindingScene) -> str:
    _surface(axes[0], scene.sample.points, GREY)
    _surface(axes[1], scene.test.points, GREY)
    axes[1].plot(*scene.ridge_mm[:, :2].T, color=TRUTH, lw=2, label="ridge of the bead (truth)")
    axes[1].legend(frameon=True, framealpha=0.9, edgecolor="none", loc="upper right")
    axes[0].set_title("sample.ply, the good part")
    axes[1].set_title("test.ply, the part with a bead")
    return str(scene)


def _draw_welding(axes: np.ndarray, scenes: dict[str, WeldScene]) -> str:
    for panel, (kind, scene) in zip(axes, scenes.items(), strict=True):
        points, labels = scene.points.reshape(-1, 3), scene.labels.ravel()
        _surface(panel, points[labels], MARKED, _surface(panel, points, GREY))
        panel.plot(*scene.root_mm[:, :2].T, color=TRUTH, lw=1.5)
        panel.set_title(f"{kind}: {len(points):,} points, {labels.sum():,} in the groove")
    return "Blue: points of the groove, orange: its root (truth). Frame: the camera's, seen from the camera."


def _draw_joints(axes: np.ndarray, scenes: dict[str, JointScene]) -> str:
    for panel in axes[len(scenes) :]:
        panel.set_axis_off()
    for panel, (kind, scene) in zip(axes, scenes.items(), strict=False):
        _surface(panel, scene.points, GREY)
        panel.plot(*scene.root_mm[:, :2].T, ".", ms=1.5, color=TRUTH)
        panel.set_title(f"{kind}: {len(scene.points):,} points")
    return "Orange: the seam as far as it is seen (truth). Frame: the camera's, seen from the camera."


def _draw_calibration(axes: np.ndarray, experiment: CalibrationExperiment) -> str:
    table = experiment.table
    train = (table["split"] == "train").to_numpy()
    for panel, letter, title in ((axes[0], "b", "tracker frame"), (axes[1], "s", "scanner frame")):
        for rows, colour, name in ((train, MARKED, "train"), (~train, TEST_ROWS, "test")):
            panel.plot(table[f"{letter}x_mm"][rows], table[f"{letter}y_mm"][rows], "o", ms=4, color=colour, label=name)
        panel.set_title(f"sphere centres in the {title}")
        panel.set(aspect="equal", xlabel="x, mm", ylabel="y, mm")
        panel.legend(frameon=True, framealpha=0.9, edgecolor="none")
    return str(experiment)


def _surface(axes: Axes, points: np.ndarray, colour: str, size_mm: float = 0.0) -> float:
    """Points (N, 3) as the camera sees them: its x to the right, y downwards, z away from it."""
    axes.yaxis.set_inverted(True)
    axes.set(aspect="equal", xlabel="x, mm", ylabel="y, mm")
    return draw_relief(axes, points[:, :2], -points[:, 2], colour, size_mm=size_mm)
