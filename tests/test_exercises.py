"""The exercises: masters are right, stubs are "not yet", every planted mistake gets its own hint, copies are fresh."""

import ast
import re
import sys
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from IPython.core.interactiveshell import InteractiveShell
from traitlets.config import Config

import grindvision_book as book
from grindvision.errors import FileError, InputError
from grindvision_book.exercises.checking import SLIPS, Exercise, exercises_of
from grindvision_book.exercises.guide import DIFFICULTY, FIRST, GUIDE, LAST, mistakes_block, stars, write_guide
from grindvision_book.exercises.student_copies import MASTERS, STUDENTS, student_copy, write_student_copies
from grindvision_book.machinery.chapters import chapters

MASTER_NOTEBOOKS = sorted(MASTERS.glob("*.ipynb"))
CHAPTERS = [path.name[:2] for path in MASTER_NOTEBOOKS]
EXERCISES = [task for chapter in CHAPTERS for task in exercises_of(chapter)]
PLANTED = [(task, mistake) for task in EXERCISES for mistake in task.mistakes]


@pytest.fixture
def shell(monkeypatch) -> InteractiveShell:
    """A shell as a kernel has one, which remembers nothing on disk and leaves this process's main module alone."""
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])
    return InteractiveShell(config=Config({"HistoryManager": {"enabled": False}}))


def states_of(notebook: Path, shell: InteractiveShell) -> dict[str, str]:
    """What the checks of a notebook say when its cells run one after the other: exercise number -> state.

    `./run laws` runs each notebook in a kernel of its own.
    """
    shell.reset()
    states: dict[str, str] = {}
    with redirect_stdout(StringIO()):
        for cell in nbformat.read(notebook, as_version=4).cells:
            if cell.cell_type == "code":
                done = shell.run_cell(cell.source)
                done.raise_error()
                if cell.source.startswith("book.check("):
                    states[done.result.number] = done.result.state
    return states


@cache
def student_cells(chapter: str) -> tuple[dict[str, Any], dict[str, ast.Call]]:
    """The names of a student copy after all its stubs have run, and its calls of the checker by exercise."""
    path = next(STUDENTS.glob(f"{chapter}_*.ipynb"))
    sources = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    names: dict[str, Any] = {}
    exec(
        compile("\n\n".join(source for source in sources if "def " in source or "import " in source), path, "exec"),
        names,
    )
    calls = [ast.parse(source).body[0].value for source in sources if source.startswith("book.check(")]
    return names, {call.args[0].value: call for call in calls}


@pytest.mark.parametrize("task, mistake", PLANTED, ids=lambda x: getattr(x, "number", None) or x.name)
def test_a_student_copy_with_a_planted_mistake_gets_its_own_hint(task: Exercise, mistake: Any) -> None:
    names, calls = student_cells(task.number[:2])
    call = calls[task.number]
    wrong = names | {ast.unparse(call.args[1]): mistake.variant}
    checked = eval(ast.unparse(call), wrong)
    assert (checked.state, checked.mistake) == ("wrong", mistake.name)
    assert mistake.hint in str(checked)


@pytest.mark.parametrize("task", EXERCISES, ids=lambda task: task.number)
def test_the_right_function_passes_and_hints_differ(task: Exercise) -> None:
    assert book.check(task.number, task.right).state == "right"
    assert len({mistake.hint for mistake in task.mistakes}) == len(task.mistakes) >= 3


@pytest.mark.parametrize("path", MASTER_NOTEBOOKS, ids=lambda path: path.stem)
def test_solutions_are_right_and_stubs_are_not_yet(path: Path, shell: InteractiveShell) -> None:
    numbers = [task.number for task in exercises_of(path.name[:2])]
    assert 3 <= len(numbers) <= 7
    assert list(states_of(path, shell).items()) == [(number, "right") for number in numbers]
    assert list(states_of(STUDENTS / path.name, shell).items()) == [(number, "not yet") for number in numbers]
    assert set(book.progress(path.name[:2])["state"]) == {"not yet"}


#: Chapter 00 rebuilds nothing; the data of chapter 13 are not in the repository, so nothing in it can be checked.
WITHOUT_EXERCISES = {"00", "13"}


def test_every_chapter_that_rebuilds_something_has_exercises_and_links_to_them() -> None:
    for number, chapter in chapters().items():
        if number in WITHOUT_EXERCISES:
            continue
        text = "\n".join(cell.source for cell in nbformat.read(chapter, as_version=4).cells)
        assert f"](exercises/{chapter.name})" in text, f"{chapter.name} has no link to its exercises"
        assert (STUDENTS / chapter.name).exists() and (MASTERS / chapter.name).exists()


def test_student_copies_are_fresh(tmp_path: Path) -> None:
    made = write_student_copies(students=tmp_path)
    assert [path.name for path in made] == [path.name for path in sorted(STUDENTS.glob("*.ipynb"))]
    for path in made:
        committed = (STUDENTS / path.name).read_text(encoding="utf-8")
        assert path.read_text(encoding="utf-8") == committed, "stale: run python -m grindvision_book.exercises"


