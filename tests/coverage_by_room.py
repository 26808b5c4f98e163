"""``python -m tests.coverage_by_room REPORT [--write]``: each room's share of statements that ran, and its floor.

REPORT is what ``coverage json`` writes (``./run coverage`` makes it and calls this). The floors stand in
``coverage_floors.csv``. ``--write`` raises those that the report is well above, and gives one to rooms without.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Mapping
from pathlib import Path

from grindvision.files import write_text

FLOORS = Path(__file__).with_name("coverage_floors.csv")


def room_of(path: str) -> str:
    """The folder that a module stands in, without its sub-folders but for those of ``vision``."""
    folders = Path(path).parts[:-1]
    return "/".join(folders[: 3 if folders[1:2] == ("vision",) else 2])


def covered_by_room(report: Mapping[str, object]) -> dict[str, tuple[int, int]]:
    """Statements that ran, and all statements, of every room of a report."""
    files = report.get("files")
    if not isinstance(files, dict) or not files:
        raise ValueError("the report names no file; was it written by `coverage json`?")
    rooms: dict[str, tuple[int, int]] = {}
    for path, file in files.items():
        ran, all_of_them = rooms.get(room_of(path), (0, 0))
        summary = file["summary"]
        rooms[room_of(path)] = ran + summary["covered_lines"], all_of_them + summary["num_statements"]
    return {room: rooms[room] for room in sorted(rooms) if rooms[room][1]}


def complaints(rooms: Mapping[str, tuple[int, int]], floors: Mapping[str, float]) -> list[str]:
    """What is wrong: a room below its floor, a floor without its room."""
    said = []
    for room, (ran, all_of_them) in rooms.items():
        percent = 100 * ran / all_of_them
        if percent < floors.get(room, 0.0):
            said.append(f"{room}: {percent:.1f} % of {all_of_them} statements ran, the floor is {floors[room]:g} %")
    return said + [f"{room}: has a floor and no statements; is it gone?" for room in floors if room not in rooms]


def read_floors() -> dict[str, float]:
    """Percent of each room."""
    with open(FLOORS, encoding="utf-8", newline="") as file:
        return {row["room"]: float(row["floor_percent"]) for row in csv.DictReader(file)}


def raised(rooms: Mapping[str, tuple[int, int]], floors: Mapping[str, float]) -> dict[str, float]:
    """Floors two percent below what ran, but none lower than it was."""
    found = {room: float(max(0, 100 * ran // all_of_them - 2)) for room, (ran, all_of_them) in rooms.items()}
    return {room: max(found.get(room, 0.0), floors.get(room, 0.0)) for room in sorted({*found, *floors})}


def main(words: list[str]) -> int:
    """Print the table; 1 where something is below its floor, or a floor has lost its room."""
    rooms = covered_by_room(json.loads(Path(words[0]).read_text(encoding="utf-8")))
    floors = read_floors()
    for room, (ran, all_of_them) in rooms.items():
        floor = f"{floors[room]:g} %" if room in floors else "none yet"
        print(f"{room:42} {100 * ran / all_of_them:5.1f} %  floor {floor}")
    if "--write" in words:
        floors = raised(rooms, floors)
        rows = [f"{room},{floor:g}\n" for room, floor in floors.items()]
        write_text(FLOORS, "".join(["room,floor_percent\n", *rows]))
    said = complaints(rooms, floors)
    for line in said:
        print(line, file=sys.stderr)
    return int(bool(said))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
