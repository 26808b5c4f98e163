"""Compares rebuilt figures and tables with the committed ones: the values in their CSV files, never pixels."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

RELATIVE = 1e-3
ABSOLUTE = 1e-3
_GENERATED = ("scoreboard", "answers_")
_RACES = "bench_"


def disagreements(rebuilt: Path, committed: Path) -> list[str]:
    """One line for everything in which two figure folders differ; empty when they agree.

    Numbers agree within 1e-3 of their size or 1e-3 absolute; columns ending in ``_s`` and answers in seconds are times
    and are not compared; texts must be equal. A figure has svg, png and csv (and a gif where it
    moves), a table csv and md. What ``./run bench`` makes, ``bench_...``, belongs to no chapter.
    """
    names = {
        folder: {path.name for path in folder.iterdir() if not path.name.startswith(_RACES)}
        for folder in (rebuilt, committed)
    }
    found = [f"{name}: committed, but no chapter makes it" for name in sorted(names[committed] - names[rebuilt])]
    found += [
        f"{name}: a chapter makes it, but it is not committed" for name in sorted(names[rebuilt] - names[committed])
    ]
    for stem in sorted({Path(name).stem for name in names[committed]}):
        suffixes = {Path(name).suffix for name in names[committed] if Path(name).stem == stem}
        if suffixes - {".gif"} not in ({".svg", ".png", ".csv"}, {".csv", ".md"}) and not stem.startswith(_GENERATED):
            found.append(f"{stem}: has {', '.join(sorted(suffixes))}; a figure has svg, png, csv, a table csv, md")
    for name in sorted(names[committed] & names[rebuilt]):
        if name.endswith(".csv"):
            found += [f"{name}: {line}" for line in _different_values(_read(rebuilt / name), _read(committed / name))]
    return found


def _read(path: Path) -> pd.DataFrame:
    """A CSV as text, without the rows that are times of a run."""
    import pandas as pd

    table = pd.read_csv(path, dtype=str, keep_default_na=False)
    if path.stem.startswith(_GENERATED):
        from grindvision.paper import expected

        rows = expected()
        times = set(rows.loc[rows["unit"] == "s", ["item", "quantity"]].itertuples(index=False, name=None))
        kept = [key not in times for key in zip(table["item"], table["quantity"], strict=True)]
        table = table[kept].reset_index(drop=True)
    return table


def _different_values(rebuilt: pd.DataFrame, committed: pd.DataFrame) -> list[str]:
    import numpy as np
    import pandas as pd

    if list(rebuilt.columns) != list(committed.columns):
        return [f"columns {', '.join(rebuilt.columns)}; committed {', '.join(committed.columns)}"]
    if len(rebuilt) != len(committed):
        return [f"{len(rebuilt)} rows; committed {len(committed)}"]
    found = []
    for column in (column for column in committed.columns if not column.endswith("_s")):
        now, then = rebuilt[column], committed[column]
        numbers = [pd.to_numeric(values, errors="coerce").to_numpy(dtype=float) for values in (now, then)]
        close = np.isclose(*numbers, rtol=RELATIVE, atol=ABSOLUTE)
        bad = ~(close | (now == then).to_numpy())
        if bad.any():
            row = int(bad.argmax())
            found.append(
                f"column {column}: {bad.sum()} values differ, first {now[row]} (committed {then[row]}), row {row + 1}"
            )
    return found
