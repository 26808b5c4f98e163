"""Answers of the chapters, and the scoreboard that judges them against ``expected.csv``."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.errors import FileError, InputError
from grindvision.files import read_table, write_text
from grindvision_book.machinery.blocks import write_changed
from grindvision_book.machinery.figures import csv_text, markdown_table
from grindvision_book.machinery.places import figures_folder, finished_folder
from grindvision_book.machinery.session import current_chapter, fast, given_answers

if TYPE_CHECKING:
    import pandas as pd

KINDS = ("printed", "synthetic", "measured")
VERDICTS = ("reproduced", "better", "not reproduced", "not yet")
COLUMNS = [
    "item", "source", "quantity", "unit", "paper", "rebuilt", "difference", "tolerance", "verdict", "kind", "chapter",
    "figure",
]  # fmt: skip


def answer(item: str, quantity: str, value: float, kind: str, figure: str = "") -> None:
    """Give the rebuilt number of one row of ``expected.csv``; a second answer replaces the first.

    Args:
        item, quantity: name the row.
        value: in the row's unit.
        kind: what it was computed from: ``printed``, ``synthetic`` or ``measured``.
        figure: name of the figure or table that shows it.

    Raises:
        InputError: no such row (near names are listed), another chapter's row, unknown kind, no finite number.
    """
    import pandas as pd

    from grindvision.paper import expected

    chapter = current_chapter()
    rows = expected()
    row = rows[(rows["item"] == item) & (rows["quantity"] == quantity)]
    if row.empty:
        names = [f"{a} / {b}" for a, b in zip(rows["item"], rows["quantity"], strict=True)]
        near = difflib.get_close_matches(f"{item} / {quantity}", names, n=3, cutoff=0.3)
        raise InputError(f"expected.csv has no row {item} / {quantity}; near names: {', '.join(near) or 'none'}")
    if row["chapter"].iloc[0] != chapter:
        raise InputError(f"{item} / {quantity} is answered by chapter {row['chapter'].iloc[0]}, not by {chapter}")
    if kind not in KINDS:
        raise InputError(f"{item} / {quantity}: kind {kind!r} is none of {', '.join(KINDS)}")
    value = float(value)
    if not abs(value) < float("inf"):
        raise InputError(f"{item} / {quantity}: the rebuilt value {value} is no finite number")
    answers = given_answers()
    answers[item, quantity] = {
        "item": item,
        "quantity": quantity,
        "rebuilt": value,
        "kind": kind,
        "figure": figure,
        "settings": "fast" if fast() else "full",
    }
    write_text(figures_folder() / f"answers_{chapter}.csv", csv_text(pd.DataFrame(answers.values())))


def verdicts() -> pd.DataFrame:
    """This chapter's rows: item, quantity, unit, paper, rebuilt, difference, tolerance, verdict."""
    import pandas as pd

    table = judged(pd.DataFrame(given_answers().values(), columns=list(_ANSWER_COLUMNS)))
    mine = table[table["chapter"] == current_chapter()].reset_index(drop=True)
    return mine[["item", "quantity", "unit", "paper", "rebuilt", "difference", "tolerance", "verdict"]]


def scoreboard(folder: Path | None = None) -> pd.DataFrame:
    """One row for every row of ``expected.csv``, judged by the answers of finished chapters.

    Args:
        folder: where the ``answers_NN.csv`` lie; by default the finished figures.

    Raises:
        FileError: an answers file is damaged.
    """
    import pandas as pd

    folder = folder or finished_folder()
    found = [_read_answers(path) for path in sorted(folder.glob("answers_[0-9][0-9].csv"))]
    return judged(pd.concat(found, ignore_index=True) if found else pd.DataFrame(columns=list(_ANSWER_COLUMNS)))


def write_scoreboard(folder: Path) -> pd.DataFrame:
    """Judge the answers in ``folder``, write ``scoreboard.csv`` and ``scoreboard.md`` there, and return the table."""
    table = scoreboard(folder)
    write_changed(folder / "scoreboard.csv", csv_text(table))
    shown = table.assign(
        figure=[f"[{name}]({name}.{_suffix(folder, name)})" if name else "" for name in table["figure"]]
    )
    write_changed(folder / "scoreboard.md", f"# Scoreboard\n\n{summary(table)}.\n\n{markdown_table(shown)}\n")
    return table


def summary(table: pd.DataFrame) -> str:
    """How many numbers of a scoreboard have which verdict, in one line."""
    counts = ", ".join(f"{(table['verdict'] == word).sum()} {word}" for word in VERDICTS)
    return f"{len(table)} numbers: {counts}"


def judged(answers: pd.DataFrame) -> pd.DataFrame:
    """Rows of ``expected.csv`` joined with answers (columns of ``answers_NN.csv``) and judged; columns ``COLUMNS``."""
    from grindvision.paper import expected

    table = expected().merge(answers, on=["item", "quantity"], how="left")
    table["tolerance"] = table["tolerance"].where(table["settings"] != "fast", table["tolerance_fast"])
    table["rebuilt"] = table["rebuilt"].astype(float)
    table["difference"] = table["rebuilt"] - table["paper"]
    table["verdict"] = [
        verdict(row.rebuilt, row.paper, row.tolerance, row.better) for row in table.itertuples(index=False)
    ]
    for column in ("kind", "figure"):
        table[column] = table[column].astype(object).where(table[column].notna(), "")
    return table[COLUMNS]


def verdict(rebuilt: float, paper: float, tolerance: float, better: str = "") -> str:
    """The word for one rebuilt number.

    Args:
        rebuilt: NaN when no chapter has answered.
        paper: NaN when the paper states none; the tolerance then bounds the rebuilt value itself.
        tolerance: largest absolute difference that counts as the same.
        better: ``lower`` or ``higher`` when a value beyond the tolerance on that side is an improvement, else empty.
    """
    if rebuilt != rebuilt:
        return "not yet"
    difference = rebuilt if paper != paper else rebuilt - paper
    if abs(difference) <= tolerance:
        return "reproduced"
    good = {"lower": difference < 0, "higher": difference > 0}.get(better, False)
    return "better" if good else "not reproduced"


_ANSWER_COLUMNS = ("item", "quantity", "rebuilt", "kind", "figure", "settings")


def _read_answers(path: Path) -> pd.DataFrame:
    answers = read_table(path, ("rebuilt",), ("item", "quantity", "kind", "figure", "settings"))
    if answers.duplicated(["item", "quantity"]).any():
        raise FileError(f"{path}: an answer stands twice; rebuild the chapter with `grindvision book`")
    return answers[list(_ANSWER_COLUMNS)]


def _suffix(folder: Path, name: str) -> str:
    return "svg" if (folder / f"{name}.svg").exists() else "md"
