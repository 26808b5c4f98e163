"""Draws way points, the camera's field and the motion of chapter 11; each function returns the data it drew."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from grindvision.geometry import move_points
from grindvision_book.chapter_11.waypoints import waypoint_errors
from grindvision_book.machinery.session import COLOURS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from grindvision.cell import WeldScene
    from grindvision.motion import Motion
    from grindvision.vision.seam.seam_path import SeamPath

Floats = NDArray[np.float64]

#: Colours of the variants whose way points are compared.
SHOWN = {"paper": COLOURS["paper_variant"], "ours": COLOURS["ours"], "calibrated": COLOURS["truth"]}


def draw_slabs(
    scenes: Mapping[str, WeldScene], strips: Mapping[str, Floats], count: int
) -> tuple[Figure, pd.DataFrame]:
    """Figure 13 of peng2020: groove points (N, 3) of each piece in slabs of equal width, three colours in turn."""
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(2, 4, figsize=(9.4, 3.6))
    colours = np.array([COLOURS["ours"], COLOURS["truth"], COLOURS["test"]])
    drawn = []
    for column, (kind, points) in zip(axes.T, strips.items(), strict=True):
        sample = _in_piece(scenes[kind], _some(points, 8000))
        centred = sample - sample.mean(axis=0)
        along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        slabs = np.floor(count * 0.999 * (along - along.min()) / np.ptp(along)).astype(int)
        a, b = (1, 0) if kind == "cylinder" else (0, 1)
        for axis, other in zip(column, (b, 2), strict=True):
            axis.scatter(sample[:, a], sample[:, other], c=colours[slabs % 3], s=3, lw=0, rasterized=True)
            axis.set(xlabel=f"{'xyz'[a]}, mm", ylabel=f"{'xyz'[other]}, mm")
        column[0].set_title(kind)
        table = pd.DataFrame(sample[::16], columns=["x_mm", "y_mm", "z_mm"])
        drawn.append(table.assign(piece=kind, slab=slabs[::16]))
    return fig, pd.concat(drawn)


def draw_field(left: pd.DataFrame) -> tuple[Figure, pd.DataFrame]:
    """A camera's depth error in the middle of the volume, what the plates taught of it, and the difference.

    Args:
        left: see ``waypoints.depth_left``.
    """
    import matplotlib.pyplot as plt
    from matplotlib.ticker import MaxNLocator

    distances = np.unique(left["z_mm"])
    shown = left[left["z_mm"] == distances[len(distances) // 2]]
    most = np.abs(shown[["true_mm", "learned_mm"]].to_numpy()).max()
    fig, axes = plt.subplots(1, 3, figsize=(9.4, 2.4), sharey=True)
    for axis, name in zip(axes, ("true", "learned", "left"), strict=True):
        grid = shown.pivot(index="y_mm", columns="x_mm", values=f"{name}_mm")
        image = axis.pcolormesh(
            grid.columns, grid.index, grid, cmap="RdBu_r", vmin=-most, vmax=most, shading="nearest", rasterized=True
        )
        rms = np.sqrt((shown[f"{name}_mm"] ** 2).mean())
        axis.set(title=f"{name}: {rms:.2f} mm rms", xlabel="x, mm", aspect="equal")
        axis.grid(visible=False)
        axis.xaxis.set_major_locator(MaxNLocator(4))
    axes[0].set_ylabel("y, mm")
    fig.colorbar(image, ax=axes, label="depth error, mm", shrink=0.7)
    return fig, shown


def draw_sections(
    scenes: Mapping[str, WeldScene], paths: Mapping[str, Mapping[str, SeamPath]]
) -> tuple[Figure, pd.DataFrame]:
    """Figure 14 of peng2020: way points on each piece, and below in the groove's true cross-section.

    Args:
        scenes: by piece.
        paths: by variant (see ``SHOWN``) and piece, camera frame.
    """
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(2, 4, figsize=(9.4, 4.0))
    drawn = []
    for column, (kind, scene) in zip(axes.T, scenes.items(), strict=True):
        a, b = (1, 2) if kind == "cylinder" else (0, 1)
        cloud = _in_piece(scene, _some(scene.points, 4000))
        column[0].scatter(cloud[:, a], cloud[:, b], color="#cccccc", s=0.3, lw=0, rasterized=True)
        column[1].plot([-6, 0, 6], [7, 0, 7], color=COLOURS["grey"], lw=1)
        for variant, by_piece in paths.items():
            errors, at = waypoint_errors(by_piece[kind], scene), _in_piece(scene, by_piece[kind].points)
            column[0].plot(at[:, a], at[:, b], ".", ms=2, color=SHOWN[variant])
            column[1].plot(errors.across_mm, errors.up_mm, ".", ms=3, color=SHOWN[variant], label=variant)
            table = pd.DataFrame(at, columns=["x_mm", "y_mm", "z_mm"])
            table = table.assign(across_mm=errors.across_mm, up_mm=errors.up_mm, piece=kind, variant=variant)
            drawn.append(table)
        column[0].set(title=kind, xlabel=f"{'xyz'[a]}, mm", ylabel=f"{'xyz'[b]}, mm")
        column[0].set_aspect("equal", adjustable="datalim")
        column[1].set(xlabel="across, mm", xlim=(-8, 8), ylim=(-2, 9), aspect="equal")
    axes[1, 0].set_ylabel("above root, mm")
    fig.legend(*axes[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, markerscale=3)
    return fig, pd.concat(drawn)


def draw_motions(motions: Mapping[str, Motion]) -> tuple[Figure, pd.DataFrame]:
    """Joint angles since the start, joint speeds and clearances along each seam."""
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(3, len(motions), figsize=(9.8, 6.4), sharex="col")
    drawn = []
    for column, (kind, run) in zip(axes.T, motions.items(), strict=True):
        timing, free, arc = run.timing, run.clearance.distance_mm[1:-1], run.trajectory.arc_mm
        q = np.degrees(timing.q_rad - timing.q_rad[0])
        share = 100 * timing.speed_rad_s / run.robot.limits.speed_rad_s
        for j, name in enumerate(run.robot.joints):
            column[0].plot(timing.arc_mm, q[:, j], label=name.removesuffix("_joint"))
            column[1].plot(timing.arc_mm, share[:, j])
        column[2].plot(arc, free, label=["itself", "table", "work"])
        column[0].set_title(kind)
        column[2].set(xlabel="along the seam, mm", ylim=(0, None))
        at = [np.interp(arc, timing.arc_mm, q[:, j]) for j in range(len(run.robot.joints))]
        names = ["arc_mm", *[f"{name}_deg" for name in run.robot.joints], "itself_mm", "table_mm", "work_mm"]
        drawn.append(pd.DataFrame(np.column_stack([arc, *at, free]), columns=names).assign(piece=kind))
    for axis, label in zip(
        axes[:, 0], ("joint angle - start, deg", "joint speed, % of limit", "clearance, mm"), strict=True
    ):
        axis.set_ylabel(label)
    for axis in axes[[0, 2], -1]:
        axis.legend(loc="upper left", bbox_to_anchor=(1.02, 1))
    return fig, pd.concat(drawn)


def _in_piece(scene: WeldScene, points: Floats) -> Floats:
    """Points (N, 3) of the camera frame in the piece's own frame."""
    return move_points(scene.scan.T_world_scanner, points)


def _some(points: Floats, count: int) -> Floats:
    """At most ``count`` of the points, for drawing; always the same ones."""
    return points[np.random.default_rng(0).permutation(len(points))[:count]]
