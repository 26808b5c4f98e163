"""Whether rebuilt figures, tables and answers say what the committed ones say: by their data, never by pixels.

How far apart two values may be is stated in ``agreement.csv``, by the unit that a column's name ends in (in a table
with a column ``unit``, by each row's), with exceptions by file. One unit in the last digit written is allowed on top: a
value on the edge of two roundings may fall either way.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grindvision.errors import FileError

if TYPE_CHECKING:
    import pandas as pd

#: Files by name: what a folder of figures holds.
Files = Mapping[str, bytes]

TOLERANCES = Path(__file__).with_name("agreement.csv")
_SUFFIX_OF_UNIT = {"%": "percent", "1": "", "um": "um", "mm": "mm", "deg": "deg", "s": "s"}
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def files_in(folder: Path) -> dict[str, bytes]:
    """What the files of a folder hold, by name."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


def of_one_name(files: Files, stem: str) -> dict[str, bytes]:
    """The files of one figure, table or set of answers."""
    return {name: content for name, content in files.items() if Path(name).stem == stem}


def disagreements(rebuilt: Files, committed: Files) -> list[str]:
    """One line for everything in which two sets of files differ; empty when they agree."""
    stems = sorted({Path(name).stem for name in (*rebuilt, *committed)})
    return [line for stem in stems for line in differences(of_one_name(rebuilt, stem), of_one_name(committed, stem))]


def differences(rebuilt: Files, committed: Files) -> list[str]:
    """One line for everything in which two versions of one figure, table or set of answers differ."""
    found = []
    for name in sorted(rebuilt.keys() & committed.keys()):
        if rebuilt[name] == committed[name]:
            continue
        if name.endswith(".csv"):
            tables = [_table(name, files[name]) for files in (rebuilt, committed)]
            found += [f"{name}: {line}" for line in _different_values(name, *tables)]
        elif not _same_words(*(_words(name, files[name]) for files in (rebuilt, committed))):
            found.append(f"{name}: other words in its caption or text")
    found += [f"{name}: made, but not committed" for name in sorted(rebuilt.keys() - committed.keys())]
    found += [f"{name}: committed, but not made" for name in sorted(committed.keys() - rebuilt.keys())]
    return found


def tolerance(file: str, column: str) -> tuple[float, float]:
    """Largest absolute and relative difference of two values that say the same: the first row of the table that fits.

    Raises:
        FileError: the table of tolerances has no row for it, or is damaged.
    """
    for pattern, columns, absolute, relative in _tolerances():
        if fnmatchcase(file, pattern) and fnmatchcase(column, columns):
            return absolute, relative
    raise FileError(f"{TOLERANCES}: no row fits {file}, column {column}; its last row should fit everything")


@cache
def _tolerances() -> list[tuple[str, str, float, float]]:
    from grindvision.files import read_table

    table = read_table(TOLERANCES, ("absolute", "relative"), ("file", "column", "reason"))
    return list(table[["file", "column", "absolute", "relative"]].itertuples(index=False, name=None))


def _table(name: str, content: bytes) -> pd.DataFrame:
    import pandas as pd

    return pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)


def _different_values(name: str, rebuilt: pd.DataFrame, committed: pd.DataFrame) -> list[str]:
    if list(rebuilt.columns) != list(committed.columns):
        return [f"columns {', '.join(rebuilt.columns)}; committed {', '.join(committed.columns)}"]
    if len(rebuilt) != len(committed):
        return [f"{len(rebuilt)} rows; committed {len(committed)}"]
    stem, found = Path(name).stem, []
    for column in committed.columns:
        now, then = rebuilt[column], committed[column]
        if stem.startswith("answers_") and column == "rebuilt":
            allowed = np.array([tolerance(stem, f"{stem}_{suffix}") for suffix in _suffixes(committed)])
        elif "unit" in committed and not _has_unit(column):
            suffixes = [_SUFFIX_OF_UNIT.get(unit, "") for unit in committed["unit"]]
            allowed = np.array([tolerance(stem, f"{column}_{suffix}" if suffix else column) for suffix in suffixes])
        else:
            allowed = np.array([tolerance(stem, column)])
        bad = ~_close(now, then, *allowed.T)
        if bad.any():
            row = int(bad.argmax())
            found.append(
                f"column {column}: {bad.sum()} of {len(bad)} values differ, first {now[row]} (committed {then[row]}), "
                f"row {row + 1}"
            )
    return found


def _close(rebuilt: pd.Series, committed: pd.Series, absolute: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Which values of two columns of text say the same."""
    import pandas as pd

    now, then = (pd.to_numeric(values, errors="coerce").to_numpy(dtype=float) for values in (rebuilt, committed))
    digits = max(map(_decimals, committed), default=0)
    last_digit = 10.0**-digits if digits and (absolute > 0).any() else 0.0
    near = np.abs(now - then) <= absolute + relative * np.abs(then) + 1.001 * last_digit
    return near | (rebuilt == committed).to_numpy()


def _decimals(text: str) -> int:
    """Digits behind the point of a number as it is written."""
    mantissa, _, exponent = text.lower().partition("e")
    shift = int(exponent) if exponent.lstrip("+-").isdigit() else 0
    return max(len(mantissa.partition(".")[2]) - shift, 0)


def _has_unit(column: str) -> bool:
    return column.rpartition("_")[2] in _SUFFIX_OF_UNIT.values()


def _suffixes(answers: pd.DataFrame) -> list[str]:
    """The unit of each answer, as a column's name would end in it."""
    from grindvision.paper import expected

    units = expected().set_index(["item", "quantity"])["unit"]
    keys = zip(answers["item"], answers["quantity"], strict=True)
    return [_SUFFIX_OF_UNIT.get(str(units.get(key, "")), "") for key in keys]


def _words(name: str, content: bytes) -> str:
    """What a file tells in words: the text of a table's page, the caption of a drawing, nothing of other pictures."""
    if name.endswith(".md"):
        return content.decode("utf-8").rpartition("\n\n")[2]
    if name.endswith(".svg"):
        found = re.search(r"<dc:description>(.*?)</dc:description>", content.decode("utf-8"), re.DOTALL)
        return found[1] if found else ""
    return ""


def _same_words(rebuilt: str, committed: str) -> bool:
    """Whether two texts agree, numbers in them up to one unit of their last digit."""
    if _NUMBER.sub("#", rebuilt) != _NUMBER.sub("#", committed):
        return False
    pairs = zip(_NUMBER.findall(rebuilt), _NUMBER.findall(committed), strict=True)
    return all(abs(float(a) - float(b)) <= 1.001 * 10.0 ** -_decimals(b) if "." in b else a == b for a, b in pairs)
