"""The four weld pieces of peng2020 with a V-groove: straight and curved plate, box and cylinder."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from grindvision.cell.solids import Shape, Solid, box, check_size, swept
from grindvision.errors import InputError
from grindvision.extras import extra
from grindvision.records import by_content

with extra("sim"):
    import manifold3d as m3

Floats = NDArray[np.float64]

KINDS = ("line", "curve", "box", "cylinder")
GROOVE = "groove"

#: Spacing of the stations of a curved groove and of every root line, mm; the chords stay within 1 um of the curve.
STATION_MM = 0.5

#: The tools that cut a groove stick out of the piece by this much, mm.
CLEARANCE_MM = 2.0


@dataclass(frozen=True)
class Groove:
    """Cross-section of a V-groove: ``width_mm`` at the surface, ``depth_mm``; without ``angle_deg`` the root is sharp.

    With an opening ``angle_deg`` steeper than the sharp V's the root is a flat strip of ``root_mm``.
    """

    width_mm: float = 12.0
    depth_mm: float = 7.0
    angle_deg: float | None = None

    def __post_init__(self) -> None:
        check_size("groove width", self.width_mm)
        check_size("groove depth", self.depth_mm)
        sharp = np.degrees(2 * np.arctan(self.width_mm / 2 / self.depth_mm))
        if self.angle_deg is not None and not 0 < self.angle_deg <= sharp:
            raise InputError(
                f"groove angle is {self.angle_deg} deg; {self.width_mm} mm width and {self.depth_mm} mm depth allow"
                f" at most {sharp:.1f} deg"
            )

    @property
    def root_mm(self) -> float:
        """Width of the flat root; zero for a sharp V."""
        if self.angle_deg is None:
            return 0.0
        return self.width_mm - 2 * self.depth_mm * np.tan(np.radians(self.angle_deg) / 2)

    def cutter(self) -> Floats:
        """Outline (P, 2) of the cutting tool: across the groove and up, counter-clockwise, walls carried on upwards."""
        half, root = self.width_mm / 2, self.root_mm / 2
        top = half + CLEARANCE_MM * (half - root) / self.depth_mm
        floor = [[-root, -self.depth_mm], [root, -self.depth_mm]] if root > 0 else [[0.0, -self.depth_mm]]
        return np.array([*floor, [top, CLEARANCE_MM], [-top, CLEARANCE_MM]])

    def check_depth(self, thickness_mm: float, what: str) -> None:
        """Refuse a groove that would cut the piece apart.

        Raises:
            InputError: the groove is as deep as the piece is thick.
        """
        if not self.depth_mm < thickness_mm:
            raise InputError(
                f"the groove is {self.depth_mm} mm deep, the {what} only {thickness_mm} mm thick; make it shallower"
            )


@by_content
@dataclass(frozen=True)
class WeldPiece:
    """A piece in its own frame (mm, z up) and the truth of its groove.

    ``root_mm`` (K, 3) runs along the middle of the groove's root every half millimetre, with unit ``tangents`` (K, 3)
    and ``normals`` (K, 3), the latter halving the angle between the walls and pointing out of the groove. Triangles
    of surface ``groove`` are its walls and root.
    """

    kind: str
    groove: Groove
    solid: Solid
    root_mm: Floats
    tangents: Floats
    normals: Floats

    def __str__(self) -> str:
        length = np.linalg.norm(np.diff(self.root_mm, axis=0), axis=1).sum()
        section = f"{self.groove.width_mm} x {self.groove.depth_mm} mm"
        return f"weld piece {self.kind}: groove of {section}, {length:.0f} mm long"


@lru_cache(maxsize=8)
def weld_piece(kind: str, groove: Groove | None = None) -> WeldPiece:
    """Make one of ``KINDS`` with a groove (12 mm wide, 7 mm deep when left out), or return the one made before.

    Raises:
        InputError: unknown kind; groove deeper than the plate or wall, or wider than the piece allows.
    """
    makers = {"line": _line, "curve": _curve, "box": _box, "cylinder": _cylinder}
    if kind not in makers:
        raise InputError(f"no weld piece {kind!r}; choose one of {', '.join(KINDS)}")
    return makers[kind](groove or Groove())


def _line(groove: Groove, length: float = 270.0, breadth: float = 200.0, thickness: float = 12.0) -> WeldPiece:
    groove.check_depth(thickness, "plate")
    _check_breadth(groove, breadth)
    plate = box("plate", [-length / 2, -breadth / 2, -thickness], [length / 2, breadth / 2, 0])
    x = _stations(-length / 2, length / 2)
    return _grooved("line", groove, plate, np.column_stack([x, 0 * x, 0 * x]))


def _curve(groove: Groove, length: float = 230.0, breadth: float = 160.0, thickness: float = 12.0) -> WeldPiece:
    groove.check_depth(thickness, "plate")
    amplitude, wave = 22.0, 2 * np.pi / (1.1 * length)
    bend = 1 / (amplitude * wave**2)
    if not groove.width_mm < min(bend, breadth / 2 - amplitude):
        raise InputError(f"the groove is {groove.width_mm} mm wide; this curved plate takes less than {bend:.0f} mm")
    plate = box("plate", [-length / 2, -breadth / 2, -thickness], [length / 2, breadth / 2, 0])
    x = _stations(-length / 2, length / 2)
    return _grooved("curve", groove, plate, np.column_stack([x, amplitude * np.sin(wave * x), 0 * x]))


def _box(groove: Groove, length: float = 200.0, breadth: float = 130.0, height: float = 60.0) -> WeldPiece:
    rounding = 12.0
    groove.check_depth(height, "box")
    _check_breadth(groove, breadth - 2 * rounding)
    turn = np.linspace(0, np.pi / 2, 33)
    corners = []
    for quarter, (y, z) in enumerate([(1, 0), (-1, 0), (-1, -1), (1, -1)]):
        angle = turn + quarter * np.pi / 2
        centre = np.array([y * (breadth / 2 - rounding), z * (height - 2 * rounding) - rounding])
        corners.append(centre + rounding * np.column_stack([np.cos(angle), np.sin(angle)]))
    outline = np.concatenate(corners)
    # The profile stands in x, y of the extrusion; a cyclic swap of axes lays it into y, z along x.
    bar = m3.Manifold.extrude(m3.CrossSection([outline]), length)
    bar = bar.transform(np.array([[0.0, 0, 1, -length / 2], [1, 0, 0, 0], [0, 1, 0, 0]]))
    x = _stations(-length / 2, length / 2)
    return _grooved("box", groove, Shape.named(bar, "box"), np.column_stack([x, 0 * x, 0 * x]))


def _cylinder(groove: Groove, length: float = 200.0, radius: float = 75.0, wall: float = 12.0) -> WeldPiece:
    """Pipe along x with its top at z = 0 and the groove round its middle."""
    groove.check_depth(wall, "pipe's wall")
    _check_breadth(groove, length)
    segments = 1440
    lay = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, -radius]])

    def tube(r: float, beyond: float) -> m3.Manifold:
        half = length / 2 + beyond
        return m3.Manifold.cylinder(2 * half, r, circular_segments=segments).translate([0, 0, -half]).transform(lay)

    pipe = Shape.named(tube(radius, 0.0), "pipe") - Shape.named(tube(radius - wall, CLEARANCE_MM), "bore")
    across, up = groove.cutter().T
    ring = m3.Manifold.revolve(m3.CrossSection([np.column_stack([radius + up, across])[::-1]]), segments).transform(lay)
    solid = (pipe - Shape.named(ring, GROOVE)).solid()
    depth_radius = radius - groove.depth_mm
    angle = np.linspace(-np.pi, np.pi, int(2 * np.pi * depth_radius / STATION_MM) + 1)
    normals = np.column_stack([0 * angle, np.sin(angle), np.cos(angle)])
    tangents = np.column_stack([0 * angle, np.cos(angle), -np.sin(angle)])
    root = depth_radius * normals - [0, 0, radius]
    return WeldPiece("cylinder", groove, solid, root, tangents, normals)


def _grooved(kind: str, groove: Groove, piece: Shape, surface_line: Floats) -> WeldPiece:
    """Cut the groove along a line (K, 3) on the upper face z = 0 that runs from edge to edge of the piece."""
    tangents = np.gradient(surface_line, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = np.tile([0.0, 0.0, 1.0], (len(tangents), 1))
    left = np.cross(normals, tangents)
    ends = CLEARANCE_MM + groove.width_mm
    before, behind = surface_line[:1] - ends * tangents[:1], surface_line[-1:] + ends * tangents[-1:]
    stations = np.concatenate([before, surface_line, behind])
    left = np.concatenate([left[:1], left, left[-1:]])
    outline = groove.cutter()
    rings = stations[:, None, :] + outline[None, :, :1] * left[:, None, :] + outline[None, :, 1:] * normals[0]
    solid = (piece - swept(GROOVE, rings)).solid()
    return WeldPiece(kind, groove, solid, surface_line - groove.depth_mm * normals, tangents, normals)


def _stations(start: float, end: float) -> Floats:
    return np.linspace(start, end, int(np.ceil((end - start) / STATION_MM)) + 1)


def _check_breadth(groove: Groove, breadth: float) -> None:
    if not groove.width_mm < breadth:
        raise InputError(f"the groove is {groove.width_mm} mm wide, the piece only {breadth} mm; make it narrower")
