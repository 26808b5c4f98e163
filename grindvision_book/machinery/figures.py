"""Saves what a chapter shows: a figure or 3D scene as SVG, PNG and the CSV that is drawn, a table as CSV and Markdown.

The files repeat byte for byte: no date, no random identifiers, text as outlines, a fixed number format.
"""

from __future__ import annotations

import base64
import html
import os
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from grindvision.errors import InputError
from grindvision.files import write_text, write_whole
from grindvision_book.machinery.places import figures_folder
from grindvision_book.machinery.session import current_chapter
from grindvision_book.machinery.shown_tables import cell_texts, heading

if TYPE_CHECKING:
    import pandas as pd
    import pyvista
    from matplotlib.figure import Figure

#: Pixels per inch of images and rasterised layers inside an SVG; lines and text have none.
LAYER_DPI = 90


def save_figure(fig: Figure, name: str, data: pd.DataFrame, caption: str) -> None:
    """Save a figure as ``name.svg``, ``name.png`` and ``name.csv``, show it with its caption, and close it.

    Args:
        fig: Matplotlib figure.
        name: file name without suffix: lower-case letters, digits and underscores.
        data: what is drawn, units in the column names; a time ends in ``_s``.
        caption: frame, unit, and origin (printed, synthetic with its seed, measured).

    Raises:
        InputError: unusable name, no data or no caption. FileError: the folder cannot be written to.
    """
    import matplotlib.pyplot as plt

    _check(name, data, caption)
    folder = figures_folder()
    svg = folder / f"{name}.svg"
    _draw(fig, svg, folder / f"{name}.png", {"Title": name, "Description": caption})
    write_text(folder / f"{name}.csv", csv_text(data))
    plt.close(fig)
    if shell := shown_in():
        shell.display(_shown(svg, caption, shell), shell.Markdown(f"*{caption}*"))


def _shown(svg: Path, caption: str, shell: ModuleType) -> Any:
    """A drawing as a page of the book takes it, and in a live notebook as an image that is no wider than its cell:
    JupyterLab keeps a wide SVG at its own width and cuts it off."""
    if not is_live():
        return shell.SVG(filename=str(svg))
    source = base64.b64encode(svg.read_bytes()).decode()
    about = html.escape(caption, quote=True)
    return shell.HTML(f"<img src='data:image/svg+xml;base64,{source}' alt='{about}' style='max-width: 100%'/>")


def _draw(fig: Figure, svg: Path, png: Path, about: dict[str, str]) -> None:
    """Write a figure in both formats, laid out once and drawn once in each: ``savefig`` does either twice."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    lay_out(fig)
    screen_dpi = fig.dpi
    canvas: Any = FigureCanvasSVG(fig)
    fig.set_dpi(LAYER_DPI)
    with write_whole(svg) as path:
        source = f"chapter {current_chapter()}"
        canvas.print_svg(path, metadata={**about, "Source": source, "Date": None, "Creator": None})
    fig.set_dpi(screen_dpi if mpl.rcParams["savefig.dpi"] == "figure" else mpl.rcParams["savefig.dpi"])
    canvas = FigureCanvasAgg(fig)
    with write_whole(png) as path:
        canvas.print_png(path, metadata={**about, "Software": None})


def lay_out(fig: Figure) -> None:
    """Give the axes of a figure their places, once: each later drawing would do it twice."""
    if engine := fig.get_layout_engine():
        engine.execute(fig)
        fig.set_layout_engine("none")


def save_scene(plotter: pyvista.Plotter, name: str, data: pd.DataFrame, caption: str) -> None:
    """Save what an off-screen PyVista plotter sees as the same three files, show it with its caption, and close it.

    The picture is cropped to what is drawn; arguments and errors as in ``save_figure``.
    """
    import matplotlib.pyplot as plt
    import numpy as np
    from PIL import Image

    _check(name, data, caption)
    picture = plotter.screenshot(return_img=True)[..., :3]
    plotter.close()
    drawn = np.argwhere((picture != picture[0, 0]).any(axis=2))
    if not len(drawn):
        raise InputError(f"scene {name}: the 3D view is empty; check the camera and what was added")
    (top, left), (bottom, right) = np.maximum(drawn.min(axis=0) - 12, 0), drawn.max(axis=0) + 13
    cropped = Image.fromarray(picture[top:bottom, left:right])
    few_colours = np.asarray(cropped.quantize(192, dither=Image.Dither.NONE).convert("RGB"))

    height, width = few_colours.shape[:2]
    with plt.rc_context({"figure.constrained_layout.use": False, "savefig.dpi": "figure"}):
        fig = plt.figure(figsize=(7.0, 7.0 * height / width), dpi=width / 7.0)
        axes = fig.add_axes((0, 0, 1, 1))
        axes.imshow(few_colours, interpolation="none")
        axes.set_axis_off()
        save_figure(fig, name, data, caption)


def save_table(table: pd.DataFrame, name: str, caption: str) -> None:
    """Save a table as ``name.csv`` (all digits) and ``name.md`` (rounded, with the caption), and show it.

    Arguments and errors as in ``save_figure``; the table's index is not saved.
    """
    _check(name, table, caption)
    folder = figures_folder()
    text = markdown_table(table)
    write_text(folder / f"{name}.csv", csv_text(table))
    write_text(folder / f"{name}.md", f"{text}\n\n*{caption}* (chapter {current_chapter()})\n")
    if shell := shown_in():
        shell.display(shell.Markdown(f"{text}\n\n*{caption}*"))


def csv_text(table: pd.DataFrame) -> str:
    """A table as CSV with seven significant digits and Unix line ends: what the book compares and commits."""
    return table.to_csv(index=False, float_format="%.7g", lineterminator="\n")


def markdown_table(table: pd.DataFrame) -> str:
    """A table as Markdown: headings in words with their units, numbers to the right (``shown_tables``)."""
    right = [table[column].dtype.kind in "iuf" for column in table.columns]
    lines = [[heading(column) for column in table.columns], ["---:" if number else "---" for number in right]]
    columns = [[_escaped(text) for text in cell_texts(column)] for _, column in table.items()]
    lines += [list(row) for row in zip(*columns, strict=True)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _escaped(text: str) -> str:
    return html.escape(text, quote=False).replace("|", "\\|")


def _check(name: str, data: pd.DataFrame, caption: str) -> None:
    import pandas as pd

    if not re.fullmatch(r"[a-z0-9_]+", name):
        raise InputError(f"figure name {name!r}: use lower-case letters, digits and underscores")
    if not isinstance(data, pd.DataFrame) or data.empty:
        raise InputError(f"{name}: what is drawn must come with it as a pandas DataFrame of at least one row")
    if not caption.strip():
        raise InputError(f"{name}: the caption is empty; state frame, unit and origin")


def shown_in() -> ModuleType | None:
    """``IPython.display`` inside a notebook or IPython session, else None."""
    if "IPython" not in sys.modules or sys.modules["IPython"].get_ipython() is None:
        return None
    from IPython import display

    return display


def is_live() -> bool:
    """Whether somebody reads along, and can move a slider: a kernel of JupyterLab, Notebook or VS Code that rebuilds no
    book."""
    if os.environ.get("GRINDVISION_FIGURES") or "IPython" not in sys.modules:
        return False
    shell = sys.modules["IPython"].get_ipython()
    return shell is not None and ("JPY_SESSION_NAME" in os.environ or "__vsc_ipynb_file__" in shell.user_ns)
