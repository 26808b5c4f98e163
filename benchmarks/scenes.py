"""Accuracy over many scenes: ours beside a peer's on the same scans, and beside the least error these scans allow.

Number of scenes and statistic were chosen before the result was seen: the first ``Plan.scenes`` scenes of the seed, the
ratio of the medians; the rest stands beside it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.judging import beside
from benchmarks.racing import Arrays, Case, Measurement
from grindvision.clouds import read_cloud

Floats = NDArray[np.float64]

ERRORS = ("rotation_deg", "shift_mm", "path_mean_mm")
DRAWS = 10_000
INTERVAL = (0.025, 0.975)

STATIONS = 6
"""Places along the ridge at which the scan's own error is looked up, in the middle of equal parts: as path points."""

REACH_MM = 1.2
"""The scan's depth at a place of the ridge is fitted to the points of the bead within this distance of it."""

NOTES = (
    "Chosen before the result was seen: the first so many scenes of the seed, and the ratio of the medians as the"
    " figure that is judged.",
    f"[...]: 95 % of {DRAWS:,} draws of as many scenes, with replacement. Scenes in which a racer failed are left out"
    " for both, and counted.",
    "least: the distance of the scanned surface from the true ridge where the rays through the ridge meet it; what"
    " remains to someone who knows the ridge and reads its depth off the scan.",
)


def paired(found: Sequence[Measurement], ours: str = "grindvision") -> pd.DataFrame:
    """One row per case, peer and error over the scenes that both ran and neither failed in.

    Medians and means of both, their ratios, the share of scenes in which ours errs less, each with its bootstrap
    interval; for paths the median and mean of the least error (``least_error_mm``).
    """
    runs: dict[str, dict[str, dict[int, Measurement]]] = {}
    for one in found:
        runs.setdefault(one.case.label, {}).setdefault(one.racer.name, {})[one.round] = one
    rows = []
    for label, by_racer in runs.items():
        for peer, theirs in by_racer.items():
            both = sorted(by_racer[ours].keys() & theirs.keys())
            right = [scene for scene in both if not (by_racer[ours][scene].failed or theirs[scene].failed)]
            if peer == ours or len(right) < 2:
                continue
            least = np.array([least_error_mm(theirs[scene].case) for scene in right])
            for error in ERRORS:
                own, other = (
                    np.array([one[scene].accuracy[error] for scene in right]) for one in (by_racer[ours], theirs)
                )
                floor = least if error == "path_mean_mm" else np.full(len(right), np.nan)
                head = {
                    "case": label,
                    "peer": peer,
                    "error": error,
                    "scenes": len(right),
                    "failed": len(both) - len(right),
                }
                rows.append(
                    head | compared(own, other) | {"least_median": np.median(floor), "least_mean": floor.mean()}
                )
    return pd.DataFrame(rows)


def compared(own: Floats, other: Floats) -> dict[str, float | str]:
    """Errors (K,) of two racers on the same scenes: medians, means, ratios, and how often ``own`` is the less."""
    draws = np.random.default_rng(0).integers(len(own), size=(DRAWS, len(own)))
    return {
        "ours_median": float(np.median(own)),
        "peer_median": float(np.median(other)),
        "median_ratio": float(np.median(own) / np.median(other)),
        "median_ratio_95": _interval(np.median(own[draws], axis=1) / np.median(other[draws], axis=1)),
        "ours_mean": float(own.mean()),
        "peer_mean": float(other.mean()),
        "mean_ratio": float(own.mean() / other.mean()),
        "mean_ratio_95": _interval(own[draws].mean(axis=1) / other[draws].mean(axis=1)),
        "ours_less_percent": float(100 * (own < other).mean()),
        "ours_less_95": _interval(100 * (own < other)[draws].mean(axis=1)),
    }


def _interval(values: Floats) -> str:
    return "[{:.3g}, {:.3g}]".format(*np.quantile(values, INTERVAL))


def least_error_mm(case: Case) -> float:
    """Mean distance in mm of the scanned surface from the true ridge, along the rays through ``STATIONS`` of it."""
    truth: Arrays = case.truth()
    points = read_cloud(case.inputs["test"]).points[truth[f"on_bead_{case.label}"]]
    ridge = truth["ridge"]
    arcs = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ridge, axis=0), axis=1))])
    middles = (np.arange(STATIONS) + 0.5) / STATIONS * arcs[-1]
    places = np.column_stack([np.interp(middles, arcs, column) for column in ridge.T])
    shown = np.array([place + _depth_error(points, place) * place / place[2] for place in places])
    return float(beside(shown, ridge)[0].mean())


def _depth_error(points: Floats, place: Floats) -> float:
    """How much deeper the scan (N, 3) lies than ``place`` (3,) on the ray through it, by a quadric fitted nearby."""
    near = points[np.linalg.norm(points - place, axis=1) < REACH_MM]
    x, y = (near[:, :2] * (place[2] / near[:, 2:]) - place[:2]).T
    terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    return float(np.linalg.lstsq(terms, near[:, 2] - place[2], rcond=None)[0][0])
