"""The scoreboard's block in README.md: verdicts by class of evidence and headline numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from grindvision_book.machinery.blocks import replace_block
from grindvision_book.machinery.evidence import count_by_class
from grindvision_book.machinery.figures import markdown_table
from grindvision_book.machinery.places import ROOT

if TYPE_CHECKING:
    import pandas as pd

README = ROOT / "README.md"
FIRST, LAST = "<!-- scoreboard: written by `grindvision book` -->", "<!-- end of scoreboard -->"

HEADLINES = (
    ("table1 print", "mean of the printed absolute errors"),
    ("table3 print", "largest angle of printed normals off perpendicular to the path"),
    ("table4 print", "rms of one rigid motion between Tables 3 and 4"),
    ("fig05", "mean error after accurate calibration, Eq 18"),
    ("fig05", "mean error after accurate calibration"),
    ("table3", "printed points to the path of the boxes, largest"),
    ("table3", "path points to true ridge, mean, whole instrument"),
    ("fig09", "compound error of a path point, boxes"),
    ("fig09", "compound error of a path point"),
    ("peng_table2", "overlap on the line, method of the paper, radii 10/5/5"),
    ("peng_table2", "overlap on the line, ours"),
    ("peng_table2", "overlap on the cylinder, method of the paper, radii 10/5/5"),
    ("peng_table2", "overlap on the cylinder, ours"),
)


def scoreboard_block(table: pd.DataFrame) -> str:
    """Markdown of the block: how many numbers of each class have which verdict, and the headline rows."""
    rows = table.set_index(["item", "quantity"], drop=False).loc[list(HEADLINES)]
    shown = rows[["source", "quantity", "unit", "evidence", "paper", "rebuilt", "verdict", "chapter"]]
    return f"{FIRST}\n{markdown_table(count_by_class(table))}\n\nSome of them:\n\n{markdown_table(shown)}\n{LAST}"


def write_readme(table: pd.DataFrame, readme: Path = README) -> None:
    """Replace the scoreboard's block in the README.

    Raises:
        FileError: the README lacks the two marks between which the block stands.
    """
    replace_block(readme, scoreboard_block(table), FIRST, LAST)
