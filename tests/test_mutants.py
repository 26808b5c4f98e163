"""The mutation tests themselves: faults are found where they belong, chosen ones fit the code, a draw repeats."""

import ast
import csv
import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest

from mutants.__main__ import ROOT, chosen_mutants, drawn_mutants
from mutants.operators import Mutant, mutants_of
from mutants.plan import Plan, step_of
from mutants.record import Record, Verdict, key_of, statement_at
from mutants.running import in_a_kernel

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


def test_a_draw_repeats_and_its_tests_exist(monkeypatch):
    monkeypatch.setattr("mutants.__main__.mutants_of", cache(mutants_of))  # what a file has room for stays the same
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


def test_a_verdict_is_found_again_until_its_own_statement_changes(sample, tmp_path):
    record = Record(tmp_path / "verdicts.csv")
    judged = {one: Verdict(one, "killed" if at % 2 else "survived", f"tests/a.py::b[{at}]", 1.5 * at)
              for at, one in enumerate(sample)}  # fmt: skip
    assert len({key_of(SAMPLE, one) for one in sample}) == len(sample)
    for verdict in judged.values():
        record.add(SAMPLE, verdict, seed=3)
    again = Record(tmp_path / "verdicts.csv")
    assert {one: again.found(SAMPLE, one) for one in sample} == judged
    longer = SAMPLE.replace("LIMIT = 1e-9", "LIMIT = 1e-9\n\n\ndef other():\n    return None\n")
    (tmp_path / "sample.py").write_text(longer, encoding="utf-8")
    moved = mutants_of(tmp_path, "sample.py")
    assert [again.found(longer, one).outcome for one in moved] == [one.outcome for one in judged.values()]
    assert not [one for one in sample if again.found(SAMPLE.replace("+ (width", "+ (1 * width"), one)]


def test_tests_that_noticed_most_faults_of_a_file_go_first_and_then_the_cheapest(tmp_path):
    record = Record(tmp_path / "verdicts.csv")
    for at, by in enumerate(["b", "a", "b"]):
        record.add(SAMPLE, Verdict(Mutant("sample.py", at, at + 1, 1, "x", "y"), "killed", by, 1.0), seed=3)
    record.add(SAMPLE, Verdict(Mutant("other.py", 0, 1, 1, "x", "y"), "killed", "c", 1.0), seed=3)
    assert record.killers("sample.py") == ["b", "a"]
    (tmp_path / "seconds.json").write_text(json.dumps({"a": 0.5, "b": 900.0, "c": 0.01, "d": 3.0, "f": 0.02}))
    plan = Plan(tmp_path / "seconds.json", tmp_path / "last", record.killers("sample.py"))
    items = [SimpleNamespace(nodeid=name) for name in "dbfeca"]
    plan.pytest_collection_modifyitems(items)
    assert "".join(item.nodeid for item in items) == "afcedb"  # e: of unknown cost
    assert [step_of(s) for s in (0.0, 0.06, 0.1, 0.3, 2.0)] == [0, 0, 1, 2, 3]


def test_only_a_fault_in_a_kernel_or_beside_all_functions_is_in_what_is_compiled():
    text = "A = 1 + 2\n\n\n@njit(\n    cache=True)\ndef kernel(x):\n    return x + 1\n"
    text += "\n\ndef plain(x):\n    return x + 1\n"
    text += "\n\nclass Some:\n    B = 3 + 4\n\n    @property\n    def of(self):\n        return 5 + self.B\n"
    found = {text[one.start - 2 : one.end + 2]: in_a_kernel(text, one) for one in faults_in(text)}
    assert found == {"1 + 2": True, "x + 1": False, "3 + 4": True, "5 + s": False}
    kernel = text.index("x + 1") + 2
    assert in_a_kernel(text, Mutant("m.py", kernel, kernel + 1, 7, "+", "-"))
    span = statement_at(text, kernel)
    assert span is not None
    begin, end = span
    assert text[begin:end].startswith("@njit") and text[begin:end].endswith("x + 1\n")


def faults_in(text: str) -> list[Mutant]:
    """Faults of the text, all of its sums."""
    return [Mutant("m.py", at, at + 1, 1 + text.count("\n", 0, at), "+", "-") for at, c in enumerate(text) if c == "+"]
