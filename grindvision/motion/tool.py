"""What the arm holds: where its tip sits on the flange, and the capsules that must not touch anything."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import InputError
from grindvision.geometry import check_rigid, rigid
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Start and end point (mm, in the flange frame) and radius (mm) of a capsule.
Capsule = tuple[tuple[float, float, float], tuple[float, float, float], float]


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
    neck_mm, holder_radius_mm, nozzle_radius_mm = 60.0, 22.0, 8.0
    _check_length("welding torch", length_mm, neck_mm + wire_mm + nozzle_radius_mm + holder_radius_mm)
    nozzle_mm = length_mm - wire_mm - nozzle_radius_mm
    capsules: tuple[Capsule, ...] = (
        ((0.0, 0.0, 0.0), (0.0, 0.0, nozzle_mm - neck_mm), holder_radius_mm),
        ((0.0, 0.0, nozzle_mm - neck_mm), (0.0, 0.0, nozzle_mm), nozzle_radius_mm),
    )
    return Tool("welding torch", rigid(translation_mm=[0, 0, length_mm]), capsules)


def grinding_spindle(length_mm: float = 230.0, mount_mm: float = 80.0, stone_mm: float = 20.0) -> Tool:
    """A spindle in line with the last axis, ``length_mm`` to the tip of a stone that stands out by ``stone_mm``.

    It begins ``mount_mm`` in front of the frame it hangs on: an MDH table without a flange ends in the wrist's centre.
    """
    radius_mm = 25.0
    _check_length("grinding spindle", length_mm, mount_mm + stone_mm + 2 * radius_mm)
    body: Capsule = ((0.0, 0.0, mount_mm + radius_mm), (0.0, 0.0, length_mm - stone_mm - radius_mm), radius_mm)
    return Tool("grinding spindle", rigid(translation_mm=[0, 0, length_mm]), (body,))


def _check_length(name: str, length_mm: float, least_mm: float) -> None:
    if not length_mm > least_mm:
        raise InputError(f"a {name} of {length_mm:.4g} mm is shorter than its parts; give more than {least_mm:.4g} mm")
