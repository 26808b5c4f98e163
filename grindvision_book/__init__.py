"""Runs chapters, saves figures and tables, keeps the scoreboard, builds the HTML book.

Names are fetched from their modules when first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "answers": ("answer", "scoreboard", "verdicts"),
    "exercises.checking": ("check", "progress"),
    "figures": ("save_figure", "save_scene", "save_table"),
    "session": ("COLOURS", "fast", "provenance", "start"),
    "sliders": ("slider",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name in _HOME_OF:
        return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    raise AttributeError(f"module {__name__} has no {name}")
