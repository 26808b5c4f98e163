"""Text tables of points: XYZ, ASC, TXT, PTS, CSV; with or without a header, parted by blanks, commas, semicolons, tabs.

A comma may part the columns or stand for the decimal point; where a file leaves that open it is refused.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import BinaryIO

from grindvision.errors import FileError
from grindvision.formats.content import Content
from grindvision.formats.records import MEMORY_PER_TEXT_BYTE, content_of_rows, numbers, refuse_binary
from grindvision.input_files import read_rest

COMMENTS = ("#", "//", "%")
MAX_HEADER_LINES = 50

#: So many rows tell how a table is written.
SAMPLE = 20

#: A column's name as exporters write it: x, "X", x_mm, x [mm], X/m, Nx, normal_x; ParaView counts: Points:0.
AXIS = re.compile(r"(n?[xyz]|normal_[xyz])(?:[ _/\[(]*(mm|cm|m|in)[\])]?)?")
PARAVIEW = {"points:0": "x", "points:1": "y", "points:2": "z", "normals:0": "nx", "normals:1": "ny", "normals:2": "nz"}


def read_table(path: Path, file: BinaryIO) -> Content:
    """Read a text table: x y z by the header's names, or the first three columns where no header names them.

    Raises:
        FileError: no text, no points, text among the numbers, ragged rows, a comma that could mean two things, or
            named columns without x y z.
    """
    refuse_binary(path, file)
    text = read_rest(path, file, MEMORY_PER_TEXT_BYTE).decode("utf-8-sig", errors="replace")
    lines = [line for line in map(str.strip, text.splitlines()) if line]
    title = ""
    begin = 0
    while begin < len(lines) and not _is_number(lines[begin]):
        title = lines[begin]
        begin += 1
        if begin > MAX_HEADER_LINES:
            raise FileError(f"{path}: no numbers in the first {begin} lines; is it a table of x y z?")
    rows = [line for line in lines[begin:] if not line.startswith(COMMENTS)]
    if len(rows) > 1 and rows[0].isdigit() and not rows[1].isdigit():
        rows = rows[1:]  # PTS files begin with the number of points
    return _content(path, rows, title)


def _content(path: Path, rows: list[str], title: str) -> Content:
    separator, decimal_comma = punctuation(rows[:SAMPLE])
    columns = len(_split(rows[0], separator)) if rows else 0
    names, unit = _names(path, title, separator, columns)
    if separator == "," and not names and columns >= 6 and not any("." in row for row in rows):
        raise FileError(
            f"{path}: {rows[0][:40]!r}: the commas may part columns or stand for decimal points; write points, or name"
            " the columns in a first line"
        )
    if decimal_comma:
        rows = [row.replace(",", ".") for row in rows]
    if separator is not None:
        rows = [row.removesuffix(separator) for row in rows]
    table = numbers(path, rows, separator)
    note = "commas were read as decimal points" if decimal_comma else ""
    if not names:
        names = ["x", "y", "z"]
    found = content_of_rows(path, table, names)
    return Content(found.points, found.normals, None, unit, note)


def punctuation(rows: list[str]) -> tuple[str | None, bool]:
    """What parts the columns of rows of numbers (None: blanks), and whether a comma is the decimal point."""
    for separator in (";", "\t"):
        if any(separator in row for row in rows):
            return separator, any("," in row for row in rows)
    if not any("," in row for row in rows):
        return None, False
    words = [word for row in rows for word in row.split()]
    blank_parted = len(words) >= 3 * len(rows) and all(word.count(",") <= 1 and word[-1] != "," for word in words)
    return (None, True) if blank_parted else (",", False)


def _names(path: Path, title: str, separator: str | None, columns: int) -> tuple[list[str], str | None]:
    """Names of the columns as the last line before the numbers has them, and the unit it says; none where it is none.

    Blanks may stand within a name where something else parts the columns.
    """
    bare = title
    for mark in COMMENTS:
        bare = bare.removeprefix(mark)
    words = [word.strip().strip("\"'").lower() for word in _split(bare.strip(), separator)]
    names, units = [], set()
    for word in words:
        axis = AXIS.fullmatch(word)
        names.append(axis[1] if axis else PARAVIEW.get(word, word))
        if axis and axis[2] and axis[1] in "xyz":
            units.add(axis[2])
    if len(names) == columns and {"x", "y", "z"} <= set(names):
        if len(units) > 1:
            raise FileError(f"{path}: x, y and z are named in different units; export it in one unit")
        return names, next(iter(units), None)
    if len(names) == columns and separator is not None and title == bare:
        raise FileError(f"{path}: columns {', '.join(words)[:80]}; none are named x, y, z: rename them")
    return [], None


def _split(line: str, separator: str | None) -> list[str]:
    words = line.split(separator)
    return words[:-1] if separator is not None and words[-1] == "" else words


def _is_number(line: str) -> bool:
    """Whether a line begins with a number."""
    try:
        float(re.split(r"[\s,;]", line.lstrip("\"'"), maxsplit=1)[0].strip("\"'"))
    except ValueError:
        return False
    return True
