"""Filling a groove in several passes: beads of equal size in layers, the wire's tip on what already lies there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.motion.trajectory import ToolTrajectoryOptions, tool_trajectory
from grindvision.records import by_content
from grindvision.words import counted

Floats = NDArray[np.float64]

#: A bead lies about so many times as wide as it is high.
BEAD_ASPECT = 2.0

#: A bead is at most so much larger than asked for, so that beads of one size fill the groove.
LARGEST_BEAD = 1.1

MAX_PASSES = 99


@dataclass(frozen=True)
class GrooveSection:
    """Cross-section of a groove, mm: straight walls from the root to the edges.

    ``left_mm`` and ``right_mm`` are how far the edges stand out from the root's middle to either side, ``depth_mm`` how
    deep it is, ``gap_mm`` the width of the root.
    """

    left_mm: float
    right_mm: float
    depth_mm: float
    gap_mm: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("depth", self.depth_mm), ("width", self.width_mm)):
            if not 0 < value < 1000:
                raise InputError(f"the groove's {name} is {value:.4g} mm; give a length above 0")
        if not (0 <= self.gap_mm / 2 <= min(self.left_mm, self.right_mm)):
            raise InputError(
                f"a root {self.gap_mm:.4g} mm wide between edges {self.left_mm:.4g} and {self.right_mm:.4g} mm from its"
                " middle; a groove opens towards its edges"
            )

    @property
    def width_mm(self) -> float:
        """From edge to edge."""
        return self.left_mm + self.right_mm

    @property
    def area_mm2(self) -> float:
        """Area to be filled, level with the edges."""
        return (self.gap_mm + self.width_mm) / 2 * self.depth_mm

    def walls_mm(self, height_mm: float) -> tuple[float, float]:
        """How far the left and the right wall are from the root's middle at a height over the root."""
        fraction, half = height_mm / self.depth_mm, self.gap_mm / 2
        return half + fraction * (self.left_mm - half), half + fraction * (self.right_mm - half)

    def height_mm(self, area_mm2: float) -> float:
        """Height over the root up to which an area fills the groove."""
        slope = (self.width_mm - self.gap_mm) / self.depth_mm
        if slope < 1e-9:
            return area_mm2 / self.gap_mm
        return float((np.sqrt(self.gap_mm**2 + 2 * slope * area_mm2) - self.gap_mm) / slope)

    def __str__(self) -> str:
        return f"groove {self.width_mm:.1f} mm wide, {self.depth_mm:.1f} mm deep, {self.area_mm2:.1f} mm2"


@dataclass(frozen=True)
class WeldPass:
    """One pass of a fill, mm: the bead's area, and where the wire's tip stands from the root's middle.

    ``right_mm`` is to the right of the way along the seam, ``up_mm`` against the torch. ``speed_factor``: the speed
    along the seam by which the bead gets its area, against the one that lays the bead asked for.
    """

    number: int
    layer: int
    area_mm2: float
    right_mm: float
    up_mm: float
    speed_factor: float

    def __str__(self) -> str:
        return (
            f"pass {self.number}, layer {self.layer}: {self.area_mm2:.1f} mm2, {self.right_mm:+.1f} mm right,"
            f" {self.up_mm:.1f} mm up"
        )


@by_content
@dataclass(frozen=True)
class WeldFill:
    """Passes that fill a ``section``, in the order they are welded; ``layer_tops_mm`` are heights over the root."""

    section: GrooveSection
    passes: tuple[WeldPass, ...]
    layer_tops_mm: tuple[float, ...]

    def __str__(self) -> str:
        passes, layers = counted(len(self.passes), "pass", "passes"), counted(len(self.layer_tops_mm), "layer")
        return f"{passes} in {layers} for a {self.section}"


