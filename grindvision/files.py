"""Reading tables that are checked at the door, and writing files whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.errors import FileError

if TYPE_CHECKING:
    import pandas as pd


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
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}; choose a folder you may write to") from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror or error}; choose a folder you may write to") from None
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
    """Write ``text`` as UTF-8, whole or not at all."""
    with write_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | Path, content: Any) -> None:
    """Write ``content`` as indented JSON; NumPy scalars and arrays become numbers and lists, NaN becomes null."""
    write_text(path, json.dumps(_plain(content), indent=2, ensure_ascii=False) + "\n")


def sha256(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    with open(path, "rb") as file:
        digest = hashlib.sha256()
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def read_table(path: str | Path, numbers: Sequence[str], texts: Sequence[str] = ()) -> pd.DataFrame:
    """Read a CSV whose named columns must be there, and whose ``numbers`` columns must be finite floats.

    Further columns are kept as they are.

    Raises:
        FileError: the file is missing, is no CSV, lacks a column, has no row, or holds text or NaN where a number
            belongs; the message names file, row and column.
    """
    import pandas as pd

    path = Path(path)
    try:
        table = pd.read_csv(path, encoding="utf-8")
    except FileNotFoundError:
        raise FileError(f"{path}: no such file; check the path") from None
    except (OSError, UnicodeDecodeError, pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise FileError(f"{path}: not a readable CSV table ({' '.join(str(error).split())})") from None
    table.columns = [str(column).strip() for column in table.columns]
    missing = [column for column in (*texts, *numbers) if column not in table.columns]
    if missing:
        raise FileError(f"{path}: column {', '.join(missing)} missing; found {', '.join(table.columns)}")
    if table.empty:
        raise FileError(f"{path}: the table has no rows")
    for column in numbers:
        values = pd.to_numeric(table[column], errors="coerce").astype(float)
        bad = ~values.abs().lt(float("inf"))
        if bad.any():
            row = int(bad.to_numpy().argmax())
            raise FileError(
                f"{path}: row {row + 1}, column {column}: {table[column].iloc[row]!r} is not a finite number;"
                " mend the file"
            )
        table[column] = values
    return table


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and value != value:
        return None
    if isinstance(value, Path):
        return str(value)
    return value
