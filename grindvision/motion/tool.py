"""What the arm holds: where its tip sits on the flange, and the capsules that must not touch anything."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import FileError, InputError, UnitError
from grindvision.files import read_json
from grindvision.geometry import check_rigid, rigid
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Start and end point (mm, in the flange frame) and radius (mm) of a capsule.
Capsule = tuple[tuple[float, float, float], tuple[float, float, float], float]

#: A welding torch: length of its neck, radii of its holder and its nozzle, mm.
NECK_MM, HOLDER_RADIUS_MM, NOZZLE_RADIUS_MM = 60.0, 22.0, 8.0


@by_content
@dataclass(frozen=True)
class Tool:
    """A tool on the flange: ``T_flange_tool`` (4, 4) in mm leads to its tip, whose z axis points out into the work.

    ``capsules`` are its body for the collision check, in the flange frame; the tip itself stays outside, for it has to
    touch the work.
    """

    name: str
    T_flange_tool: Floats
    capsules: tuple[Capsule, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_flange_tool", check_rigid(self.T_flange_tool, "T_flange_tool"))
        for start, end, radius_mm in self.capsules:
            if not (radius_mm > 0 and np.linalg.norm(np.subtract(end, start)) > 0):
                raise InputError(
                    f"a capsule of {self.name} has radius {radius_mm:.4g} mm or no length; give both above 0"
                )

    def __str__(self) -> str:
        return f"{self.name}, tip {np.linalg.norm(self.T_flange_tool[:3, 3]):.0f} mm from the flange"


def welding_torch(length_mm: float = 160.0, wire_mm: float = 15.0) -> Tool:
    """A straight machine torch: ``length_mm`` from flange to wire tip, of which ``wire_mm`` stand out of the nozzle."""
    _check_length("welding torch", length_mm, NECK_MM + wire_mm + NOZZLE_RADIUS_MM + HOLDER_RADIUS_MM)
    nozzle_mm = length_mm - wire_mm - NOZZLE_RADIUS_MM
    capsules: tuple[Capsule, ...] = (
        ((0.0, 0.0, 0.0), (0.0, 0.0, nozzle_mm - NECK_MM), HOLDER_RADIUS_MM),
        ((0.0, 0.0, nozzle_mm - NECK_MM), (0.0, 0.0, nozzle_mm), NOZZLE_RADIUS_MM),
    )
    return Tool("welding torch", rigid(translation_mm=[0, 0, length_mm]), capsules)


def read_torch(path: str | Path, wire_mm: float = 15.0) -> Tool:
    """A torch, straight or bent, from a JSON file: ``T_flange_tcp`` (4, 4), mm, to the wire's tip, z out of the wire.

    Its body for the collision check is an estimate: a holder from the flange to where the neck begins, and the neck
    of 60 mm, in line with the wire, up to the nozzle, out of which ``wire_mm`` stand.

    Raises:
        FileError: missing, no JSON, no such key. NotRigidError: no rigid transform. UnitError: metres, by its size.
        InputError: the tip is nearer to the flange than a torch is long.
    """
    tip, length_mm = _read_tip(path, "the wire's tip")
    _check_length("welding torch", length_mm, NECK_MM + wire_mm + NOZZLE_RADIUS_MM + HOLDER_RADIUS_MM)
    if tip[2, 3] <= 0:
        raise InputError(
            f"{path}: the wire's tip lies {-tip[2, 3]:.0f} mm behind the flange; its z points into the tool"
        )
    nozzle = tip[:3, 3] - (wire_mm + NOZZLE_RADIUS_MM) * tip[:3, 2]
    bend = nozzle - NECK_MM * tip[:3, 2]
    start, elbow, end = ((float(x), float(y), float(z)) for x, y, z in ([0.0, 0.0, 0.0], bend, nozzle))
    return Tool("welding torch", tip, ((start, elbow, HOLDER_RADIUS_MM), (elbow, end, NOZZLE_RADIUS_MM)))


def grinding_spindle(length_mm: float = 230.0, mount_mm: float = 80.0, stone_mm: float = 20.0) -> Tool:
    """A spindle in line with the last axis, ``length_mm`` to the tip of a stone that stands out by ``stone_mm``.

    It begins ``mount_mm`` in front of the frame it hangs on: an MDH table without a flange ends in the wrist's centre.
    """
    radius_mm = 25.0
    _check_length("grinding spindle", length_mm, mount_mm + stone_mm + 2 * radius_mm)
    body: Capsule = ((0.0, 0.0, mount_mm + radius_mm), (0.0, 0.0, length_mm - stone_mm - radius_mm), radius_mm)
    return Tool("grinding spindle", rigid(translation_mm=[0, 0, length_mm]), (body,))


def read_spindle(path: str | Path, stone_mm: float = 20.0) -> Tool:
    """A spindle from a JSON file: ``T_flange_tcp`` (4, 4), mm, to the wheel's lowest point, z into the work.

    Its body for the collision check is an estimate: a housing of 25 mm radius from the flange to ``stone_mm`` and its
    own radius short of the tip.

    Raises:
        FileError: missing, no JSON, no such key. NotRigidError: no rigid transform. UnitError: metres, by its size.
        InputError: the tip is nearer to the flange than a spindle is long.
    """
    tip, length_mm = _read_tip(path, "the tip")
    radius_mm = 25.0
    _check_length("grinding spindle", length_mm, stone_mm + 2 * radius_mm)
    end = tip[:3, 3] * (1 - (stone_mm + radius_mm) / length_mm)
    return Tool("grinding spindle", tip, (((0.0, 0.0, 0.0), (float(end[0]), float(end[1]), float(end[2])), radius_mm),))


def _read_tip(path: str | Path, what: str) -> tuple[Floats, float]:
    """``T_flange_tcp`` (4, 4) of a JSON file, alone or by its key, and how far the tip is from the flange, mm."""
    content = read_json(path)
    if isinstance(content, dict):
        if "T_flange_tcp" not in content:
            raise FileError(f"{path}: no key T_flange_tcp; found {', '.join(list(content)[:8])[:80] or 'none'}")
        content = content["T_flange_tcp"]
    tip = check_rigid(content, f"{path}: T_flange_tcp", tolerance=1e-3)
    length_mm = float(np.linalg.norm(tip[:3, 3]))
    if 0 < length_mm < 2.0:
        raise UnitError(f"{path}: {what} is {length_mm:.3g} mm from the flange: metres? give millimetres")
    return tip, length_mm


def _check_length(name: str, length_mm: float, min_mm: float) -> None:
    if not length_mm > min_mm:
        raise InputError(f"a {name} of {length_mm:.4g} mm is shorter than its parts; give more than {min_mm:.4g} mm")
