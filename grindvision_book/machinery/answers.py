"""Answers of the chapters, and the scoreboard that judges them against ``expected.csv`` by class of evidence."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.errors import FileError, InputError
from grindvision.files import read_table, write_text
from grindvision.paper import EVIDENCE, expected
from grindvision_book.machinery.blocks import write_changed
from grindvision_book.machinery.bound_dates import ORDERS, bounds_by_row
from grindvision_book.machinery.evidence import VERDICTS, count_by_class, trivial_answers_pass, verdict
from grindvision_book.machinery.figures import csv_text, markdown_table
from grindvision_book.machinery.places import figures_folder, finished_folder
from grindvision_book.machinery.session import current_chapter, fast, given_answers

if TYPE_CHECKING:
    import pandas as pd

#: What a number was computed from: *timed* by a clock here; *assumed*: printed numbers and lengths that are not.
KINDS = ("printed", "synthetic", "measured", "timed", "assumed")
COLUMNS = [
    "item", "source", "quantity", "unit", "evidence", "paper", "rebuilt", "difference", "claim", "tolerance", "verdict",
    "trivial answer passes", "bound written", "bound changed", "bound order", "kind", "chapter", "figure",
]  # fmt: skip


def answer(item: str, quantity: str, value: float, kind: str, figure: str = "") -> None:
    """Give the rebuilt number of one row of ``expected.csv``; a second answer replaces the first.

    Args:
        item, quantity: name the row.
        value: in the row's unit.
        kind: what it was computed from, one of ``KINDS``.
        figure: name of the figure or table that shows it.

    Raises:
        InputError: no such row (near names are listed), another chapter's row, unknown kind, no finite number.
    """
    import pandas as pd

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
    """This chapter's rows: item, quantity, unit, evidence, paper, rebuilt, claim, tolerance, trivial, verdict."""
    import pandas as pd

    table = judged(pd.DataFrame(given_answers().values(), columns=list(_ANSWER_COLUMNS)))
    mine = table[table["chapter"] == current_chapter()].reset_index(drop=True)
    shown = ["item", "quantity", "unit", "evidence", "paper", "rebuilt", "claim", "tolerance", "verdict"]
    return mine[[*shown, "trivial answer passes"]]


def missed() -> list[str]:
    """Quantities of this chapter that are not reproduced, or outside their bound, in the order of ``expected.csv``."""
    rows = verdicts()
    return rows.loc[rows["verdict"].isin(["not reproduced", "outside its bound"]), "quantity"].tolist()


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
    write_changed(folder / "scoreboard.md", scoreboard_page(table, folder))
    return table


def scoreboard_page(table: pd.DataFrame, folder: Path) -> str:
    """The scoreboard in Markdown: counts by class of evidence, then each class's rows; figures lie in ``folder``."""
    shown = table.assign(
        bound=[bound_text(row) for row in table.itertuples(index=False)],
        dated=[
            written if order in ("", ORDERS[0]) else f"{written}, {order}"
            for written, order in zip(table["bound written"], table["bound order"], strict=True)
        ],
        figure=[f"[{name}]({name}.{_suffix(folder, name)})" if name else "" for name in table["figure"]],
    )
    columns = {name: name for name in ("item", "quantity", "unit", "paper", "rebuilt", "bound", "verdict")}
    columns |= {"trivial answer passes": "trivial passes", "dated": "bound written"}
    columns |= {name: name for name in ("kind", "chapter", "figure", "source")}
    shown = shown[["evidence", *columns]].set_axis(["evidence", *columns.values()], axis=1)
    parts = ["# Scoreboard", f"{summary(table)}.", markdown_table(count_by_class(table)), _LEGEND]
    for name in EVIDENCE:
        rows = shown[shown["evidence"] == name].drop(columns="evidence")
        if len(rows):
            parts += [f"## {name[0].upper()}{name[1:]}", markdown_table(rows)]
    return "\n\n".join(parts) + "\n"


def summary(table: pd.DataFrame) -> str:
    """How many numbers of a scoreboard have which verdict, in one line."""
    counts = ", ".join(f"{(table['verdict'] == word).sum()} {word}" for word in VERDICTS)
    return f"{len(table)} numbers: {counts}"


def judged(answers: pd.DataFrame) -> pd.DataFrame:
    """Rows of ``expected.csv`` joined with answers (columns of ``answers_NN.csv``) and judged; columns ``COLUMNS``."""
    rows = expected()
    table = rows.assign(**{"trivial answer passes": trivial_answers_pass(rows)})
    for more in (answers, bounds_by_row()):
        table = table.merge(more, on=["item", "quantity"], how="left")
    table["tolerance"] = table["tolerance"].where(table["settings"] != "fast", table["tolerance_fast"])
    table["rebuilt"] = table["rebuilt"].astype(float)
    table["difference"] = table["rebuilt"] - table["paper"]
    table["verdict"] = [
        verdict(*row)
        for row in table[["rebuilt", "paper", "tolerance", "claim", "evidence", "trivial answer passes"]].itertuples(
            index=False, name=None
        )
    ]
    for column in ("kind", "figure", "bound written", "bound changed", "bound order"):
        table[column] = table[column].astype(object).where(table[column].notna(), "")
    return table[COLUMNS]


_LEGEND = """*Reproduced* and *not reproduced* are said only of a printed value that could have been refuted,
*recovered* of a truth that was planted in the twin; both only where no trivial answer (0, the nominal value, the mean
of the print) would pass as well. Everything else keeps its bound or does not. Each bound has the date (UTC) of the
commit that wrote it; one that was written or changed with or after a result says so."""


def bound_text(row: Any) -> str:
    """What a row of the scoreboard (as a named tuple) is held to, in words; empty where nothing can be."""
    if row.evidence == "not comparable":
        return ""
    if row.claim == "equal":
        return f"\u00b1 {row.tolerance:g}"
    printed = 0.0 if row.paper != row.paper else row.paper
    slack = -row.tolerance if row.claim == "at least" and printed else row.tolerance
    return f"{row.claim} {printed + slack:g}"


_ANSWER_COLUMNS = ("item", "quantity", "rebuilt", "kind", "figure", "settings")


def _read_answers(path: Path) -> pd.DataFrame:
    answers = read_table(path, ("rebuilt",), ("item", "quantity", "kind", "figure", "settings"))
    if answers.duplicated(["item", "quantity"]).any():
        raise FileError(f"{path}: an answer stands twice; rebuild the chapter with `grindvision book`")
    return answers[list(_ANSWER_COLUMNS)]


def _suffix(folder: Path, name: str) -> str:
    return "svg" if (folder / f"{name}.svg").exists() else "md"
