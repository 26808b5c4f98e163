"""Does the confidence of a pose mean what it says? Pairs of scans of good workpieces, measured once and committed.

``python -m grindvision_book.chapter_05.confidence 100`` measures the rows again, some seconds of one core a pair.
"""

from __future__ import annotations

import itertools
import re
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from scipy.stats import binomtest

from grindvision import DetectOptions, detect
from grindvision.cell.workpiece_scene import workpiece_scene
from grindvision.cell.workpieces import WORKPIECES
from grindvision.errors import GrindvisionError
from grindvision_book.machinery.session import COLOURS

ROWS = Path(__file__).parent / "confidence_pairs.csv"

SEED, STRIDE = 77, 10
"""Pairs are numbered as in ``tests/test_good_against_good.py``, which has two parts of its own among ten."""

MAX_POSE_MM, SIGMAS = 1.0, 3.0
"""A pose is right that moves no point by more than the first, or by so many of the standard deviations that the answer
warned of: how far a pose slides is told by them, and which of several poses is right by the confidence."""

EDGES = (0.5, 0.9, 0.99, 1.0)
"""Bins of the confidence: below the first is a refusal, below the second a warning."""


def case(pair: int) -> dict[str, Any]:
    """Register two scans of a good workpiece: ``confidence`` of the pose, how far it is off (``pose_mm``), the standard
    deviation that was warned of (``warned_mm``), or why the pair was ``refused``."""
    kind = tuple(WORKPIECES)[pair % STRIDE]
    scene = workpiece_scene(kind, np.random.default_rng([SEED, pair]), "none")
    row: dict[str, Any] = {"pair": pair, "kind": kind, "determined": scene.determined}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = detect(scene.sample.points, scene.test.points, DetectOptions(seed=pair))
        except GrindvisionError as error:
            return row | {"refused": short(str(error))}
    return row | {
        "confidence": found.confidence,
        "pose_mm": scene.pose_error_mm(found.T_sample_test),
        "warned_mm": warned_of([str(one.message) for one in caught]),
        "refused": "",
    }


def short(refusal: str) -> str:
    """The kind of a refusal."""
    return "ambiguous" if "ambiguous" in refusal else "no fit"


def warned_of(said: list[str]) -> float:
    """Standard deviation in mm of the pose that warnings state; 0 where none does."""
    stated = [float(one.group(1)) for text in said if (one := re.search(r"known to ([\d.e+-]+) mm only", text))]
    return max(stated, default=0.0)


def pairs(number: int) -> list[int]:
    """Numbers of the pairs below ``number`` whose part the package has."""
    return [pair for pair in range(number) if pair % STRIDE < len(WORKPIECES)]


def committed_rows() -> pd.DataFrame:
    """The rows that were measured; ``right`` says whether an answer is."""
    rows = pd.read_csv(ROWS, keep_default_na=False, na_values={"confidence": "", "pose_mm": "", "warned_mm": ""})
    rows["right"] = rows["pose_mm"] <= np.maximum(MAX_POSE_MM, SIGMAS * rows["warned_mm"])
    return rows


def reliability(rows: pd.DataFrame) -> pd.DataFrame:
    """By bins of the confidence: mean confidence, answers, right ones, and in % their share with its 95 % interval."""
    answered = rows[rows["refused"] == ""]
    table = []
    for low, high in itertools.pairwise(EDGES):
        last = high == EDGES[-1]
        inside = answered[(answered["confidence"] >= low) & ((answered["confidence"] < high) | last)]
        count, right = len(inside), int(inside["right"].sum())
        interval = binomtest(right, count).proportion_ci(0.95) if count else (0.0, 1.0)
        table.append(
            {
                "from": low,
                "to": high,
                "mean_confidence": inside["confidence"].mean() if count else np.nan,
                "answers": count,
                "right": right,
                "right_percent": 100 * right / count if count else np.nan,
                "low_percent": 100 * interval[0],
                "high_percent": 100 * interval[1],
            }
        )
    return pd.DataFrame(table)


def draw(table: pd.DataFrame) -> Figure:
    """Share of right answers, with its interval, over the confidence that they were given with."""
    fig, axes = plt.subplots(figsize=(4.8, 3.2))
    axes.plot([50, 100], [50, 100], color=COLOURS["grey"], linewidth=0.8, label="as stated")
    for row in table[table["answers"] > 0].itertuples():
        at = 100 * row.mean_confidence
        axes.plot([at, at], [row.low_percent, row.high_percent], color=COLOURS["ours"], linewidth=1.5)
        axes.plot(at, row.right_percent, "o", color=COLOURS["ours"])
        axes.annotate(
            f"{row.right} of {row.answers}", (at, row.low_percent), (6, 2), textcoords="offset points", ha="left"
        )
    axes.axvline(90, color=COLOURS["grey"], linewidth=0.6, linestyle=":")
    axes.text(89.5, 12, "warned of", ha="right", fontsize=9)
    axes.set(
        xlim=(48, 112),
        xticks=range(50, 101, 10),
        ylim=(0, 103),
        xlabel="stated confidence, %",
        ylabel="answers that are right, %",
    )
    axes.legend(loc="lower left")
    return fig


if __name__ == "__main__":
    pd.DataFrame([case(pair) for pair in pairs(int(sys.argv[1]))]).to_csv(ROWS, index=False)
