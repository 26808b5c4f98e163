"""Runs chapters, saves figures and tables, keeps the scoreboard, builds the HTML book."""

from grindvision.book.answers import answer, scoreboard, verdicts
from grindvision.book.exercises.checking import check, progress
from grindvision.book.figures import save_figure, save_scene, save_table
from grindvision.book.session import COLOURS, fast, provenance, start
from grindvision.book.sliders import slider

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
