import ast
import dataclasses
import doctest
import importlib
import inspect
import json
import re
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import grindvision
from tests.groove_scenes import straight_groove

FACES = ["", "geometry", "arm", "calibration", "cell", "vision", "motion", "paper"]


@pytest.mark.parametrize("face", FACES)
def test_every_name_of_a_face_is_there(face):
    module = importlib.import_module(f"grindvision.{face}".rstrip("."))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all(getattr(module, name) is not None for name in module.__all__)


@pytest.mark.parametrize(
    ("face", "old", "new"),
    [
        ("geometry", "turn_vectors", "rotate_vectors"),
        ("motion", "slowly_turning", "limit_angular_speed"),
        ("motion", "turning_rad_s", "angular_speed_rad_s"),
        ("calibration", "doubt_about", "diagnose_trust"),
    ],
)
def test_an_old_name_works_and_warns(face, old, new):
    module = importlib.import_module(f"grindvision.{face}")
    with pytest.warns(DeprecationWarning, match=new):
        assert getattr(module, old) is getattr(module, new)
    assert old not in module.__all__


@pytest.mark.parametrize(
    ("old", "new"), [("find_difference", "find_change"), ("difference_paper", "find_change_paper")]
)
def test_an_old_function_keeps_its_old_order_and_warns(old, new, rng):
    vision = importlib.import_module("grindvision.vision")
    with pytest.warns(DeprecationWarning, match=f"{old} is now {new}"):
        function = getattr(vision, old)
    if old == "difference_paper":
        sample, test_in_sample = rng.normal(size=(40, 3)), rng.normal(size=(30, 3))
        kept = vision.find_change_paper(test_in_sample, sample, 0.5)
        assert (function(sample, test_in_sample, 0.5) == kept).all() and len(kept) == 30


def test_a_setting_under_its_old_name_works_and_warns():
    from grindvision import PlanMotionOptions

    with pytest.warns(DeprecationWarning, match="min_clearance_mm"):
        old = PlanMotionOptions(least_clearance_mm=4.0)
    assert old == PlanMotionOptions(min_clearance_mm=4.0)
    with pytest.warns(DeprecationWarning, match="min_clearance_mm"):
        assert old.least_clearance_mm == 4.0
    assert "least_clearance_mm" not in {one.name for one in dataclasses.fields(old)}


def test_a_name_that_never_was_is_refused():
    with pytest.raises(AttributeError, match="no_such_name"):
        importlib.import_module("grindvision.vision").no_such_name  # noqa: B018


def test_the_front_door_is_fetched_late_and_is_the_rooms_own():
    from grindvision import calibration, vision

    assert grindvision.detect is vision.detect
    assert grindvision.CalibrateOptions is calibration.Options
    loaded = "import sys, grindvision; print([name for name in sys.modules if 'numpy' in name])"
    assert subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True).stdout == "[]\n"


#: Functions of the front door, and classes that stand on their own.
FUNCTIONS = sorted(name for name in grindvision.__all__ if name.islower())
DATA = {"Cloud", "MdhArm", "Measurements", "Robot", "Trajectory"}


def options_of(name):
    return "".join(word.capitalize() for word in name.split("_")) + "Options"


def test_the_front_door_holds_functions_their_options_and_their_results():
    assert 15 <= len(FUNCTIONS) <= 25
    results = {str(inspect.signature(getattr(grindvision, name)).return_annotation) for name in FUNCTIONS}
    expected = {options_of(name) for name in FUNCTIONS} | results | DATA
    assert {name for name in grindvision.__all__ if not name.islower()} <= expected


@pytest.mark.parametrize("name", FUNCTIONS)
def test_settings_stand_in_a_frozen_class_named_after_the_function(name):
    annotations = inspect.signature(getattr(grindvision, name)).parameters
    assert ("options" in annotations) == hasattr(grindvision, options_of(name))
    if "options" in annotations:
        options = getattr(grindvision, options_of(name))
        assert dataclasses.is_dataclass(options) and options.__dataclass_params__.frozen
        assert options.__name__ in (options_of(name), "Options")


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_says_what_it_takes_and_gives(name):
    function = getattr(grindvision, name)
    text = inspect.getdoc(function) or ""
    for parameter in inspect.signature(function).parameters:
        assert f"    {parameter}: " in text, parameter
    assert inspect.signature(function).return_annotation == "None" or "Returns:\n" in text
    assert "Example:\n" in text


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_example_of_a_function_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(getattr(grindvision, name), name)
    told: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        failed, tried = doctest.DocTestRunner().run(example, out=told.append)
    assert tried >= 2 and not failed, "".join(told)


