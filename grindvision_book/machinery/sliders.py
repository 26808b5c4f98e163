"""One parameter to move: a slider over finished pictures, in a live notebook and on a page.

Files hold a strip of a few pictures side by side.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from grindvision.errors import InputError
from grindvision_book.machinery.figures import is_live, lay_out, save_figure, shown_in

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Width and height in inches of one picture of a strip, and of the picture under a slider.
STRIP_PICTURE, SLIDER_PICTURE = (1.95, 2.1), (5.6, 4.0)


def slider(
    draw: Callable[[Axes, float], pd.DataFrame],
    values: Sequence[float],
    name: str,
    label: str,
    caption: str,
    strip: Sequence[float] = (),
) -> None:
    """Let a reader move one parameter and see what becomes of a picture.

    All pictures are drawn at once, to one scale. Where somebody sits before the notebook, a slider chooses one. Where
    nobody does (book, tests, HTML), the pictures of a few values stand side by side and are saved like any other
    figure, and the executed notebook gets the pictures of all values under a slider of the page, which needs no kernel.

    Args:
        draw: draws the picture of one value into the axes, and returns what it draws, units in the column names.
        values: the positions of the slider, ascending.
        name: file name of the strip, as in ``save_figure``.
        label: the parameter and its unit, such as "voxel edge, mm".
        caption: of the strip, as in ``save_figure``.
        strip: three or four of the values; evenly picked when left out.

    Raises:
        InputError: fewer than three values, or a picture of the strip that is no position of the slider.
    """
    if len(values) < 3:
        raise InputError(f"{name}: a slider with {len(values)} positions shows nothing; give at least 3 values")
    if not set(strip) <= set(values):
        raise InputError(f"{name}: the strip shows {sorted(set(strip) - set(values))}, which are no slider positions")
    if is_live():
        _show_slider(draw, values, label, caption)
    else:
        _save_strip(draw, strip or [values[k * (len(values) - 1) // 3] for k in range(4)], name, label, caption)
        if shell := shown_in():
            shell.display(shell.HTML(frames_html(draw, values, label, caption)))


def frames_html(draw: Callable[[Axes, float], pd.DataFrame], values: Sequence[float], label: str, caption: str) -> str:
    """HTML with the pictures of all values, of one scale, and a slider that chooses one; arguments as in ``slider``."""
    middle, frames = len(values) // 2, []
    about = html.escape(caption, quote=True)
    pictures = _pictures(draw, values, "webp", pil_kwargs={"quality": 70})
    for at, (value, picture) in enumerate(zip(values, pictures, strict=True)):
        told = html.escape(_told(label, value), quote=True)
        source = f"data:image/webp;base64,{base64.b64encode(picture).decode()}"
        hidden = "" if at == middle else " hidden"
        frames.append(f"<span data-value='{told}'{hidden}><img src='{source}' alt='{told}: {about}'/></span>")
    knob = f"<input type='range' min='0' max='{len(values) - 1}' value='{middle}' aria-label='{html.escape(label)}'/>"
    chosen = f"<label>{knob} <output>{html.escape(_told(label, values[middle]))}</output></label>"
    return f"<figure class='frames'>{chosen}{''.join(frames)}<figcaption>{html.escape(caption)}</figcaption></figure>"


def _told(label: str, value: float) -> str:
    quantity, _, unit = label.partition(", ")
    return f"{quantity} {value:g} {unit}".rstrip()


def _pictures(
    draw: Callable[[Axes, float], pd.DataFrame], values: Sequence[float], kind: str, **how: Any
) -> list[bytes]:
    """The pictures of all values, of one scale; ``kind`` is png or webp, ``how`` they are written as Matplotlib's
    canvas takes it."""
    import matplotlib.pyplot as plt
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figures, pictures = [], []
    for value in values:
        fig, axes = plt.subplots(figsize=SLIDER_PICTURE, dpi=90)
        draw(axes, value)
        figures.append(fig)
    _same_scale(figures)
    for fig in figures:
        lay_out(fig)
        canvas, picture = FigureCanvasAgg(fig), io.BytesIO()
        getattr(canvas, f"print_{kind}")(picture, **how)
        plt.close(fig)
        pictures.append(picture.getvalue())
    return pictures


def _same_scale(figures: Sequence[Figure]) -> None:
    """Give the first axes of all figures the limits that hold all of them."""
    for axis in ("x", "y"):
        limits = [getattr(fig.axes[0], f"get_{axis}lim")() for fig in figures]
        low, high = min(min(pair) for pair in limits), max(max(pair) for pair in limits)
        for fig, (first, last) in zip(figures, limits, strict=True):
            getattr(fig.axes[0], f"set_{axis}lim")(*((low, high) if first <= last else (high, low)))


def _show_slider(
    draw: Callable[[Axes, float], pd.DataFrame], values: Sequence[float], label: str, caption: str
) -> None:
    import ipywidgets
    from IPython import display

    pictures = dict(zip(values, _pictures(draw, values, "png"), strict=True))

    def show(value: float) -> None:
        display.display(display.Image(pictures[value], alt=_told(label, value)), display.Markdown(f"*{caption}*"))

    choices = [(f"{value:g}", value) for value in values]
    knob = ipywidgets.SelectionSlider(
        options=choices, value=values[len(values) // 2], description=label,
        style={"description_width": "initial"}, layout={"width": "30em"},
    )  # fmt: skip
    ipywidgets.interact(show, value=knob)


def _save_strip(
    draw: Callable[[Axes, float], pd.DataFrame], values: Sequence[float], name: str, label: str, caption: str
) -> None:
    import matplotlib.pyplot as plt
    import pandas as pd

    quantity, _, unit = label.partition(", ")
    width, height = STRIP_PICTURE
    fig, panels = plt.subplots(1, len(values), figsize=(width * len(values), height), sharex=True, sharey=True)
    drawn = []
    for axes, value in zip(panels, values, strict=True):
        data = draw(axes, value)
        axes.set_title(_told(label, value), fontsize=9)
        axes.label_outer()
        data.insert(0, f"{quantity}_{unit}".strip("_").replace(" ", "_"), value)
        drawn.append(data)
    save_figure(fig, name, pd.concat(drawn, ignore_index=True), caption)