def fill_groove(section: GrooveSection, bead_mm2: float) -> WeldFill:
    """Beads of one size, near the one asked for, that fill a groove layer by layer from the root.

    A layer takes as many beads side by side as keep about twice as wide as high. The size is the groove's section over
    the number of beads, so that their areas add up to the section; reinforcement above the edges is not
    counted. The tip stands on the layer below, or on the wall where that is higher; a single root pass is led along the
    root.

    Args:
        section: the groove's cross-section, mm.
        bead_mm2: cross-section of the bead that the feed lays at the speed asked for, mm2.

    Raises:
        InputError: a bead of no size, or one so small that more than 99 passes are needed.
    """
    if not 0 < bead_mm2 < np.inf:
        raise InputError(f"a bead of {bead_mm2:g} mm2; give its cross-section in mm2, above 0")
    if section.area_mm2 / bead_mm2 > MAX_PASSES:
        raise InputError(
            f"beads of {bead_mm2:g} mm2 fill {section.area_mm2:.0f} mm2 in {section.area_mm2 / bead_mm2:.0f} passes;"
            f" {MAX_PASSES} are the most: give a larger bead"
        )
    counts = _beads_of_layers(section, bead_mm2)
    area = section.area_mm2 / sum(counts)
    passes: list[WeldPass] = []
    tops: list[float] = []
    floor = 0.0
    for layer, count in enumerate(counts, start=1):
        top = section.height_mm(area * (len(passes) + count))
        left, right = section.walls_mm((floor + top) / 2)
        for bead in range(count):
            across = -left + (left + right) * (bead + 0.5) / count if passes or count > 1 else 0.0
            up = max(floor, _wall_height(section, across))
            passes.append(WeldPass(len(passes) + 1, layer, area, across, up, bead_mm2 / area))
        tops.append(top)
        floor = top
    return WeldFill(section, tuple(passes), tuple(tops))


def shifted_seam(
    positions_mm: ArrayLike, normals: ArrayLike, closed: bool, right_mm: float, up_mm: float
) -> tuple[Floats, Floats]:
    """Way points (N, 3) moved to the right of the way along the seam and up along the normals, and the unit normals.

    Raises:
        InputError, DegenerateError: as ``tool_trajectory``.
    """
    frames = tool_trajectory(positions_mm, normals, ToolTrajectoryOptions(closed=closed)).T_base_tool
    outward = -frames[:, :3, 2]
    return frames[:, :3, 3] + right_mm * frames[:, :3, 1] + up_mm * outward, outward


def _beads_of_layers(section: GrooveSection, bead_mm2: float) -> list[int]:
    """Beads side by side in each layer from the root: of all ways to stack them, the one whose beads keep their shape.

    The cost of a layer is, for each of its beads, the square of the logarithm of how far its width over its height is
    from ``BEAD_ASPECT``; the cheapest stack is found from the top layer down (dynamic programming).
    """
    total = max(1, int(np.ceil(section.area_mm2 / (LARGEST_BEAD * bead_mm2) - 1e-9)))
    heights = [section.height_mm(section.area_mm2 * laid / total) for laid in range(total + 1)]
    cost, count = np.zeros(total + 1), np.zeros(total + 1, dtype=int)
    for laid in range(total - 1, -1, -1):
        beads = np.arange(1, total - laid + 1)
        high = np.array(heights[laid + 1 :]) - heights[laid]
        wide = np.array([sum(section.walls_mm(heights[laid] + part / 2)) for part in high]) / beads
        costs = beads * np.log(wide / high / BEAD_ASPECT) ** 2 + cost[laid + 1 :]
        count[laid], cost[laid] = beads[costs.argmin()], costs.min()
    stack: list[int] = []
    while sum(stack) < total:
        stack.append(int(count[sum(stack)]))
    return stack


def _wall_height(section: GrooveSection, across_mm: float) -> float:
    """Height of the wall at a place across the groove, 0 over the root."""
    half, edge = section.gap_mm / 2, section.left_mm if across_mm < 0 else section.right_mm
    if abs(across_mm) <= half or edge - half < 1e-9:
        return 0.0
    return section.depth_mm * (abs(across_mm) - half) / (edge - half)
