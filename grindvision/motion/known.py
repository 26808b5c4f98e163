"""The arms of ``data/robots/robots.json``: read without the libraries that move them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache

import numpy as np

from grindvision.arm import MdhArm, read_arm
from grindvision.data_files import data_folder


@dataclass(frozen=True)
class KnownRobot:
    """An arm whose table comes with the package: its maker's ``language``, and where its numbers are from.

    ``T_last_flange`` and ``T_controller_base`` are rows of 4x4 matrices, mm.
    """

    name: str
    maker: str
    model: str
    table: str
    language: str
    T_last_flange: tuple[tuple[float, ...], ...]
    T_controller_base: tuple[tuple[float, ...], ...]
    source: str

    @property
    def reach_mm(self) -> float:
        """Lengths of all links from axis 2 to the flange, mm: a bound of the reach, not the maker's figure."""
        table = self.arm.table
        links = float(np.hypot(table[2:, 1], table[2:, 2]).sum())
        return links + float(np.linalg.norm(np.array(self.T_last_flange)[:3, 3]))

    @property
    def arm(self) -> MdhArm:
        """The arm of its table."""
        return read_arm(data_folder() / "robots" / self.table)

    def __str__(self) -> str:
        return f"{self.name}: {self.maker} {self.model}, --program {self.language}"


@cache
def known_robots() -> dict[str, KnownRobot]:
    """The arms of ``data/robots/robots.json`` by name, beside ``ur3``, which has a URDF with meshes."""
    rows = json.loads((data_folder() / "robots" / "robots.json").read_text(encoding="utf-8"))
    matrices = ("T_last_flange", "T_controller_base")
    return {
        row["name"]: KnownRobot(**{**row, **{key: tuple(map(tuple, row[key])) for key in matrices}}) for row in rows
    }
