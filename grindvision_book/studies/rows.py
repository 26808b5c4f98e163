"""The rows of a study, streamed to a CSV file that survives a crash at any byte."""

from __future__ import annotations

import csv
import fcntl
import glob
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from grindvision.errors import FileError, InputError
from grindvision.files import UNFINISHED, write_text
from grindvision.input_files import check_output_file, open_input

if TYPE_CHECKING:
    import pandas as pd

#: How every file of rows begins, and bytes in which its line of names ends.
BEGIN, LONGEST_HEADER = b"case,seed,code,", 100_000

#: Columns that every row has beside its parameters and results.
OWN_COLUMNS = ("case", "seed", "code", "error")


class BusyError(FileError):
    """Another run holds a file of results."""


class RowsFile:
    """One line per finished case, on disk as soon as ``append`` returns; a context that one run at a time may hold.

    ``stored`` holds the rows found on entering, as texts by case number. A last line that a crash tore is cut off,
    so its case counts as not finished.

    Raises:
        FileError: cannot be written, damaged before its last line, or held by another run.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.stored: dict[int, dict[str, str]] = {}
        self._header: list[str] = []
        self._file: IO[str]

    def __enter__(self) -> RowsFile:
        self._open()
        for left in self.path.parent.glob(f"{UNFINISHED}{glob.escape(self.path.stem)}-*{self.path.suffix}"):
            left.unlink(missing_ok=True)  # of a run that was killed while it sorted the rows
        try:
            self._load()
        except BaseException:
            self._file.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, row: Mapping[str, Any]) -> None:
        """Write one row: the own columns, parameters, and results unless ``error`` says why there are none.

        Raises:
            InputError: a row whose results are named otherwise than those before.
        """
        if not self._header:
            self._write_header(row)
        elif not row["error"] and set(row) != set(self._header):
            if len(row) < len(self._header) or not self._failures_only():
                names = ", ".join(sorted(set(row) ^ set(self._header)))
                raise InputError(
                    f"case {row['case']} gives other results than the cases before ({names}); name them alike"
                )
            self._write_header(row)
        self._file.write(_csv([[as_text(row.get(name, "")) for name in self._header]]))
        self._file.flush()

    def finish(self) -> pd.DataFrame:
        """Sort the file by case, and return its rows with numbers as numbers."""
        texts = self._texts()
        texts = texts.iloc[texts["case"].astype(int).argsort()].reset_index(drop=True)
        write_text(self.path, texts.to_csv(index=False, lineterminator="\n"))
        return texts.apply(lambda column: column if column.name in ("code", "error") else _from_text(column))

    def _open(self) -> None:
        check_output_file(self.path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self.path, "a", encoding="utf-8", newline="")  # noqa: SIM115
        except OSError as error:
            raise FileError(f"cannot write {self.path}: {error.strerror}; choose a folder you may write to") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise BusyError(f"{self.path}: another run is writing to this file; wait for it or stop it") from None

    def _load(self) -> None:
        with open_input(self.path) as file:
            first = file.read(LONGEST_HEADER)
            torn = first.startswith(BEGIN) or BEGIN.startswith(first)  # by a crash, in the line of names
            if not torn and b"\n" not in first:
                raise FileError(f"{self.path}: not a study's results; choose another file")
            whole = first + file.read()
        kept = whole[: whole.rfind(b"\n") + 1]
        try:
            lines = list(csv.reader(io.StringIO(kept.decode("utf-8"), newline=""), strict=True))
        except (UnicodeDecodeError, csv.Error) as error:
            raise FileError(f"{self.path}: not a study's results ({error}); choose another file") from None
        if lines and not set(OWN_COLUMNS) <= set(lines[0]):
            raise FileError(
                f"{self.path}: not a study's results, no column case, seed, code, error; choose another file"
            )
        for number, line in enumerate(lines[1:], start=2):
            row = dict(zip(lines[0], line, strict=False))
            if len(line) != len(lines[0]) or not row["case"].isdigit():
                raise FileError(f"{self.path}: line {number} is damaged; remove that line and run again")
            if int(row["case"]) in self.stored:
                raise FileError(f"{self.path}: line {number} repeats case {row['case']}; remove it and run again")
            self.stored[int(row["case"])] = row
        self._header = lines[0] if lines else []
        self._file.truncate(len(kept))

    def _write_header(self, row: Mapping[str, Any]) -> None:
        """Begin the file, or begin it again when the first success after failures brings the names of the results."""
        self._header = [*(name for name in row if name != "error"), "error"]
        if self.path.stat().st_size == 0:
            self._file.write(_csv([self._header]))
            return
        texts = self._texts().reindex(columns=self._header, fill_value="")
        self._file.close()
        write_text(self.path, texts.to_csv(index=False, lineterminator="\n"))
        self._open()

    def _failures_only(self) -> bool:
        return bool((self._texts()["error"] != "").all())

    def _texts(self) -> pd.DataFrame:
        import pandas as pd

        return pd.read_csv(self.path, dtype=str, keep_default_na=False)


def as_text(value: Any) -> str:
    """A number, text or truth value as it stands in the file; reading it back gives the same number."""
    if hasattr(value, "item"):
        value = value.item()
    return " ".join(value.split()) if isinstance(value, str) else str(value)


def _from_text(column: pd.Series) -> pd.Series:
    if column.isin(("True", "False")).all():
        return column == "True"
    for number in (int, float):
        try:
            return column.replace("", "nan").astype(number)
        except ValueError:
            continue
    return column


def _csv(lines: Iterable[Iterable[str]]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(lines)
    return out.getvalue()
