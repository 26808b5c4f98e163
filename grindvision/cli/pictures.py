"""The module that draws a tool's report.png, or, where Matplotlib is not installed, a warning in its place."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from importlib import import_module

from grindvision.caches import matplotlib_has_a_folder
from grindvision.errors import GrindvisionWarning, MissingExtraError


def drawing(module: str) -> Callable[..., None]:
    """Function ``draw`` of a module of this folder; without the extra ``plot``, one that warns and draws nothing."""
    try:
        with matplotlib_has_a_folder():
            return import_module(f"grindvision.cli.{module}").draw
    except MissingExtraError as error:
        missing = str(error)

    def no_picture(*_: object) -> None:
        warnings.warn(f"report.png is left out: {missing}", GrindvisionWarning, stacklevel=2)

    return no_picture
