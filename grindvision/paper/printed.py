"""Loads what the two papers print, from ``data/paper``; every table is checked on the way in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from grindvision.data_files import data_folder
from grindvision.errors import FileError, InputError
from grindvision.files import read_table
from grindvision.geometry import orthonormalised, rigid

Floats = NDArray[np.float64]

#: Numeric columns of each printed table; the first column of every file names its row.
TABLES = {
    "diao2018_table1": ("position", ("measured_height_mm", "absolute_error_mm")),
    "diao2018_table2": (
        "joint",
        ("delta_alpha_deg", "delta_a_mm", "delta_d_mm", "delta_theta_deg", "delta_beta_deg"),
    ),
    "diao2018_table3": ("point", ("x_mm", "y_mm", "z_mm", "nx", "ny", "nz")),
    "diao2018_table4": ("point", ("x_mm", "y_mm", "z_mm", "nx_rad", "ny_rad", "nz_rad")),
    "peng2020_table1": ("workpiece", ("points", "runtime_s")),
    "peng2020_table2": ("workpiece", (*(f"test{i}_percent" for i in range(1, 6)), "mean_percent")),
}


#: Classes of evidence for a number of ``expected.csv``, strongest use of the print first.
EVIDENCE = (
    "print alone",
    "paper's method on a twin",
    "ours on a twin",
    "recovers a planted truth",
    "follows from the print by construction",
    "measured",
    "own bound",
    "not comparable",
)

#: What a row claims of its value against the printed one, or against its bound.
CLAIMS = ("equal", "at most", "at least")


def table(name: str) -> pd.DataFrame:
    """One printed table by its key in ``TABLES``, with units in the column names, rows in print order.

    Raises:
        InputError: unknown name. FileError: the file is missing or damaged.
    """
    if name not in TABLES:
        raise InputError(f"no printed table {name!r}; there are {', '.join(TABLES)}")
    key, numbers = TABLES[name]
    return read_table(data_folder() / "paper" / f"{name}.csv", numbers, texts=(key,))


def mdh_corrections() -> Floats:
    """Table 2 of diao2018 as (4, 5) in the order and units of ``arm.PARAMETERS``: rad, mm, mm, rad, rad."""
    printed = table("diao2018_table2").iloc[:, 1:].to_numpy(dtype=float)
    return np.column_stack(
        [np.radians(printed[:, 0]), printed[:, 1], printed[:, 2], np.radians(printed[:, 3]), np.radians(printed[:, 4])]
    )


def hand_eye(matrix: str, as_printed: bool = False) -> Floats:
    """Printed transform T_joint4_scanner (4, 4), ``coarse`` or ``accurate``, mm; section 5.2 of diao2018.

    The print rounds to four digits, so the rotation is made orthonormal unless ``as_printed``.

    Raises:
        InputError: unknown matrix.
    """
    rows = read_table(data_folder() / "paper" / "diao2018_hand_eye.csv", ("x", "y", "z", "translation_mm"), ("matrix",))
    chosen = rows[rows["matrix"] == matrix]
    if len(chosen) != 3:
        raise InputError(f"no printed hand-eye matrix {matrix!r}; there are {', '.join(rows['matrix'].unique())}")
    transform = rigid(chosen[["x", "y", "z"]].to_numpy(), chosen["translation_mm"].to_numpy())
    return transform if as_printed else orthonormalised(transform)


def headline(quantity: str) -> float:
    """One number that the running text of diao2018 states, by its name in ``diao2018_headline.csv``.

    Raises:
        InputError: unknown quantity; the message lists those there are.
    """
    rows = read_table(data_folder() / "paper" / "diao2018_headline.csv", ("value",), ("quantity", "unit"))
    known = dict(zip(rows["quantity"], rows["value"], strict=True))
    if quantity not in known:
        raise InputError(f"no headline number {quantity!r}; there are {', '.join(known)}")
    return float(known[quantity])


def path_points(table_number: int) -> tuple[Floats, Floats]:
    """Six path points (6, 3) in mm and the six printed normals (6, 3): Table 3 (scanner frame) or 4 (base frame).

    The normals are returned as printed: those of Table 4 are no unit vectors.
    """
    values = table(f"diao2018_table{table_number}").iloc[:, 1:].to_numpy(dtype=float)
    return values[:, :3], values[:, 3:]


def expected() -> pd.DataFrame:
    """Every number that the book answers to, from ``expected.csv``: printed value, class of evidence, bound and reason.

    ``paper`` is NaN where nothing is printed; the tolerance then is the bound of the rebuilt value itself. ``nominal``
    is what a drawing says, NaN where none does.

    Raises:
        FileError: missing or damaged, or two rows with the same item and quantity.
    """
    path = data_folder() / "paper" / "expected.csv"
    texts = ("item", "quantity", "unit", "evidence", "claim", "paper", "nominal", "source", "chapter", "reason")
    rows = read_table(path, ("tolerance", "tolerance_fast"), texts)
    rows["chapter"] = rows["chapter"].astype(int).map("{:02d}".format)
    for column in ("paper", "nominal"):
        numbers = pd.to_numeric(rows[column], errors="coerce")
        _refuse(path, rows, rows[column].notna() & numbers.isna(), column, "is not a number")
        rows[column] = numbers.astype(float)
    for column, known in (("evidence", EVIDENCE), ("claim", CLAIMS)):
        _refuse(path, rows, ~rows[column].isin(known), column, f"is none of {', '.join(known)}")
    _refuse(path, rows, (rows["claim"] == "equal") & rows["paper"].isna(), "claim", "needs a printed value")
    twice = rows.duplicated(["item", "quantity"])
    if twice.any():
        row = int(twice.to_numpy().argmax())
        raise FileError(f"{path}: row {row + 1} repeats {rows['item'].iloc[row]} / {rows['quantity'].iloc[row]}")
    return rows


def _refuse(path: Path, rows: pd.DataFrame, bad: pd.Series, column: str, complaint: str) -> None:
    if bad.any():
        row = int(bad.to_numpy().argmax())
        raise FileError(
            f"{path}: row {row + 1}, column {column}: {rows[column].iloc[row]!r} {complaint}; mend the file"
        )
