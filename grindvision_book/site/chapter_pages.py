"""A chapter's executed copy made ready for reading: verdicts on top, captions as captions, drawing code folded."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from grindvision.paper import EVIDENCE
from grindvision_book.machinery.evidence import VERDICTS
from grindvision_book.site.evidence_page import evidence_table
from grindvision_book.site.pictures import Figure, lightened

if TYPE_CHECKING:
    import pandas as pd
    from nbformat import NotebookNode

#: A scoreboard of more rows than this is folded.
FEW_ROWS = 6

_DRAWS = re.compile(r"\bbook\.save_(figure|scene|table)\(|\bplt\.(figure|subplots)\(|\bpv\.Plotter\(")


def readable(
    notebook: NotebookNode,
    rows: pd.DataFrame,
    figures: Mapping[str, Figure],
    light: Mapping[str, str],
    scenes: Mapping[str, str],
) -> NotebookNode:
    """Change a notebook in place for its page, and return it.

    Args:
        notebook: with its outputs, as far as there are any.
        rows: this chapter's rows of the scoreboard.
        figures: by name.
        light: file name -> name of its light copy.
        scenes: HTML that opens the 3D scene of a figure, by the figure's name.
    """
    from nbformat.v4 import new_markdown_cell

    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = lightened(cell.source, light)
            continue
        if _DRAWS.search(cell.source):
            cell.metadata.tags = [*cell.metadata.get("tags", []), "hide-input"]
        cell.outputs = _captioned(cell.get("outputs", []), figures, scenes)
    if len(rows):
        notebook.cells.insert(1, new_markdown_cell(scoreboard_html(rows), id="scoreboard"))
    return notebook


def scoreboard_html(rows: pd.DataFrame) -> str:
    """Rows of the scoreboard as a table that unfolds, each with its verdict in words and colour and its strip."""
    summary = "; ".join(
        f"{name}: " + ", ".join(f"{count} {word}" for word in VERDICTS if (count := (part["verdict"] == word).sum()))
        for name in EVIDENCE
        if len(part := rows[rows["evidence"] == name])
    )
    fold = "open" if len(rows) <= FEW_ROWS else ""
    return (
        f"<details class='scoreboard' {fold}><summary>What the numbers of this chapter are worth. {summary}</summary>\n"
        f"<div class='wide'>{evidence_table(rows)}</div>\n</details>"
    )


def figure_markdown(figure: Figure, folder: str) -> str:
    """A figure with its caption, which is also its alternative text; ``folder`` leads from the page to the figures."""
    caption = figure.caption or figure.name
    return f"```{{figure}} {folder}/{figure.shown}\n:alt: {caption}\n\n{caption}\n```\n"


def _captioned(outputs: list[Any], figures: Mapping[str, Figure], scenes: Mapping[str, str]) -> list[Any]:
    """The outputs of a cell, every drawing followed by its caption turned into a figure."""
    from nbformat.v4 import new_output

    shown, caption = [], ""
    for output in outputs:
        data = output.get("data", {})
        title = re.search(r"<title>(\w+)</title>", data.get("image/svg+xml", ""))
        if title and title[1] in figures:
            figure = figures[title[1]]
            text = figure_markdown(figure, "../figures") + "\n" + scenes.get(figure.name, "")
            shown.append(new_output("display_data", data={"text/markdown": text}))
            caption = f"*{figure.caption}*"
        elif not caption or data.get("text/markdown") != caption:
            shown.append(output)
    return shown
