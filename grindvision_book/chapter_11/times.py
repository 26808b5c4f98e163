"""Table I of the second paper beside the committed race: seconds that every machine reads alike."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from grindvision import paper
from grindvision.errors import FileError
from grindvision.files import read_table
from grindvision_book.machinery.places import FIGURES

if TYPE_CHECKING:
    import pandas as pd

#: What ``./run bench`` writes and commits.
RACE = FIGURES / "bench_groove.csv"
_RACERS = {"paper_variant_s": "the paper's method", "ours_s": "grindvision", "pcl_s": "PCL, fastest"}


def raced_table(race: Path = RACE) -> pd.DataFrame:
    """Seconds from a cloud to a trajectory, one row per piece: printed, and as ``./run bench`` committed them.

    Returns:
        ``piece``, ``points`` (of the raced cloud), ``paper_points``, ``paper_s`` (printed), ``paper_variant_s``,
        ``ours_s``, ``pcl_s`` (NaN where that racer did not take part).

    Raises:
        FileError: the race is missing, damaged, or lacks a piece.
    """
    import pandas as pd

    raced = read_table(race, ("points", "median_s"), ("case", "racer")).set_index(["case", "racer"])
    printed = paper.table("peng2020_table1").set_index("workpiece")
    rows = []
    for piece in printed.index:
        if (piece, "grindvision") not in raced.index:
            raise FileError(f"{race}: no row of grindvision on the {piece}; run ./run bench --only groove")
        rows.append(
            {
                "piece": piece,
                "points": int(raced.loc[(piece, "grindvision"), "points"]),
                "paper_points": int(printed.loc[piece, "points"]),
                "paper_s": float(printed.loc[piece, "runtime_s"]),
                **{column: raced["median_s"].get((piece, racer)) for column, racer in _RACERS.items()},
            }
        )
    return pd.DataFrame(rows).astype(dict.fromkeys(_RACERS, float))