def test_the_teachers_guide_lists_every_exercise_and_every_mistake(tmp_path: Path) -> None:
    text = GUIDE.read_text(encoding="utf-8")
    assert mistakes_block(CHAPTERS) in text, "stale: run python -m grindvision_book.exercises"
    by_hand = text.split(FIRST)[0]
    assert [task.number for task in EXERCISES if f" {task.number} " not in by_hand] == []
    (tmp_path / "guide.md").write_text(f"before\n{FIRST}\nold\n{LAST}\nafter\n", encoding="utf-8")
    made = write_guide(["03"], tmp_path / "guide.md").read_text(encoding="utf-8")
    assert made == f"before\n{mistakes_block(['03'])}\nafter\n"
    (tmp_path / "guide.md").write_text("no marks", encoding="utf-8")
    with pytest.raises(FileError, match="put them back"):
        write_guide(["03"], tmp_path / "guide.md")


@pytest.mark.parametrize("path", sorted(STUDENTS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_student_copy_shows_no_solution_and_imports_public_names_only(path: Path) -> None:
    for cell in nbformat.read(path, as_version=4).cells:
        assert "SOLUTION" not in cell.source and "solution" not in cell.metadata.get("tags", [])
        if cell.cell_type == "code":
            for node in ast.walk(ast.parse(cell.source)):
                if isinstance(node, ast.ImportFrom | ast.Import):
                    names = [getattr(node, "module", "") or "", *(alias.name for alias in node.names)]
                    assert not any(part.startswith("_") for name in names for part in name.split("."))


def notebook_of(*sources: str) -> nbformat.NotebookNode:
    return nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in sources])


def test_a_solution_is_cut_out_at_its_own_indentation() -> None:
    master = notebook_of(
        "def f(x):\n    ### BEGIN SOLUTION\n    y = x\n    return y\n    ### END SOLUTION\n\n\nf(1)",
        "### BEGIN SOLUTION\nassert f(1) == 1\n### END SOLUTION",
    )
    made = student_copy(master)
    assert [cell.source for cell in made.cells] == ["def f(x):\n    ...\n\n\nf(1)"]
    assert "return y" in master.cells[0].source
    assert student_copy(made) == made


@pytest.mark.parametrize("source", ["### BEGIN SOLUTION\nx = 1", "x = 1\n### END SOLUTION"])
def test_a_solution_without_an_end_is_refused_and_nothing_is_written(source: str, tmp_path: Path) -> None:
    (tmp_path / "masters").mkdir()
    nbformat.write(notebook_of(source), tmp_path / "masters" / "03_x.ipynb")
    with pytest.raises(FileError, match="END SOLUTION"):
        write_student_copies(tmp_path / "masters", tmp_path / "students")
    assert not (tmp_path / "students").exists()


def test_what_the_checker_does_not_know_is_said_as_it_is() -> None:
    assert "shape (4, 4)" in str(book.check("03-1", lambda pose: pose[:3, :3]))
    assert "NaN" in str(book.check("03-1", lambda pose: np.full((4, 4), np.nan)))
    assert "ZeroDivisionError" in str(book.check("03-1", lambda pose: 1 / 0))
    assert "off by up to" in str(book.check("03-1", lambda pose: np.eye(4) + 0.123))
    one_bad = iter([np.zeros((4, 4))])
    assert "4 of 5 cases are right; case 1 " in str(book.check("03-1", lambda pose: next(one_bad, np.linalg.inv(pose))))
    assert "cannot be read" in str(book.check("03-1", lambda pose: "done"))


@pytest.mark.parametrize("slip", SLIPS, ids=lambda slip: slip.name)
def test_slips_of_any_number_are_named(slip: Any) -> None:
    task = next(task for task in EXERCISES if task.number == "03-4")
    checked = book.check("03-4", lambda *case: slip.variant(np.asarray(task.right(*case), dtype=float)))
    assert (checked.state, checked.mistake) == ("wrong", slip.name)


def test_a_check_leaves_the_cases_as_they_were_and_refuses_what_is_no_function() -> None:
    def spoiling(pose: np.ndarray) -> np.ndarray:
        turned = np.linalg.inv(pose)
        pose[:] = 0
        return turned

    assert book.check("03-1", spoiling).state == "right"
    with pytest.raises(InputError, match="function itself"):
        book.check("03-1", np.eye(4))
    with pytest.raises(InputError, match="03-1, 03-2"):
        book.check("03-99", np.eye)
    with pytest.raises(InputError, match="no exercises"):
        book.check("77-1", np.eye)


def test_the_lessons_give_an_exercise_the_difficulty_of_the_guide() -> None:
    lessons = GUIDE.with_name("lessons.md").read_text(encoding="utf-8")
    said = re.findall(r"(\d\d-\d) \((★+)\)", lessons)
    assert len(said) >= 8 and all(stars(number) == given for number, given in said)
    judged = {chapter: len(digits) for chapter, digits in DIFFICULTY.items()}
    assert judged == {chapter: len(exercises_of(chapter)) for chapter in judged}
