"""The module that draws a tool's report.png, or, where Matplotlib is not installed, a warning in its place."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.caches import matplotlib_has_a_folder
from grindvision.cli import own_process
from grindvision.errors import GrindvisionWarning, MissingExtraError
from grindvision.extras import extra
from grindvision.files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Whether pictures are drawn at all; see ``without_pictures``.
_wanted = True


@contextmanager
def without_pictures() -> Iterator[None]:
    """Inside the block the tools leave their pictures out without a word: nobody looks at them."""
    global _wanted
    _wanted = False
    try:
        yield
    finally:
        _wanted = True


def are_wanted() -> bool:
    """Whether pictures are drawn."""
    return _wanted


def loaded(module: str) -> Any:
    """A module of this folder that draws.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    with matplotlib_has_a_folder(), _without_docstrings():
        return import_module(f"grindvision.cli.{module}")


def drawing(module: str) -> Callable[..., None]:
    """Function ``draw`` of a module of this folder; without the extra ``plot``, one that warns and draws nothing."""
    if not _wanted:
        return lambda *_: None
    try:
        return loaded(module).draw
    except MissingExtraError as error:
        missing = str(error)

    def no_picture(*_: object) -> None:
        warnings.warn(f"report.png is left out: {missing}", GrindvisionWarning, stacklevel=2)

    return no_picture


@contextmanager
def _without_docstrings() -> Iterator[None]:
    """Inside the block Matplotlib is imported without the lists of properties in its docstrings, half of that time, in
    a process that runs a command and nothing else; elsewhere somebody may want to read them."""
    if not own_process.ours:
        yield
        return
    with extra("plot"):
        from matplotlib import artist
    written = artist.kwdoc
    artist.kwdoc = lambda artist: ""
    try:
        yield
    finally:
        artist.kwdoc = written


def save_png(figure: Figure, path: Path, dpi: int = 100) -> None:
    """Write a figure as PNG. It is drawn once: ``Figure.savefig`` draws all of it beforehand, to lay it out. Nothing
    shines through a report, so its pixels have no opacity, and what is packed lightly takes half the time."""
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas: Any = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    canvas.draw()
    with write_whole(path) as temporary:
        pixels = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        pixels.save(temporary, dpi=(dpi, dpi), compress_level=1)
