"""Runs chapters, saves figures and tables, keeps the scoreboard, builds the HTML book.

``chapter_NN`` holds what chapter NN computes and draws beyond ten lines, ``studies`` runs a case many times,
``machinery`` runs the chapters and publishes what they make, ``exercises`` checks solutions, ``site`` makes the HTML
book.

Names are fetched from their modules when first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "machinery.answers": ("answer", "missed", "scoreboard", "verdicts"),
    "exercises.checking": ("check", "progress"),
    "machinery.figures": ("save_figure", "save_scene", "save_table"),
    "machinery.session": ("COLOURS", "fast", "leave_as_committed", "provenance", "start"),
    "machinery.sliders": ("slider",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name in _HOME_OF:
        return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    raise AttributeError(f"module {__name__} has no {name}")
