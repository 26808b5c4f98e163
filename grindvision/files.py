"""Reading tables that are checked at the door, and writing files whole or not at all."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.errors import FileError
from grindvision.input_files import open_input, read_input

if TYPE_CHECKING:
    import pandas as pd

#: Units a column's name may end in besides ours: the other's name and what one of it is in ours.
UNITS = {"rad": ("deg", math.pi / 180), "mm": ("m", 1000.0)}
#: Bytes of files that people write: settings, poses; tables of measurements.
LARGEST_SETTINGS, LARGEST_TABLE = 1_000_000, 200_000_000
#: Columns that a table of measurements may have: more are no columns, and would be looked at one by one.
MAX_COLUMNS = 10_000

#: How the name of a file that is being written begins.
UNFINISHED = ".grindvision-"


@contextmanager
def write_whole(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` when the block succeeds, remove it when not.

    The temporary name keeps the suffix, so writers that look at it (images, clouds) work unchanged.

    Raises:
        FileError: the folder cannot be made or written to.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f"{UNFINISHED}{path.stem}-", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}; choose a folder you may write to") from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        raise FileError(
            f"cannot write {path}: {error.strerror or error}; free space or choose another folder"
        ) from None
    finally:
        temporary.unlink(missing_ok=True)


def writable_folder(path: str | Path) -> Path:
    """Return a folder that exists (made when it does not) and may be written to: ask before long work, not after.

    Raises:
        FileError: it cannot be made, is a file, or may not be written to.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return path
    except OSError as error:
        raise FileError(f"cannot write to {path}: {error.strerror}; choose a folder you may write to") from None


def write_text(path: str | Path, text: str) -> None:
    """Write ``text`` as UTF-8, whole or not at all.

    Bytes of a file's name that are no UTF-8 become ``\\udc80`` to ``\\udcff``, which JSON reads back as the same name.
    """
    with write_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: str | Path, content: Any) -> None:
    """Write ``content`` as indented JSON; NumPy scalars and arrays become numbers and lists, NaN becomes null."""
    write_text(path, json.dumps(plain(content), indent=2, ensure_ascii=False) + "\n")


def plain(value: Any) -> Any:
    """Content that JSON can hold: NumPy scalars and arrays become numbers and lists, NaN becomes None."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and value - value != 0:
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def sha256(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes.

    Raises:
        FileError: see ``open_input``.
    """
    with open_input(path) as file:
        digest = hashlib.sha256()
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def read_table(
    path: str | Path, numbers: Sequence[str], texts: Sequence[str] = (), columns: Mapping[str, str] | None = None
) -> pd.DataFrame:
    """Read a CSV whose named columns must be there, and whose ``numbers`` columns must be finite floats.

    Commas, semicolons, tabs or, where the first line has none of these, blanks part the columns; where it is not the
    comma, numbers may have a decimal comma. Lines that begin with # are passed over. A column
    ``q_rad`` or ``x_mm`` may stand in the file as ``q_deg`` or ``x_m``; it is converted. Further columns are kept.

    Args:
        path: file.
        numbers: names of the columns of numbers.
        texts: names of the columns of text.
        columns: our name (unit included) of columns that the file calls otherwise; names joined by ``+`` and ``-``
            are added and subtracted.

    Raises:
        FileError: the file is missing, is no CSV, lacks a column or has it twice, has no row, or holds text or NaN
            where a number belongs; the message names file, row and column.
    """
    path = Path(path)
    given = _text_table(path)
    table = given.copy()
    for ours, theirs in (columns or {}).items():  # from the file's own columns, whatever another name was given before
        parts = _summands(theirs, given.columns)
        missing = [part for _, part in parts if part not in given.columns]
        if missing:
            raise FileError(f"{path}: column {missing[0]} missing; found {_listed(given.columns)}")
        if len(parts) == 1 and parts[0][0] > 0:
            table[ours] = given[parts[0][1]]
        else:
            table[ours] = sum(sign * _floats(path, given, part) for sign, part in parts)
        stem, _, unit = ours.rpartition("_")  # what was named goes before the file's own column in the unit used here
        own = next((f"{stem}_{one}" for one, (other, _) in UNITS.items() if other == unit), None)
        if own in table.columns and own not in (columns or {}):
            table = table.drop(columns=own)
    missing = []
    for name in (*texts, *numbers):
        stem, _, unit = name.rpartition("_")
        other, factor = UNITS.get(unit, ("", 1.0))
        if name not in table.columns and name in numbers and f"{stem}_{other}" in table.columns:
            table[name] = _floats(path, table, f"{stem}_{other}") * factor
        elif name not in table.columns:
            missing.append(name)
        elif name in numbers:
            table[name] = _floats(path, table, name)
    if missing:
        units = " (_deg and _m at a name's end are converted)" if missing[0].endswith(tuple(UNITS)) else ""
        raise FileError(
            f"{path}: column {', '.join(missing)} missing; found {_listed(table.columns)}{units}; rename the columns"
        )
    return table


