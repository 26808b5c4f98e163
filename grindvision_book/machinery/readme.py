"""The scoreboard's block in README.md: headline numbers and a count of the verdicts, written from the scoreboard."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from grindvision_book.machinery.answers import summary
from grindvision_book.machinery.blocks import replace_block
from grindvision_book.machinery.figures import markdown_table
from grindvision_book.machinery.places import ROOT

if TYPE_CHECKING:
    import pandas as pd

README = ROOT / "README.md"
FIRST, LAST = "<!-- scoreboard: written by `grindvision book` -->", "<!-- end of scoreboard -->"

HEADLINES = (
    ("table1", "mean absolute error"),
    ("fig05", "mean error after accurate calibration"),
    ("fig05", "largest error after accurate calibration"),
    ("hand-eye", "calibrated against true cell, mean"),
    ("calibration rank", "unknowns that can be known"),
    ("table3", "path points to true ridge, mean, undistorted scanner"),
    ("table3 print", "largest angle of printed normals off perpendicular to the path"),
    ("table4 print", "rms of one rigid motion between Tables 3 and 4"),
    ("fig09", "compound error of a path point"),
    ("peng_table2", "overlap on the line, ours"),
    ("peng_table2", "overlap on the curve, ours"),
    ("peng_table2", "overlap on the box, ours"),
    ("peng_table2", "overlap on the cylinder, ours"),
)


def scoreboard_block(table: pd.DataFrame) -> str:
    """Markdown of the block: the headline rows of a scoreboard, and how many numbers have which verdict."""
    rows = table.set_index(["item", "quantity"], drop=False).loc[list(HEADLINES)]
    shown = rows[["source", "quantity", "unit", "paper", "rebuilt", "verdict", "kind", "chapter"]]
    return f"{FIRST}\n{markdown_table(shown)}\n\nIn all: {summary(table)}.\n{LAST}"


def write_readme(table: pd.DataFrame, readme: Path = README) -> None:
    """Replace the scoreboard's block in the README.

    Raises:
        FileError: the README lacks the two marks between which the block stands.
    """
    replace_block(readme, scoreboard_block(table), FIRST, LAST)
