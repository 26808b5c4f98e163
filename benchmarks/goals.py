"""What was asked of the races, beside what the tables in a folder say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

PYTHON_PEERS = ("Open3D", "KISS-Matcher + Open3D + SciPy")

NOTES = (
    "Errors of whole detection are judged by the ratio of the medians, as was said before they were seen. The rows of"
    " the means were added afterwards: the 95 % interval of the medians' ratio reaches from far below 1 to far above"
    " (bench_scenes), that of the means does not.",
)


def goals(folder: Path) -> pd.DataFrame:
    """One row per goal whose race stands in the folder: what, the limit, the figure, and whether it is met."""
    rows: list[tuple[str, str, float, float]] = []
    tables = {path.stem.removeprefix("bench_"): pd.read_csv(path) for path in folder.glob("bench_*.csv")}
    if "detect" in tables:
        rows += _detection(tables["detect"])
    if "scenes" in tables:
        rows += _mean_errors(tables["scenes"])
    if "growth" in tables:
        slope = tables["growth"].set_index("racer")["slope"]["grindvision"]
        rows.append(("whole detection: slope of time against points", "at most", 1.1, slope))
    if "coarse" in tables and (tables["coarse"]["case"] == "hard").any():
        hard = _row(tables["coarse"], "hard", "grindvision")
        rows.append(("first alignment, hard set: failures", "at most", 0, hard["failures"]))
        rows.append(("first alignment, hard set: median time (s)", "at most", 1.0, hard["median_s"]))
    if "hand_eye" in tables:
        rows += _hand_eye(tables["hand_eye"])
    if "groove" in tables:
        rows += _grooves(tables["groove"])
    table = pd.DataFrame(rows, columns=["goal", "asked", "limit", "measured"])
    met = np.where(
        table["asked"] == "at most", table["measured"] <= table["limit"], table["measured"] >= table["limit"]
    )
    return table.assign(verdict=np.where(met, "met", "missed"))


def _detection(table: pd.DataFrame) -> list[tuple[str, str, float, float]]:
    rows = []
    for size in ("500k", "2M"):
        own = table[table["case"] == size].set_index("racer")
        if not {"grindvision", *PYTHON_PEERS[:1]} <= set(own.index):
            continue
        ours, peers = own.loc["grindvision"], own[own["kind"] == "peer"]
        fastest = peers.loc[peers["median_s"].where(peers["failures"] < 0.5 * peers["judged"]).idxmin()]
        leanest = own.loc[[name for name in PYTHON_PEERS if name in own.index]]
        rows.append((f"whole detection, {size}: time over the fastest peer's", "at most", 0.5, ours["of_fastest_peer"]))
        for error in ("rotation_deg", "shift_mm", "path_mean_mm"):
            what = f"whole detection, {size}: {error} over the fastest peer's"
            rows.append((what, "at most", 1.0, ours[error] / fastest[error]))
        for memory, name in (("peak_mib", "peak memory"), ("growth_mib", "memory beyond the imports")):
            what = f"whole detection, {size}: {name} over the leanest Python peer's"
            rows.append((what, "at most", 1.25, ours[memory] / leanest[memory].min()))
    return rows


def _mean_errors(table: pd.DataFrame) -> list[tuple[str, str, float, float]]:
    """Ratios of the means, beside those of the medians."""
    own = table[table["peer"] == PYTHON_PEERS[0]]
    return [
        (
            f"whole detection, {one.case}: {one.error} over {one.peer}'s, means of {one.scenes} scenes",
            "at most",
            1.0,
            one.mean_ratio,
        )
        for one in own.itertuples()
    ]


def _grooves(table: pd.DataFrame) -> list[tuple[str, str, float, float]]:
    rows: list[tuple[str, str, float, float]] = []
    for piece in dict.fromkeys(table["case"]):
        own = table[table["case"] == piece].set_index("racer")
        if "PCL, fastest" not in own.index:
            continue
        ours, fastest = own.loc["grindvision"], own.loc["PCL, fastest"]
        best = own[own.index.str.startswith("PCL")]["overlap_percent"].max()
        times = fastest["groove_s"] / ours["groove_s"]
        rows.append((f"groove, {piece}: times faster than PCL's fastest", "at least", 20, times))
        ahead = ours["overlap_percent"] - best
        rows.append((f"groove, {piece}: overlap less PCL's best (%)", "at least", 0, ahead))
    return rows


def _hand_eye(table: pd.DataFrame) -> list[tuple[str, str, float, float]]:
    own, peers = (table[table["kind"] == kind] for kind in ("ours", "peer"))
    if peers.empty:
        return []
    return [
        (f"hand-eye: median {error} over the best peer's", "at most", 1.0, own[error].iloc[0] / peers[error].min())
        for error in ("shift_mm", "rotation_deg")
    ]


def _row(table: pd.DataFrame, case: str, racer: str) -> pd.Series:
    return table[(table["case"] == case) & (table["racer"] == racer)].iloc[0]