def _summands(text: str, columns: Iterable[str]) -> list[tuple[float, str]]:
    """Signs and column names of a sum like ``J3-J2``; a name of the table may itself hold these signs."""
    known = sorted(map(str, columns), key=len, reverse=True)
    parts: list[tuple[float, str]] = []
    rest, sign = text.strip(), 1.0
    while rest or not parts:
        if rest[:1] in ("+", "-") and not any(rest.startswith(name) for name in known):
            sign, rest = (-sign if rest[0] == "-" else sign), rest[1:].lstrip()
            continue
        ends = ("", "+", "-")
        name = next((n for n in known if rest.startswith(n) and rest[len(n) :].lstrip()[:1] in ends), None)
        if name is None:
            name = rest.split("+")[0].split("-")[0].strip() or rest
        parts.append((sign, name))
        rest, sign = rest[len(name) :].lstrip(), 1.0
    return parts


def column_names(path: str | Path) -> list[str]:
    """Names of a CSV's columns.

    Raises:
        FileError: the file is missing or is no CSV.
    """
    return list(_text_table(Path(path)).columns)


def read_json(path: str | Path) -> Any:
    """Content of a JSON file.

    Raises:
        FileError: missing, too large to be meant, or no JSON.
    """
    return _read_small(Path(path), lambda text: json.loads(text, parse_int=_number), "JSON")


def read_toml(path: str | Path) -> dict[str, Any]:
    """Content of a TOML file.

    Raises:
        FileError: missing, too large to be meant, or no TOML.
    """
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    return _read_small(Path(path), tomllib.loads, "TOML")


def _number(digits: str) -> int | float:
    """A whole number of a file; as a float, infinite at last, where it is longer than any that is meant."""
    return int(digits) if len(digits) < 20 else float(digits)


def _read_small(path: Path, parse: Callable[[str], Any], kind: str) -> Any:
    text = read_input(path, LARGEST_SETTINGS, kind)
    try:
        return parse(text.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:120]
        raise FileError(f"{path}: not a readable {kind} file ({reason}); mend it or write it again") from None


def _text_table(path: Path) -> pd.DataFrame:
    """A CSV as it stands, numbers where a whole column holds nothing else."""
    import pandas as pd

    data = read_input(path, LARGEST_TABLE, "CSV")
    try:
        lines = io.StringIO(data.decode("utf-8-sig"), newline="")
        head = next((line for line in lines if line.strip() and not line.startswith("#")), "")
        blank = " " if " " in head.strip() else ","
        separator = max((mark for mark in ",;\t" if mark in head), key=head.count, default=blank)
        first = csv.reader([head.strip(" \n")], delimiter=separator, skipinitialspace=True)
        names = [name.strip() for name in next(first, [])]
        if len(names) > MAX_COLUMNS:
            raise FileError(
                f"{path}: {len(names):,} columns; a table of this kind has a few, a row for each measurement"
            )
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(
                io.BytesIO(data),
                sep=r"\s+" if separator == " " else separator,
                decimal="." if separator == "," else ",",
                encoding="utf-8-sig",
                skipinitialspace=True,
                index_col=False,
                comment="#",
            )
    except pd.errors.ParserWarning:
        raise FileError(f"{path}: rows have more columns than the first line names; mend the file") from None
    except (ValueError, csv.Error, MemoryError, OverflowError) as error:
        raise FileError(f"{path}: not a readable CSV table ({' '.join(str(error).split())[:200]})") from None
    if pd.to_numeric(pd.Series(names, dtype=object), errors="coerce").notna().mean() > 0.5:
        raise FileError(f"{path}: the first line holds numbers; write the columns' names above it, without #")
    twice = sorted(name for name, times in Counter(names).items() if times > 1)
    if twice:
        raise FileError(f"{path}: column {twice[0]} stands in the first line {names.count(twice[0])} times; mend it")
    table.columns = [str(column).strip() for column in table.columns]
    if table.empty:
        raise FileError(f"{path}: the table has no rows")
    return table


def _floats(path: Path, table: pd.DataFrame, column: str) -> pd.Series:
    import pandas as pd

    values = pd.to_numeric(table[column], errors="coerce").astype(float)
    bad = ~values.abs().lt(float("inf"))
    if bad.any():
        row = int(bad.to_numpy().argmax())
        cell = table[column].iloc[row]
        shown = "an empty cell" if pd.isna(cell) else repr(str(cell)[:40])
        raise FileError(f"{path}: row {row + 1}, column {column}: {shown} is not a finite number; mend the file")
    return values


def _listed(names: Iterable[str], max_names: int = 16) -> str:
    names = list(names)
    return ", ".join(names[:max_names]) + (f" and {len(names) - max_names} more" if len(names) > max_names else "")
