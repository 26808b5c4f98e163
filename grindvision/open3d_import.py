"""Lets Open3D be imported without Plotly and Dash, which it draws with in a browser: half the time of its import."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

_DRAWS = "open3d.visualization.draw_plotly"


def leave_out_plotly() -> None:
    """Make the coming ``import open3d`` load Plotly and Dash only when a function that needs them is called."""
    if "open3d" in sys.modules:
        return
    stand_in = ModuleType(_DRAWS)
    stand_in.__getattr__ = _drawing  # type: ignore[method-assign]
    sys.modules[_DRAWS] = stand_in


def _drawing(name: str) -> Callable[..., Any]:
    """A function of Open3D's module by its name, which loads that module when it is called."""
    if name.startswith("__"):
        raise AttributeError(name)

    def draw(*arguments: Any, **named: Any) -> Any:
        if not hasattr(sys.modules.get(_DRAWS), "__file__"):
            _load()
        return getattr(sys.modules[_DRAWS], name)(*arguments, **named)

    return draw


def _load() -> None:
    """Put Open3D's module where the stand-in was, and its functions where Open3D has them."""
    del sys.modules[_DRAWS]
    parent = sys.modules["open3d.visualization"]
    names = [name for name, value in vars(parent).items() if getattr(value, "__module__", "") == __name__]
    module = importlib.import_module(_DRAWS)
    for name in names:
        setattr(parent, name, getattr(module, name))
