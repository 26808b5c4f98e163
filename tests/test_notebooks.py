"""The chapters as they are committed, and the figures that they rebuild from empty."""

import re
from pathlib import Path

import nbformat
import pytest

from grindvision_book.machinery.agreement import disagreements, files_in
from grindvision_book.machinery.chapters import LONG, chapters
from grindvision_book.machinery.committed import committed_figures
from grindvision_book.machinery.contents import listed
from grindvision_book.machinery.one_at_a_time import only_build
from grindvision_book.machinery.places import BUILD, EXECUTED, NOTEBOOKS, ROOT
from grindvision_book.machinery.rebuilding import is_up_to_date, rebuild

COMMITTED = sorted(NOTEBOOKS.rglob("*.ipynb"))
COMMITTED = [path for path in COMMITTED if ".ipynb_checkpoints" not in path.parts]


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.stem)
def test_a_notebook_is_valid_and_carries_no_outputs(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert not cell.outputs, f"{path.name} carries outputs: nbstripout {path}"
            assert cell.execution_count is None, f"{path.name} carries execution counts: nbstripout {path}"


@pytest.mark.parametrize("number, path", chapters().items(), ids=str)
def test_a_chapter_starts_under_its_own_number(number: str, path: Path) -> None:
    code = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert f'book.start("{number}")' in code[0]


def test_every_run_runs_the_long_chapters_in_the_fast_setting() -> None:
    patterns = re.findall(r"^ +notebooks/(\S+\.ipynb)", (ROOT / "run").read_text(encoding="utf-8"), re.MULTILINE)
    ran = {path.name[:2] for pattern in patterns for path in NOTEBOOKS.glob(pattern)}
    assert ran == set(LONG)


@pytest.mark.book
def test_rebuilt_figures_agree_with_the_committed_ones(tmp_path: Path) -> None:
    """From an empty folder; chapters of which nothing has changed since this machine built them are not run again."""
    numbers = [number for number in chapters() if number not in LONG or is_up_to_date(number)]
    assert rebuilt_otherwise(numbers, tmp_path / "figures") == []


@pytest.mark.full
def test_rebuilt_figures_of_all_chapters_agree_with_the_committed_ones(tmp_path: Path) -> None:
    assert rebuilt_otherwise(list(chapters()), tmp_path / "figures") == []


def rebuilt_otherwise(numbers: list[str], figures: Path) -> list[str]:
    """What fails when these chapters are rebuilt, differs from the commit, or warns in a cell."""
    committed = committed_figures()
    print(f"compared with {committed.origin}")
    figures.mkdir()
    for number in chapters().keys() - set(numbers):
        answers = f"answers_{number}.csv"
        if answers in committed.files:  # the chapter that looks back on all needs them
            (figures / answers).write_bytes(committed.files[answers])
    with only_build(BUILD):
        outcomes = rebuild(numbers, figures=figures)
    print(*outcomes, sep="\n")
    rebuilt, there = (
        {name: content for name, content in files.items() if listed().get(name) in numbers}
        for files in (files_in(figures), committed.files)
    )
    failed = [str(outcome) for outcome in outcomes if outcome.failure]
    return failed or disagreements(rebuilt, there) + [line for outcome in outcomes for line in warned(outcome.chapter)]


def warned(chapter: str) -> list[str]:
    """What the cells of an executed chapter wrote as warnings, which a reader sees in red."""
    cells = nbformat.read(EXECUTED / f"{chapter}.ipynb", as_version=4).cells
    outputs = [output for cell in cells if cell.cell_type == "code" for output in cell.outputs]
    return [f"{chapter}: {output.text}" for output in outputs if output.get("name") == "stderr"]
