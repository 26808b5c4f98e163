"""Files of the engineer's chapter: a reader's own or simulated ones, what to measure first, and what to doubt after."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.clouds import extent, finite_points, read_cloud
from grindvision.errors import InputError
from grindvision.vision.seam.groove_diagnostics import MIN_BOTH_SIDES
from grindvision.vision.surface.surfels import build_surfels

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Source:
    """Files of one task, and where they come from: ``origin`` is ``your own`` or ``synthetic (seed N)``.

    ``folder`` is where ``grindvision simulate`` puts them when they are synthetic.
    """

    task: str
    files: tuple[Path, ...]
    folder: Path
    synthetic: bool
    origin: str

    def truth(self) -> dict[str, Any]:
        """What is true about synthetic files: the truth.json beside the first of them."""
        return json.loads((self.files[0].parent / "truth.json").read_text(encoding="utf-8"))

    def __str__(self) -> str:
        return f"{self.task}, {self.origin}: {', '.join(str(file) for file in self.files)}"


def source(task: str, given: Mapping[str, str], simulated: Sequence[str], inputs: str | Path, seed: int) -> Source:
    """The reader's files of a task where they are given, else the simulated ones.

    Args:
        task: what ``grindvision simulate`` calls it.
        given: the chapter's parameters by name, empty where nothing is given.
        simulated: the files' names in the simulated folder, in the same order.
        inputs: folder for the simulated tasks.
        seed: of the simulation.

    Raises:
        InputError: some of the files are given and some are not.
    """
    folder = Path(inputs) / f"{task}_{seed}"
    named = [name for name, file in given.items() if file]
    if named and len(named) < len(given):
        missing = ", ".join(name for name in given if name not in named)
        raise InputError(f"{task}: {', '.join(named)} is given, {missing} is empty; give all of them or none")
    if named:
        return Source(task, tuple(Path(file) for file in given.values()), folder, False, "your own")
    return Source(task, tuple(folder / name for name in simulated), folder, True, f"synthetic (seed {seed})")


def cloud_facts(path: str | Path, unit: str | None = None) -> dict[str, float | str]:
    """What to measure of a scan before anything else: number of points, size, spacing and noise, in mm.

    ``spacing_mm`` is the median distance to the nearest neighbour, ``noise_mm`` the median spread of the points about
    planes a few spacings wide.
    """
    points = finite_points(read_cloud(path, unit), str(path))
    few = points[:: max(1, len(points) // 5000)]
    spacing = float(np.median(cKDTree(points).query(few, 2)[0][:, 1]))
    surfels = build_surfels(points, 4 * spacing)
    sizes = dict(zip(("x_mm", "y_mm", "z_mm"), extent(points).tolist(), strict=True))
    noise = float(np.median(surfels.noise_mm[surfels.counts >= 6]))
    return {"file": Path(path).name, "points": len(points), **sizes, "spacing_mm": spacing, "noise_mm": noise}


def slice_across(
    points: ArrayLike, at: ArrayLike, along: ArrayLike, up: ArrayLike, reach_mm: float, thickness_mm: float
) -> pd.DataFrame:
    """Points (N, 3) of a slice across a path, ``across_mm`` and ``height_mm`` from the path point ``at``.

    Args:
        along: direction (3,) of the path there; the slice is perpendicular to it.
        up: surface normal (3,).
        reach_mm: points farther aside, or farther above or below, are left out.
        thickness_mm: of the slice.
    """
    normal, ahead = np.asarray(up, dtype=float), np.asarray(along, dtype=float)
    ahead = ahead - normal * (ahead @ normal)
    ahead = ahead / np.linalg.norm(ahead)
    away = np.asarray(points, dtype=float) - np.asarray(at, dtype=float)
    across, height = away @ np.cross(normal, ahead), away @ normal
    near = (np.abs(away @ ahead) < thickness_mm / 2) & (np.abs(across) < reach_mm) & (np.abs(height) < reach_mm)
    return pd.DataFrame({"across_mm": across[near], "height_mm": height[near]})


def profile(slice_: pd.DataFrame, step_mm: float, least: int = 3) -> pd.DataFrame:
    """Median height of a slice in steps across; steps with fewer than ``least`` points are left out."""
    step = np.round(slice_["across_mm"] / step_mm).astype(int)
    groups = slice_.groupby(step)["height_mm"].agg(["median", "size"]).query("size >= @least")
    return pd.DataFrame({"across_mm": groups.index * step_mm, "height_mm": groups["median"].to_numpy()})


def judge_detection(report: Mapping[str, Any], noise_mm: float) -> pd.DataFrame:
    """What to look at in a report.json of ``detect``: quantity, value, when it is well, and what it says otherwise."""
    level = report["level_of_detection_mm"]
    rows = [
        ("confidence", report["confidence"], ">=", 0.5, "another pose fits nearly as well: compare the scans by eye"),
        (
            "overlap (fitness)",
            report["fitness"],
            ">=",
            0.5,
            "the rest of the test scan has nothing to be compared with",
        ),
        (
            "rmse (mm): three times the noise",
            report["rmse"],
            "<=",
            3 * noise_mm,
            "the surfaces differ by more than noise",
        ),
    ]
    rows += [
        (
            f"height of bead {number} (mm): twice the level of detection",
            bead["height_mm"],
            ">=",
            2 * level,
            "may be noise or bending",
        )
        for number, bead in enumerate(report["beads"], start=1)
    ]
    return _judged(rows)


def judge_groove(report: Mapping[str, Any], spacing_mm: float, noise_mm: float) -> pd.DataFrame:
    """What to look at in a report.json of ``groove``, for its first groove."""
    groove = report["grooves"][0]
    width = groove["width_mm"]
    rows = [
        ("width (mm): 8 spacings", width, ">=", 8 * spacing_mm, "few points across: the root is a guess"),
        (
            "depth (mm): 6 times the noise",
            groove["depth_mm"],
            ">=",
            6 * noise_mm,
            "the noise hides the walls: scan from nearer",
        ),
        ("length (mm): 3 widths", groove["length_mm"], ">=", 3 * width, "short: may be a dent"),
        (
            "share with both edges seen",
            groove["edges_seen"],
            ">=",
            MIN_BOTH_SIDES,
            "partly outside the cloud: scan it whole",
        ),
        ("deviation of the root (mm)", groove["root_deviation_mm"], "<=", 1.0, "the root is uncertain"),
    ]
    return _judged(rows)


def judge_calibration(report: Mapping[str, Any]) -> pd.DataFrame:
    """What to look at in a report.json of ``calibrate``."""
    test, train = (report["errors_mm"][part]["after"] for part in ("test", "train"))
    before = report["errors_mm"]["test"]["before"]["mean"]
    rows = [
        (
            "mean error of unseen rows (mm): half of that before",
            test["mean"],
            "<=",
            before / 2,
            "calibration hardly helped",
        ),
        (
            "the same: 2.5 times that of fitted rows",
            test["mean"],
            "<=",
            2.5 * train["mean"],
            "the fit follows the noise: measure more poses",
        ),
        (
            "largest error of unseen rows (mm): 5 times the mean",
            test["max"],
            "<=",
            5 * test["mean"],
            "a bad row: find and repeat it",
        ),
        ("rank: 60 % of the unknowns", report["rank"], ">=", 0.6 * report["unknowns"], "move all joints, and farther"),
    ]
    return _judged(rows)


def _judged(rows: Sequence[tuple[str, float, str, float, str]]) -> pd.DataFrame:
    """Rows of quantity, value, ``>=`` or ``<=``, bound, and what it means otherwise."""
    well = [value >= bound if sign == ">=" else value <= bound for _, value, sign, bound, _ in rows]
    return pd.DataFrame(
        {
            "quantity": [row[0] for row in rows],
            "value": [float(row[1]) for row in rows],
            "well_if": [f"{'≥' if row[2] == '>=' else '≤'}\u00a0{row[3]:.3g}" for row in rows],
            "verdict": ["well" if one else "look" for one in well],
            "otherwise": [row[4] for row in rows],
        }
    )


def middle_of(path: pd.DataFrame, points: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Place, direction and normal (3,) at the middle of a path (columns x_mm..nz), for a slice across it.

    Without path points: the middle of the scan (N, 3), its x direction, and up to the scanner at the origin.
    """
    if path.empty:
        points = np.asarray(points, dtype=float)
        at = points[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]
        return at, np.array([1.0, 0.0, 0.0]), -at / np.linalg.norm(at)
    places = path[["x_mm", "y_mm", "z_mm"]].to_numpy()
    row = len(places) // 2
    along = places[min(row + 1, len(places) - 1)] - places[max(row - 1, 0)]
    return places[row], along if along.any() else np.array([1.0, 0.0, 0.0]), path[["nx", "ny", "nz"]].to_numpy()[row]
