"""The chapters of the book: numbered notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from grindvision.errors import FileError, InputError
from grindvision_book.machinery.places import NOTEBOOKS

#: The chapter that looks back on all others runs last.
OVERVIEW = "00"

#: Chapters whose studies take minutes. Every run of the tests runs them in the fast setting, unless this machine has
#: built them in the full one and nothing has changed; `tests/test_studies_again.py` measures some of their cases.
LONG = ("08", "09")


def chapters(notebooks: Path = NOTEBOOKS) -> dict[str, Path]:
    """Every chapter there is, in order: two digits -> notebook.

    Raises:
        FileError: two notebooks with one number, or none at all.
    """
    found: dict[str, Path] = {}
    for path in sorted(notebooks.glob("[0-9][0-9]_*.ipynb")):
        number = path.name[:2]
        if number in found:
            raise FileError(f"{found[number].name} and {path.name} are both chapter {number}; rename one")
        found[number] = path
    if not found:
        raise FileError(f"{notebooks}: no chapter there (a chapter is a notebook like 03_calibration.ipynb)")
    return found


def chosen(numbers: Sequence[str], notebooks: Path = NOTEBOOKS) -> dict[str, Path]:
    """The chapters with these numbers (``3`` means ``03``), or all of them when none is given.

    Raises:
        InputError: a number the book does not have. FileError: a chapter the book should have, but its file is missing.
    """
    from grindvision.paper import expected

    there = chapters(notebooks)
    if not numbers:
        return there
    picked = {}
    for number in (word.zfill(2) for word in numbers):
        if number not in there:
            if number in set(expected()["chapter"]):
                raise FileError(f"chapter {number} is missing: there is no notebook {notebooks}/{number}_*.ipynb")
            raise InputError(f"there is no chapter {number!r}; the book has {', '.join(there)}")
        picked[number] = there[number]
    return dict(sorted(picked.items()))
