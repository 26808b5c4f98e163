"""What the checkers recognise, as a block of the teacher's guide."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from grindvision.book.exercises.checking import exercises_of
from grindvision.errors import FileError
from grindvision.files import write_text

GUIDE = Path(__file__).parents[1] / "site_sources" / "teachers_guide.md"
FIRST, LAST = "<!-- mistakes: written by `python -m grindvision.book.exercises` -->", "<!-- end of mistakes -->"


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
    text = guide.read_text(encoding="utf-8")
    if text.count(FIRST) != 1 or text.count(LAST) != 1:
        raise FileError(f"{guide}: the marks {FIRST} and {LAST} must each stand there once; put them back")
    before, rest = text.split(FIRST)
    write_text(guide, before + mistakes_block(chapters) + rest.split(LAST)[1])
    return guide
