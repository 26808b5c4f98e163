"""Texts that the book writes into committed files: whole ones, and blocks of a page between two marks."""

from __future__ import annotations

from pathlib import Path

from grindvision.errors import FileError
from grindvision.files import write_text


def replace_block(page: Path, block: str, first: str, last: str) -> None:
    """Replace what stands on the page from the mark ``first`` to the mark ``last``, both part of ``block``.

    Raises:
        FileError: the page lacks the two marks.
    """
    text = page.read_text(encoding="utf-8")
    if text.count(first) != 1 or text.count(last) != 1:
        raise FileError(f"{page}: the marks {first} and {last} must each stand there once; put them back")
    before, rest = text.split(first)
    write_changed(page, before + block + rest.split(last)[1])


def write_changed(path: Path, text: str) -> None:
    """Write a text unless the file holds it already."""
    if not path.is_file() or path.read_bytes() != text.encode():
        write_text(path, text)
