"""Runs chapters, saves figures and tables, keeps the scoreboard, builds the HTML book."""

from grindvision_book.answers import answer, scoreboard, verdicts
from grindvision_book.exercises.checking import check, progress
from grindvision_book.figures import save_figure, save_scene, save_table
from grindvision_book.session import COLOURS, fast, provenance, start
from grindvision_book.sliders import slider

__all__ = [
    "COLOURS",
    "answer",
    "check",
    "fast",
    "progress",
    "provenance",
    "save_figure",
    "save_scene",
    "save_table",
    "scoreboard",
    "slider",
    "start",
    "verdicts",
]
