"""What PLY and PCD share: a text header, then a table of numbers as text or as binary records of one size."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import FileError
from grindvision.formats.content import Content, chosen_columns
from grindvision.input_files import bytes_left, check_memory, read_rest
from grindvision.words import counted

Floats = NDArray[np.float64]

MAX_HEADER_LINES, LONGEST_HEADER_LINE = 1000, 10_000

#: A line of 30 bytes takes 190 while its numbers are read: twice the text, a Python string, three floats.
MEMORY_PER_TEXT_BYTE = 7.0

RECORDS_AT_ONCE = 1 << 16
"""So many records are held twice, as they stand in the file and as numbers; never the whole file."""


def header_lines(path: Path, file: BinaryIO, last: bytes) -> Iterator[list[str]]:
    """Words of each header line up to and including the one that begins with ``last``.

    Raises:
        FileError: there is no such line.
    """
    for _ in range(MAX_HEADER_LINES):
        line = file.readline(LONGEST_HEADER_LINE)
        words = line.decode("latin-1").split()
        if words:
            yield words
        if not line or line.startswith(last):
            break
    if not line.startswith(last):
        raise FileError(f"{path}: the header has no {last.decode()} line; the file is cut short or damaged")


def count_in_header(path: Path, word: str) -> int:
    """A number of things as a header says it.

    Raises:
        FileError: no plain whole number, or more than any file holds.
    """
    if not re.fullmatch(r"[0-9]{1,18}", word):
        raise FileError(f"{path}: {word[:40]!r} in the header is no count; the file is damaged, export it again")
    return int(word)


def refuse_binary(path: Path, file: BinaryIO) -> None:
    """Refuse a file that begins with bytes that no text holds; the place in the file stays.

    Raises:
        FileError: so it is.
    """
    begin = file.read(10_000)
    file.seek(-len(begin), 1)
    if b"\0" in begin:
        raise FileError(f"{path}: not a plain text table of x y z; save it as UTF-8 text")


def text_lines(path: Path, file: BinaryIO, count: int, columns: int, what: str = "points") -> list[str]:
    """The next ``count`` lines of a text table of so many ``columns``; the file is then read up to their end.

    Raises:
        FileError: the file is too short for what its header announces.
    """
    start, left = file.tell(), bytes_left(file)
    if 2 * columns * count > left + 1:
        raise too_short(path, count, f"the file holds {left} bytes", what)
    lines: list[str] = []
    read = 0
    for line in read_rest(path, file, MEMORY_PER_TEXT_BYTE).decode("latin-1").splitlines(keepends=True):
        if len(lines) == count:
            break
        read += len(line)
        if line.strip():
            lines.append(line)
    if len(lines) < count:
        raise too_short(path, count, f"the file holds {len(lines)}", what)
    file.seek(start + read)
    return lines


def numbers(path: Path, lines: Sequence[str], separator: str | None = None) -> Floats:
    """A table (rows, columns) from lines of numbers, parted by blanks or by ``separator``.

    Raises:
        FileError: no lines, text among the numbers, or rows of different length.
    """
    if not lines:
        raise FileError(f"{path}: no points in the file; export the cloud again")
    try:
        table = np.loadtxt(lines, ndmin=2, comments=None, delimiter=separator, quotechar='"')
    except ValueError as error:
        raise FileError(f"{path}: {_reason(error)}; mend the line or export the cloud again") from None
    if len(table) != len(lines):
        raise FileError(
            f"{path}: {counted(len(lines) - len(table), 'row holds', 'rows hold')} no numbers; export the cloud again"
        )
    return table


def content_of_rows(path: Path, rows: Floats, names: Sequence[str]) -> Content:
    """Points and normals among the named columns of a table.

    Raises:
        FileError: no x y z, or fewer columns than names.
    """
    point, normal = chosen_columns(names)
    if rows.shape[1] < 3 or point is None:
        raise FileError(f"{path}: points need x y z; found {rows.shape[1]} columns {' '.join(names)}")
    if rows.shape[1] < len(names):
        raise FileError(f"{path}: rows have {rows.shape[1]} columns, the header names {len(names)}; export it again")
    normals = None if normal is None else np.ascontiguousarray(rows[:, normal])
    return Content(np.ascontiguousarray(rows[:, point]), normals)


def content_of_records(path: Path, file: BinaryIO, count: int, names: Sequence[str], kinds: Sequence[str]) -> Content:
    """Points and normals of ``count`` binary records; only the columns asked for are converted.

    Raises:
        FileError: no x y z, or the file is too short.
    """
    record = np.dtype([(f"{at}", kind) for at, kind in enumerate(kinds)])
    left = bytes_left(file)
    if count * record.itemsize > left:
        raise too_short(path, count, f"{record.itemsize} bytes each, the file holds {left} bytes")
    point, normal = chosen_columns(names)
    if point is None:
        raise FileError(f"{path}: points need x y z; found {' '.join(names)}")
    check_memory(path, 2 * 24 * count * (1 if normal is None else 2))
    points = np.empty((count, len(point)))
    normals = None if normal is None else np.empty((count, len(normal)))
    for start in range(0, count, RECORDS_AT_ONCE):
        rows = np.fromfile(file, dtype=record, count=min(RECORDS_AT_ONCE, count - start))
        for columns, table in ((point, points), (normal, normals)):
            if columns is not None and table is not None:
                for k, at in enumerate(columns):
                    table[start : start + len(rows), k] = rows[f"{at}"]
    return Content(points, normals)


def too_short(path: Path, count: int, found: str, what: str = "points") -> FileError:
    """The error of a file whose header announces more than it holds."""
    return FileError(f"{path}: the header announces {count} {what}, {found}; it is cut short or damaged")


def _reason(error: ValueError) -> str:
    """What NumPy could not read, rows counted from 1 below the header."""
    text = " ".join(str(error).split())
    word = re.search(r"could not convert string (.*) to float64 at row (\d+)", text)
    if word:
        return f"row {int(word[2]) + 1}: {word[1]} is no number"
    width = re.search(r"number of columns changed from (\d+) to (\d+) at row (\d+)", text)
    if width:
        return f"row {width[3]} has {width[2]} columns, the rows before {width[1]}"
    return f"not a table of numbers ({text})"
