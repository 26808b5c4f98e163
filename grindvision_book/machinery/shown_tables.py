"""Tables as a person reads them: headings in words with their units, digits that mean something, no row numbers."""

from __future__ import annotations

import html
import math
import zlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

_UNITS = {
    "mm": "mm",
    "mm2": "mm²",
    "mm3": "mm³",
    "cm": "cm",
    "um": "µm",
    "m": "m",
    "deg": "°",
    "mdeg": "m°",
    "rad": "rad",
    "mrad": "mrad",
    "percent": "%",
    "ppm": "ppm",
    "s": "s",
    "ms": "ms",
    "us": "µs",
    "kb": "kB",
    "mb": "MB",
    "mib": "MiB",
    "N": "N",
}
_WORDS = {"std": "standard deviation", "rms": "rms", "mae": "mean absolute", "nx": "n_x", "ny": "n_y", "nz": "n_z"}
#: Columns whose missing values are values that the paper does not print.
_PRINTED = ("paper", "printed")
_DIGITS = 4
#: Decimals of printed values, and of others that are shown as they stand.
_MAX_DECIMALS, _FEW_DECIMALS = 4, 2
#: Widths of a character and of a cell's padding in JupyterLab: tables in 13 px, half an em to each side of a cell.
_CHARACTER_PX, _PADDING_PX = 7.5, 14


def heading(column: object) -> str:
    """A column's name in words, its unit in brackets: ``turn_deg`` becomes "turn (°)"."""
    if isinstance(column, tuple):
        return ", ".join(heading(level) for level in column if level != "")
    words = str(column).split("_")
    unit = _UNITS.get(words[-1]) if len(words) > 1 else None
    text = " ".join(_WORDS.get(word, word) for word in (words[:-1] if unit else words))
    return f"{text} ({unit})" if unit else text


def cell_texts(column: pd.Series[Any]) -> list[str]:
    """The cells of a column: printed values as they are printed, computed ones with four digits.

    Values that lie close together keep as many decimals as tell them apart. A missing value is blank, or "not printed"
    in a column of printed values.
    """
    printed = str(column.name).split("_")[0] in _PRINTED
    finite = [float(value) for value in column if isinstance(value, float) and math.isfinite(value)]
    range_of_values = max(finite, default=0.0) - min(finite, default=0.0)
    decimals = min(1 - math.floor(math.log10(range_of_values)), _MAX_DECIMALS) if range_of_values > 0 else 0
    as_given = _MAX_DECIMALS if printed else _FEW_DECIMALS
    if printed or all(_has_decimals(value, as_given) for value in finite):
        return [_cell_text(value, "not printed" if printed else "", as_given, decimals) for value in column]
    return [_cell_text(value, "", None, decimals) for value in column]


def _has_decimals(value: float, decimals: int) -> bool:
    return abs(value - round(value, decimals)) <= 1e-12 * max(1.0, abs(value))


def _cell_text(value: object, missing: str, as_given: int | None, decimals: int) -> str:
    if value is None or value != value:
        return missing
    if not isinstance(value, float):
        return " ".join(str(value).split())
    if not math.isfinite(value):
        return str(value)
    if value == round(value):
        return str(int(value))
    if as_given is not None and _has_decimals(value, as_given):
        return f"{value:.{as_given}f}".rstrip("0").rstrip(".")
    if abs(value) < 1e-4:
        return f"{value:.{_DIGITS}g}"
    return f"{value:.{max(_DIGITS - 1 - math.floor(math.log10(abs(value))), decimals, 0)}f}"


def table_html(table: pd.DataFrame) -> str:
    """A table as HTML for a notebook and a page; its index is shown only where it has a name or holds words."""
    import pandas as pd

    if len(table) > pd.get_option("display.max_rows"):
        return str(table._repr_html_())
    says = table.index.nlevels > 1 or table.index.name is not None or table.index.inferred_type != "integer"
    shown = table.reset_index() if says else table
    unnamed = {"index", "level_0", "level_1"} if says and table.index.names[0] is None else set()
    names = [
        "" if (name[0] if isinstance(name, tuple) else name) in unnamed else html.escape(heading(name))
        for name in shown
    ]
    aligned = [" class='number'" if pd.api.types.is_numeric_dtype(kind) else "" for kind in shown.dtypes]
    texts = [[html.escape(text) for text in cell_texts(shown.iloc[:, i])] for i in range(shown.shape[1])]
    head = "".join(f"<th scope='col'{right}>{name}</th>" for name, right in zip(names, aligned, strict=True))
    rows = [
        "<tr>" + "".join(f"<td{right}>{text}</td>" for text, right in zip(row, aligned, strict=True)) + "</tr>"
        for row in zip(*texts, strict=True)
    ]
    style, name = _stacked_in_lab([html.unescape(name) for name in names], texts)
    body = f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f"{style}<div class='columns'><table class='dataframe {name}'>{body}</table></div>"


def _stacked_in_lab(names: list[str], texts: list[list[str]]) -> tuple[str, str]:
    """Style by which JupyterLab lays a table's cells under each other where its columns have no room, as the script of
    the page does there; and the class of the table that it is for."""
    columns = [
        [word for text in (name, *column) for word in text.split()] for name, column in zip(names, texts, strict=True)
    ]
    longest = [max((len(html.unescape(word)) for word in words), default=0) for words in columns]
    needed = round(sum(_CHARACTER_PX * length + _PADDING_PX for length in longest))
    table = f"w{needed}-{zlib.crc32(repr(names).encode()):08x}"
    place = f".jp-OutputArea-output .{table}"
    rules = [
        f"{place},{place} :is(tbody,tr){{display:block;width:100%}}{place} thead{{display:none}}",
        f"{place} td{{display:grid;grid-template-columns:2fr 3fr;gap:.6em;text-align:left;overflow-wrap:anywhere}}",
    ]
    for number, name in enumerate(names, start=1):
        rules.append(f"{place} td:nth-child({number})::before{{content:{_css_text(name)}}}")
    box = ".jp-OutputArea-output .columns{container-type:inline-size}"
    return f"<style>{box}@container (max-width:{needed}px){{{''.join(rules)}}}</style>", table


def _css_text(text: str) -> str:
    """A text as a string of CSS inside HTML: all but letters and digits by their number."""
    return '"' + "".join(one if one.isascii() and one.isalnum() else f"\\{ord(one):x} " for one in text) + '"'
