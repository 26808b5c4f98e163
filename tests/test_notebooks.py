"""The chapters as they are committed, and the figures that they rebuild from empty."""

from pathlib import Path

import nbformat
import pytest

from grindvision_book.machinery.agreement import disagreements, files_in
from grindvision_book.machinery.chapters import chapters
from grindvision_book.machinery.committed import committed_figures
from grindvision_book.machinery.contents import listed
from grindvision_book.machinery.one_at_a_time import only_build
from grindvision_book.machinery.places import BUILD, NOTEBOOKS
from grindvision_book.machinery.rebuilding import rebuild

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


@pytest.mark.full
def test_rebuilt_figures_agree_with_the_committed_ones(tmp_path: Path) -> None:
    """From an empty folder; chapters of which nothing has changed since this machine built them are not run again."""
    with only_build(BUILD):
        outcomes = rebuild(figures=tmp_path / "figures")
    print(*outcomes, sep="\n")
    assert [str(outcome) for outcome in outcomes if outcome.failure] == []
    rebuilt, committed = files_in(tmp_path / "figures"), committed_figures().files
    rebuilt, committed = ({name: files[name] for name in files if name in listed()} for files in (rebuilt, committed))
    assert disagreements(rebuilt, committed) == []
