"""What the checkers recognise, as a block of the teacher's guide."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from grindvision_book.exercises.checking import exercises_of
from grindvision_book.machinery.blocks import replace_block

GUIDE = Path(__file__).parents[1] / "site_sources" / "teachers_guide.md"
FIRST, LAST = "<!-- mistakes: written by `python -m grindvision_book.exercises` -->", "<!-- end of mistakes -->"


#: Stars of each exercise of a chapter, in order: 1 a formula is written down, 2 one is chosen, 3 a result is judged.
DIFFICULTY = {
    "01": "1122",
    "02": "2223",
    "03": "12222",
    "04": "123323",
    "05": "2223",
    "06": "22323",
    "07": "1223",
    "08": "1223",
    "09": "1223",
    "10": "11223",
    "11": "2322322",
    "12": "223",
    "14": "132",
    "15": "2231",
    "16": "213",
}


def stars(number: str) -> str:
    """Difficulty of an exercise, "05-2", in stars; none where nobody has judged it."""
    chapter, _, place = number.partition("-")
    judged = DIFFICULTY.get(chapter, "")[int(place) - 1 : int(place)]
    return "★" * int(judged or 0)


def mistakes_block(chapters: Iterable[str]) -> str:
    """Markdown of the block: every exercise of these chapters with the mistakes that its checker names."""
    tasks = [task for chapter in chapters for task in exercises_of(chapter)]
    lines = [
        f"| {task.number} | {stars(task.number)} | {task.title} | {'; '.join(m.name for m in task.mistakes)} |"
        for task in tasks
    ]
    head = ["| exercise | difficulty | title | mistakes that its checker names |", "|---|---|---|---|"]
    return "\n".join([FIRST, "", *head, *lines, "", LAST])


def write_guide(chapters: Iterable[str], guide: Path = GUIDE) -> Path:
    """Replace the block in the teacher's guide.

    Raises:
        FileError: the guide lacks the two marks between which the block stands.
    """
    replace_block(guide, mistakes_block(chapters), FIRST, LAST)
    return guide