def test_settings_one_by_one_work_for_one_version_and_warn(rng):
    from grindvision import FindGroovesOptions, ToolTrajectoryOptions, find_grooves, tool_trajectory

    points, _ = straight_groove(rng)
    found = find_grooves(points, FindGroovesOptions(width_mm=10.0, viewpoint_mm=(0, 0, 0)))
    with pytest.warns(DeprecationWarning, match=r"viewpoint_mm, width_mm in FindGroovesOptions\(viewpoint_mm=\.\.\.\)"):
        assert find_grooves(points, viewpoint_mm=(0, 0, 0), width_mm=10.0) == found
    with pytest.warns(DeprecationWarning, match="viewpoint_mm, width_mm in FindGroovesOptions"):
        assert find_grooves(points, (0, 0, 0), 10.0) == found
    way, up = [(0, 0, 0), (10, 0, 0)], [(0, 0, 1)] * 2
    with pytest.warns(DeprecationWarning, match="travel_angle_rad"):
        assert tool_trajectory(way, up, travel_angle_rad=0.1) == tool_trajectory(
            way, up, ToolTrajectoryOptions(travel_angle_rad=0.1)
        )
    with pytest.raises(TypeError, match="takes 2 arguments"):
        tool_trajectory(way, up, True)
    with pytest.raises(TypeError):
        find_grooves(points, no_such_setting=1)


@pytest.mark.parametrize(("old", "new"), [("welding_torch", "motion"), ("read_field", "vision"), ("write_arm", "arm")])
def test_a_name_that_left_the_front_door_is_in_its_room(old, new):
    with pytest.warns(DeprecationWarning, match=f"{old} is now {new}.{old}"):
        assert getattr(grindvision, old) is getattr(importlib.import_module(f"grindvision.{new}"), old)


def test_every_command_has_a_function():
    from grindvision.cli import COMMANDS

    functions = {name: name.replace("-", "_") for name in COMMANDS} | {"groove": "trace_weld", "robots": "load_robot"}
    others = ("book", "study", "compile", "data")
    assert all(function in FUNCTIONS for name, function in functions.items() if name not in others)


def test_no_draw_has_a_seed_of_its_own():
    """Each comes from an argument, but for the inputs that kernels are compiled with, whose results are thrown away."""
    fixed = re.compile(r"default_rng\(\s*\d*\s*\)|RandomState|np\.random\.(?!default_rng|Generator|SeedSequence)")
    package = Path(grindvision.__file__).parent
    found = {
        file.relative_to(package).as_posix()
        for file in package.rglob("*.py")
        for line in file.read_text(encoding="utf-8").splitlines()
        if fixed.search(line) and ">>>" not in line
    }
    assert found <= {"cli/compile.py"}


ROOMS = {room: importlib.import_module(f"grindvision.{room}") for room in FACES if room}


def long_ways(code):
    """What code fetches from a module of a room although the room's face, or the front door, has it."""
    tree, rooms = ast.parse(code), {}
    for node in ast.walk(tree):
        if not isinstance(node, ast.ImportFrom) or node.module is None or not node.module.startswith("grindvision"):
            continue
        room = node.module.split(".")[1] if "." in node.module else ""
        for name in (one.name for one in node.names):
            if node.module == "grindvision" and name in ROOMS:
                rooms[next(one.asname or one.name for one in node.names if one.name == name)] = ROOMS[name]
            elif room and name in grindvision.__all__:
                yield f"from {node.module} import {name}: from grindvision"
            elif room and node.module.count(".") > 1 and room in ROOMS and name in ROOMS[room].__all__:
                yield f"from {node.module} import {name}: from grindvision.{room}"
    front = {id(getattr(grindvision, name)): name for name in grindvision.__all__}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in rooms:
            found = front.get(id(getattr(rooms[node.value.id], node.attr, None)))
            if found:
                yield f"{node.value.id}.{node.attr}: {found} of grindvision"


NOTEBOOKS = sorted(path for folder in ("notebooks", "notebooks/solutions") for path in Path(folder).glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_uses_the_front_door_where_it_has_the_name(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = "".join("".join(cell["source"]) + "\n" for cell in cells if cell["cell_type"] == "code")
    assert list(long_ways(re.sub(r"^\s*[%!].*$", "", code, flags=re.MULTILINE))) == []


def test_a_way_through_a_rooms_module_is_told():
    code = (
        "from grindvision.vision.change.detection import detect\nfrom grindvision.vision.seam.seams import find_seams"
    )
    assert [way.split(": ")[1] for way in long_ways(code)] == ["from grindvision", "from grindvision.vision"]
    assert len(list(long_ways("from grindvision import calibration\ncalibration.Options()"))) == 1
    assert list(long_ways("from grindvision import detect\nfrom grindvision.vision.seam.gfh import vote")) == []
