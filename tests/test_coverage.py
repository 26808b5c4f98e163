"""The script that holds every room to its floor of statements run."""

import json
from pathlib import Path

import pytest

from tests.coverage_by_room import complaints, covered_by_room, main, raised, read_floors, room_of

ROOT = Path(__file__).resolve().parent.parent


def report(**files: tuple[int, int]) -> dict[str, object]:
    return {
        "files": {path: {"summary": {"covered_lines": ran, "num_statements": of}} for path, (ran, of) in files.items()}
    }


def test_a_room_is_its_folder_and_vision_has_rooms_of_its_own():
    assert room_of("grindvision/errors.py") == "grindvision"
    assert room_of("grindvision/cli/detect.py") == "grindvision/cli"
    assert room_of("grindvision/vision/seam/gfh.py") == "grindvision/vision/seam"
    assert room_of("grindvision_book/chapter_05/success_map.py") == "grindvision_book/chapter_05"


def test_statements_of_a_room_are_counted_together_not_averaged_by_file():
    rooms = covered_by_room(report(**{"a/b/x.py": (1, 1), "a/b/y.py": (0, 9), "a/c/z.py": (0, 0)}))
    assert rooms == {"a/b": (1, 10)}
    with pytest.raises(ValueError, match="no file"):
        covered_by_room({"files": {}})


def test_below_the_floor_and_a_floor_without_a_room_are_told():
    rooms = {"a": (90, 100), "b": (899, 1000), "c": (1, 100)}
    said = complaints(rooms, {"a": 90.0, "b": 90.0, "d": 50.0})
    assert [line.split(":")[0] for line in said] == ["b", "d"]
    assert "89.9 % of 1000" in said[0]


def test_floors_are_raised_and_never_lowered():
    rooms = {"a": (90, 100), "b": (899, 1000), "c": (1, 100)}
    floors = raised(rooms, {"a": 40.0, "b": 90.0})
    assert floors == {"a": 88.0, "b": 90.0, "c": 0.0}
    assert raised(rooms, floors) == floors


def test_the_command_fails_where_a_room_falls_below(tmp_path, capsys):
    floors = read_floors()
    for missed, code in ((0, 0), (1000, 1)):
        files = {f"{room}/x.py": (1000 - missed * (number == 0), 1000) for number, room in enumerate(floors)}
        (tmp_path / "coverage.json").write_text(json.dumps(report(**files)))
        assert main([str(tmp_path / "coverage.json")]) == code
    assert capsys.readouterr().err.startswith(f"{next(iter(floors))}: 0.0 %")


def test_every_floor_has_its_room():
    packages = [ROOT / "grindvision", ROOT / "grindvision_book"]
    rooms = {room_of(path.relative_to(ROOT).as_posix()) for package in packages for path in package.rglob("*.py")}
    assert set(read_floors()) <= rooms
