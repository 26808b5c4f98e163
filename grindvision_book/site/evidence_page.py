"""What every number of the book is worth, at a glance: verdict, a strip of print, rebuilt value and bound, class."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from grindvision.paper import EVIDENCE
from grindvision_book.machinery.answers import bound_text
from grindvision_book.machinery.evidence import VERDICTS

if TYPE_CHECKING:
    import pandas as pd

_WIDTH, _HEIGHT, _MARGIN = 140, 18, 8

_HEAD = (
    ("verdict", ""),
    ("quantity", ""),
    ("paper | rebuilt", ""),
    ("paper; rebuilt; bound", "wide-only"),
    ("evidence", "wide-only"),
)


def evidence_page(table: pd.DataFrame) -> str:
    """Markdown of the page: counts in one line, two filters, and a row for every number of the scoreboard."""
    counts = ", ".join(f"**{n}** {word}" for word in VERDICTS if (n := int((table["verdict"] == word).sum())))
    return "\n".join(
        [
            "# The evidence at a glance\n",
            f"{len(table)} numbers: {counts}. In each strip the green band is what the bound allows, the black line "
            "the printed value, the dot the rebuilt one; a triangle is a value beyond the strip's end.\n",
            "What the words and classes mean stands on the [scoreboard](figures/scoreboard.md), with the date of every "
            "bound; what the paper cannot hold and what we could not rebuild on [what we found](findings.md).\n",
            "<div class='filters'>",
            _choice("class", "Class of evidence", [name for name in EVIDENCE if (table["evidence"] == name).any()]),
            _choice("chapter", "Chapter", sorted(table["chapter"].unique())),
            _choice("verdict", "Verdict", [word for word in VERDICTS if (table["verdict"] == word).any()]),
            "<span class='shown'></span></div>\n",
            evidence_table(table),
            "",
        ]
    )


def evidence_table(rows: pd.DataFrame) -> str:
    """Rows of the scoreboard as an HTML table: the verdict first, then the strip; ``wide-only`` columns need room."""
    head = "".join(f"<th scope='col' class='{kind}'>{html.escape(name)}</th>" for name, kind in _HEAD)
    lines = []
    for row, trivial in zip(rows.itertuples(index=False), rows["trivial answer passes"], strict=True):
        unit = "" if row.unit == "1" else f" {html.escape(str(row.unit))}"
        verdict = f"<span class='verdict {row.verdict.replace(' ', '-')}'>{row.verdict}</span>"
        quantity = html.escape(f"{row.item}: {row.quantity}", quote=False)
        trivial_mark = "<br><small>a trivial answer passes too</small>" if trivial == "yes" else ""
        cells = [verdict, quantity + trivial_mark, strip(row)]
        values = (_number(row.paper) or "not printed", f"{_number(row.rebuilt)}{unit}", html.escape(bound_text(row)))
        cells += ["; ".join(value for value in values if value), html.escape(row.evidence, quote=False)]
        data = f"data-class='{html.escape(row.evidence)}' data-chapter='{row.chapter}' data-verdict='{row.verdict}'"
        cells = [f"<td class='{kind}'>{text}</td>" for text, (_, kind) in zip(cells, _HEAD, strict=True)]
        lines.append(f"<tr {data}>{''.join(cells)}</tr>")
    return (
        f"<table class='evidence'><thead><tr>{head}</tr></thead>\n<tbody>\n" + "\n".join(lines) + "\n</tbody></table>\n"
    )


def strip(row: Any) -> str:
    """An SVG of a row (a named tuple of the scoreboard): allowed band, printed value (line) and rebuilt one (dot)."""
    if row.rebuilt != row.rebuilt or row.evidence == "not comparable":
        return ""
    low, high = _allowed(row)
    start, end = _ends(low, high, row)

    def place(value: float) -> float:
        inside = min(max((value - start) / (end - start), 0.0), 1.0)
        return round(_MARGIN + inside * (_WIDTH - 2 * _MARGIN), 1)

    left, right, middle = place(low), place(high), _HEIGHT / 2
    told = f"paper {_number(row.paper) or 'none'}, rebuilt {_number(row.rebuilt)}, bound {bound_text(row)}"
    parts = [
        f"<line x1='{_MARGIN}' x2='{_WIDTH - _MARGIN}' y1='{middle}' y2='{middle}' class='axis'/>",
        f"<rect x='{left}' width='{max(round(right - left, 1), 1.5)}' y='3' height='{_HEIGHT - 6}' class='allowed'/>",
    ]
    if row.paper == row.paper:
        at = place(row.paper)
        parts.append(f"<line x1='{at}' x2='{at}' y1='1' y2='{_HEIGHT - 1}' class='printed'/>")
    at = place(row.rebuilt)
    kind = "kept" if low <= row.rebuilt <= high else "missed"
    if start <= row.rebuilt <= end:
        parts.append(f"<circle cx='{at}' cy='{middle}' r='4' class='{kind}'/>")
    else:
        tip = 7 if row.rebuilt > end else -7
        parts.append(f"<path d='M{at} {middle - 5}l{tip} 5l{-tip} 5z' class='{kind}'/>")
    return (
        f"<svg class='strip' viewBox='0 0 {_WIDTH} {_HEIGHT}' role='img' aria-label='{html.escape(told)}'>"
        f"<title>{html.escape(told)}</title>{''.join(parts)}</svg>"
    )


def _allowed(row: Any) -> tuple[float, float]:
    """Least and largest value that keeps the bound; infinite where there is none."""
    if row.claim == "equal":
        return row.paper - row.tolerance, row.paper + row.tolerance
    printed = row.paper == row.paper
    if row.claim == "at most":
        return -math.inf, (row.paper if printed else 0.0) + row.tolerance
    return (row.paper - row.tolerance if printed else row.tolerance), math.inf


def _ends(low: float, high: float, row: Any) -> tuple[float, float]:
    """Where a strip begins and ends: twice the allowed band, from 0 where that has one end only."""
    if row.claim == "equal":
        half = 2 * (high - low) / 2 or 2 * abs(row.rebuilt - row.paper) or 1.0
        return row.paper - half, row.paper + half
    bound = high if row.claim == "at most" else low
    finite = [0.0, 2 * bound, *(value for value in (row.paper,) if value == value)]
    if max(finite) == min(finite):
        finite.append(2 * row.rebuilt or 1.0)
    return min(finite), max(finite)


def _choice(name: str, label: str, values: Iterable[str]) -> str:
    options = "".join(f"<option>{html.escape(str(value))}</option>" for value in values)
    return f"<label>{label} <select data-filter='{name}'><option value=''>all</option>{options}</select></label>"


def _number(value: float) -> str:
    if value != value:
        return ""
    return "under 0.0001" if 0 < value < 1e-4 else f"{value:.4g}"
