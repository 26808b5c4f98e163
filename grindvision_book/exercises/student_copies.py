"""Student copies of the exercises: the masters with the solutions cut out."""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.errors import FileError
from grindvision.files import write_text
from grindvision_book.machinery.places import NOTEBOOKS

if TYPE_CHECKING:
    from nbformat import NotebookNode

MASTERS = NOTEBOOKS / "solutions"
STUDENTS = NOTEBOOKS / "exercises"

BEGIN, END = "### BEGIN SOLUTION", "### END SOLUTION"

_SOLUTION = re.compile(rf"^([ \t]*){BEGIN}\n.*?^[ \t]*{END}[ \t]*$", re.DOTALL | re.MULTILINE)


def student_copy(master: NotebookNode) -> NotebookNode:
    """A master without its solutions: each marked region becomes ``...``, cells of nothing else and outputs go.

    Raises:
        FileError: a region that begins and does not end, or the other way round; the message has the cell's id.
    """
    made = copy.deepcopy(master)
    kept = []
    for cell in made.cells:
        source = _SOLUTION.sub(r"\1...", cell.source)
        if BEGIN in source or END in source:
            raise FileError(f"cell {cell.get('id', '?')}: every {BEGIN} needs its {END} below it, each in its own line")
        if source.strip() == "..." or "solution" in cell.metadata.get("tags", []):
            continue
        cell.source = source
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
        kept.append(cell)
    made.cells = kept
    return made


def write_student_copies(masters: Path = MASTERS, students: Path = STUDENTS) -> list[Path]:
    """Write the student copy of every master notebook, and return their paths.

    Raises:
        FileError: no master there, a damaged one, or no write permission; copies before it are written then.
    """
    from grindvision_book.machinery.notebook_files import nbformat

    found = sorted(path for path in masters.glob("*.ipynb"))
    if not found:
        raise FileError(f"{masters}: no notebook there; the masters of the exercises belong there")
    written = []
    for path in found:
        try:
            made = student_copy(nbformat.read(path, as_version=4))
        except (ValueError, FileError) as error:
            raise FileError(f"{path}: {error}") from None
        write_text(students / path.name, nbformat.writes(made) + "\n")
        written.append(students / path.name)
    return written
