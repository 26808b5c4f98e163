"""The scripts of ``examples/``: each runs, uses the front door alone, and is listed in the README."""

import ast
import runpy
import warnings
from pathlib import Path

import pytest

import grindvision
from grindvision_book.site.examples import EXAMPLES, ORDER, examples_page, title_of

README = (EXAMPLES.parent / "README.md").read_text(encoding="utf-8")

#: What each prints when it works.
SAYS = {
    "read_a_cloud": "4,131 points over 160.0 x 100.0 x 0.0 mm",
    "register_two_scans": "farthest point from where it belongs: 0.",
    "find_what_to_grind": "1 bead, 8 path points",
    "grind_a_bead": "1 piece of stock",
    "find_grooves": "groove of ",
    "weld_a_fillet": "t-joint, faces 90.0",
    "torch_trajectory": "torch.csv: 12 poses",
    "robot_programme": "weld.script and weld.csv",
    "calibrate_a_cell": "test rows after:  mean 0.",
    "verify_a_calibration": "FAIL: 95 % of 60 shots",
    "correct_a_scanner": "corrected by 0.02 mm",
}


def test_all_are_listed():
    assert sorted(path.stem for path in EXAMPLES.glob("*.py")) == sorted(ORDER) == sorted(SAYS)
    assert all(f"(examples/{name}.py)" in README for name in ORDER)
    assert all(title_of(name).count("\n") == 0 and title_of(name) in examples_page() for name in ORDER)


@pytest.mark.parametrize("name", ORDER)
def test_an_example_uses_the_front_door_alone(name):
    for node in ast.walk(ast.parse((EXAMPLES / f"{name}.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            assert all(alias.name in ("numpy", "dataclasses") for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            assert node.module == "grindvision"
            assert {alias.name for alias in node.names} <= set(grindvision.__all__)


@pytest.mark.parametrize("name", ORDER)
def test_an_example_runs(name, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert SAYS[name] in capsys.readouterr().out
