"""What the checkers recognise, as a block of the teacher's guide."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from grindvision_book.exercises.checking import exercises_of
from grindvision_book.machinery.blocks import replace_block

GUIDE = Path(__file__).parents[1] / "site_sources" / "teachers_guide.md"
FIRST, LAST = "<!-- mistakes: written by `python -m grindvision_book.exercises` -->", "<!-- end of mistakes -->"


def mistakes_block(chapters: Iterable[str]) -> str:
    """Markdown of the block: every exercise of these chapters with the mistakes that its checker names."""
    tasks = [task for chapter in chapters for task in exercises_of(chapter)]
    lines = [f"| {task.number} | {task.title} | {'; '.join(m.name for m in task.mistakes)} |" for task in tasks]
    head = ["| exercise | title | mistakes that its checker names |", "|---|---|---|"]
    return "\n".join([FIRST, "", *head, *lines, "", LAST])


def write_guide(chapters: Iterable[str], guide: Path = GUIDE) -> Path:
    """Replace the block in the teacher's guide.

    Raises:
        FileError: the guide lacks the two marks between which the block stands.
    """
    replace_block(guide, mistakes_block(chapters), FIRST, LAST)
    return guide
