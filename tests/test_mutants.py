"""The mutation tests themselves: faults are found where they belong, chosen ones fit the code, a draw repeats."""

import ast
import csv
from pathlib import Path

import pytest

from mutants.__main__ import ROOT, chosen_mutants, drawn_mutants
from mutants.operators import mutants_of

SAMPLE = '''
"""A text with 3 + 4."""
from __future__ import annotations

LIMIT = 1e-9

def area(width: float, height: float = 2.0) -> float:
    if not width > 0 or len("abc") < 3:
        raise ValueError(f"width {width + 1}")
    sides = min(width, height)  # µm and 1 + 1 in a comment
    return -sides ** 2 + (width
        - height)
'''


@pytest.fixture
def sample(tmp_path):
    (tmp_path / "sample.py").write_text(SAMPLE, encoding="utf-8")
    return mutants_of(tmp_path, "sample.py")


def test_faults_are_found_in_the_code_only(sample):
    assert {(one.before, one.after) for one in sample} == {
        ("2.0", "4.0"), ("not ", ""), (">", "<="), (">", ">="), (" or ", " and "), ("<", ">="), ("<", "<="), ("0", "1"),
        ("3", "4"), ("min", "max"), ("-", ""), ("**", "*"), ("2", "3"), ("+", "-"), ("-", "+"),
    }  # fmt: skip


def test_every_fault_changes_the_code_and_leaves_it_readable(sample):
    sound = ast.dump(ast.parse(SAMPLE))
    for one in sample:
        assert ast.dump(ast.parse(one.applied(SAMPLE))) != sound
    with pytest.raises(ValueError, match="no longer reads"):
        sample[0].applied(SAMPLE.replace("2.0", "3.0"))


def test_the_chosen_faults_fit_the_code_and_name_their_tests():
    found = list(chosen_mutants())
    assert len(found) >= 20
    for mutant, tests in found:
        text = (ROOT / mutant.path).read_text(encoding="utf-8")
        assert mutant.applied(text) != text
        for test in tests:
            name, *functions = test.split("::")
            written = (ROOT / "tests" / f"{name}.py").read_text(encoding="utf-8")
            assert all(f"def {function}(" in written for function in functions), test


def test_a_draw_repeats_and_its_tests_exist():
    one, again = drawn_mutants(300, seed=3), drawn_mutants(300, seed=3)
    assert one == again and drawn_mutants(300, seed=4) != one
    rooms = {Path(mutant.path).parts[1] for mutant, _ in one}
    assert {"geometry", "cell", "vision", "calibration"} <= rooms
    assert all((ROOT / "tests" / f"{name}.py").exists() for _, tests in one for name in tests)


def test_every_module_of_the_rooms_names_its_tests():
    with open(ROOT / "mutants/tests_of.csv", encoding="utf-8", newline="") as file:
        prefixes = [row["path"] for row in csv.DictReader(file)]
    rooms = ("geometry", "arm", "cell", "vision", "calibration", "motion")
    modules = [
        path.relative_to(ROOT).as_posix() for room in rooms for path in (ROOT / "grindvision" / room).rglob("*.py")
    ]
    without = [path for path in modules if not path.endswith(("__init__.py", "old_names.py"))]
    assert [path for path in without if not any(path.startswith(prefix) for prefix in prefixes)] == []
