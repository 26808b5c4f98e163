"""Workpieces other than the book's plate: bracket, flange, gear, blade, shaft, tray, sheet and casting of random size.

Each lies with the face that is scanned upwards (z) about the origin, and has a place where a bead may run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.cell.solids import Shape, box, height_field
from grindvision.errors import InputError
from grindvision.extras import extra

with extra("sim"):
    import manifold3d as m3

Floats = NDArray[np.float64]
Segment = tuple[tuple[float, float], tuple[float, float]]

MARK = "mark"
"""Surface without which a part that is nearly symmetric has more than one pose: a pin, a key slot, a cut-out."""

BODY = "body"


@dataclass(frozen=True)
class Workpiece:
    """A good part: its ``shape``; ``seat`` (two places in x, y, mm) over which the upper face is free and smooth;
    ``marked``: only its surface ``MARK`` fixes its pose."""

    kind: str
    shape: Shape
    seat: Segment
    marked: bool = False

    def __str__(self) -> str:
        return f"{self.kind}: {self.shape.solid()}"


def workpiece(kind: str, rng: np.random.Generator) -> Workpiece:
    """A part of one of ``WORKPIECES``, its sizes drawn by ``rng``.

    Raises:
        InputError: unknown kind.
    """
    if kind not in WORKPIECES:
        raise InputError(f"no workpiece {kind!r}; there are {', '.join(WORKPIECES)}")
    return WORKPIECES[kind](rng)


def _cylinder(radius: float, low: float, high: float, x: float = 0.0, y: float = 0.0, sides: int = 96) -> m3.Manifold:
    return m3.Manifold.cylinder(high - low, radius, radius, sides).translate([x, y, low])


def _boss(radius: float, low: float, high: float, x: float, y: float) -> Shape:
    return Shape.named(_cylinder(radius, low, high, x, y), BODY)


def _rod(radius: float, left: float, right: float) -> m3.Manifold:
    """A cylinder along x."""
    return m3.Manifold.cylinder(right - left, radius, radius, 128).rotate([0, 90, 0]).translate([left, 0, 0])


def _bracket(rng: np.random.Generator) -> Workpiece:
    length, breadth, high, thick = rng.uniform(90, 130), rng.uniform(60, 80), rng.uniform(25, 45), rng.uniform(6, 9)
    a, b = length / 2, breadth / 2
    wall = box(BODY, [-a, b - thick, 0], [a, b, high])
    gusset = m3.Manifold.extrude(m3.CrossSection([[(0, 0), (0, high - 4), (-0.5 * breadth, 0)]]), 6)
    rib = Shape.named(gusset.rotate([90, 0, 90]).translate([-0.6 * a, b - thick, thick - 0.5]), BODY)
    body = box(BODY, [-a, -b, 0], [a, b, thick]) + wall + rib
    body = body + _boss(rng.uniform(6, 9), 1, thick + rng.uniform(6, 12), 0.62 * a, 0.05 * b)
    body = body - _boss(5.0, -1, 30, -0.75 * a, -0.62 * b) - _boss(3.5, -1, 30, 0.75 * a, -0.6 * b)
    return Workpiece("bracket", body, ((-0.35 * a, -0.15 * b), (0.25 * a, -0.55 * b)))


def _flange(rng: np.random.Generator) -> Workpiece:
    radius, holes, thick = rng.uniform(45, 60), int(rng.integers(5, 9)), rng.uniform(8, 12)
    circle, hub = 0.76 * radius, 0.4 * radius
    body = _boss(radius, 0, thick, 0, 0) + _boss(hub, 1, thick + rng.uniform(8, 16), 0, 0) - _boss(10, -1, 60, 0, 0)
    for k in range(holes):
        turn = 2 * np.pi * k / holes
        body = body - _boss(4.5, -1, 30, circle * np.cos(turn), circle * np.sin(turn))
    turn = np.pi / holes
    pin = _cylinder(3.5, 1, thick + 5, circle * np.cos(turn), circle * np.sin(turn), 48)
    ahead, aside = 0.57 * radius, 0.3 * radius
    return Workpiece("flange", body + Shape.named(pin, MARK), ((-ahead, -aside), (-ahead, aside)), marked=True)


def _gear(rng: np.random.Generator) -> Workpiece:
    teeth, module, thick = int(rng.integers(20, 33)), rng.uniform(3.2, 4.0), rng.uniform(10, 16)
    root, tip = module * (teeth / 2 - 1.25), module * (teeth / 2 + 1)
    turns = 2 * np.pi * (np.arange(teeth)[:, None] + np.array([-0.27, -0.11, 0.11, 0.27])) / teeth
    radii = np.tile([root, tip, tip, root], (teeth, 1))
    outline = np.stack([radii * np.cos(turns), radii * np.sin(turns)], axis=-1).reshape(-1, 2)
    body = Shape.named(m3.Manifold.extrude(m3.CrossSection([outline]), thick), BODY)
    body = body + _boss(0.42 * root, 1, thick + 8, 0, 0) - _boss(0.24 * root, -1, 60, 0, 0)
    key = m3.Manifold.cube([8, 0.34 * root, 80], False).translate([-4, 0, -1])
    dimple = _cylinder(5.0, thick - 4, thick + 1, 0.72 * root, 0.0, 48)
    seat = ((-0.62 * root, -0.35 * root), (-0.62 * root, 0.35 * root))
    return Workpiece("gear", body - Shape.named(key + dimple, MARK), seat, marked=True)


def _blade(rng: np.random.Generator) -> Workpiece:
    span, chord, twist, camber = rng.uniform(90, 120), rng.uniform(45, 60), rng.uniform(0.15, 0.35), rng.uniform(4, 8)
    x = np.linspace(-span / 2, span / 2, int(span) + 1)
    y = np.linspace(-chord / 2, chord / 2, int(chord) + 1)

    def top(x: Floats, y: Floats) -> Floats:
        across = 2 * y / chord
        thickness = 5 * np.sqrt(np.maximum(1 - across**2, 0.0)) * (1 - 0.3 * x / span)
        return camber * (1 - across**2) + thickness + y * np.tan(twist * (x / span + 0.5)) + 12

    body = height_field(BODY, x, y, top, -12.0)
    root = box(BODY, [-span / 2 - 18, -chord / 2 - 6, -12], [-span / 2 + 1, chord / 2 + 4, 26])
    body = body + root - _boss(4.0, 10, 60, -span / 2 - 9, chord / 4)
    return Workpiece("blade", body, ((-0.25 * span, 0.05 * chord), (0.1 * span, -0.12 * chord)))


def _shaft(rng: np.random.Generator) -> Workpiece:
    length, radius = rng.uniform(120, 150), rng.uniform(14, 19)
    half, step = length / 2, rng.uniform(-0.2, 0.2) * length
    body = Shape.named(_rod(radius, -half, half), BODY)
    body = body + Shape.named(_rod(1.25 * radius, step, half - 22), BODY)
    body = body + Shape.named(_rod(1.6 * radius, half - 34, half - 22), BODY)
    turn = rng.uniform(-20, 20)
    slot = m3.Manifold.cube([30, 7, 30], True).translate([-half + 24, 0, radius + 10]).rotate([turn, 0, 0])
    middle = (-half + 40 + step) / 2
    seat = ((middle - 10, -0.25 * radius), (middle + 10, 0.25 * radius))
    return Workpiece("shaft", body - Shape.named(slot, MARK), seat, marked=True)


def _tray(rng: np.random.Generator) -> Workpiece:
    length, breadth, deep, wall = rng.uniform(110, 150), rng.uniform(75, 100), rng.uniform(14, 24), rng.uniform(3, 5)
    a, b = length / 2, breadth / 2
    body = box(BODY, [-a, -b, 0], [a, b, deep + 4]) - box(BODY, [wall - a, wall - b, 4], [a - wall, b - wall, 60])
    body = body + _boss(rng.uniform(6, 10), 1, 4 + 0.5 * deep, 0.45 * a, 0.4 * b)
    body = body + box(BODY, [-0.55 * a, 0.3 * b, 1], [-0.48 * a, 0.9 * b, 4 + 0.6 * deep])
    body = body - _boss(5.0, -1, 60, 0.5 * a, -0.45 * b)
    return Workpiece("tray", body, ((-0.4 * a, -0.35 * b), (0.15 * a, -0.1 * b)))


def _sheet(rng: np.random.Generator) -> Workpiece:
    length, breadth, lip, thick = rng.uniform(120, 160), rng.uniform(80, 100), rng.uniform(10, 16), rng.uniform(1.5, 3)
    a, b = length / 2, breadth / 2
    body = box(BODY, [-a, -b, 0], [a, b, thick]) + box(BODY, [a - thick, -b, 0], [a, 0.4 * b, lip])
    body = body + box(BODY, [-0.9 * a, b - thick, 0], [0.3 * a, b, 0.8 * lip])
    body = body - _boss(9.0, -1, 60, -0.6 * a, 0.4 * b) - _boss(6.0, -1, 60, 0.5 * a, -0.5 * b)
    body = body - box(BODY, [-a - 1, -b - 1, -1], [-0.7 * a, -0.6 * b, 20])
    body = body - box(BODY, [0.1 * a, 0.3 * b, -1], [0.5 * a, 0.42 * b, 20])
    return Workpiece("sheet", body, ((-0.3 * a, -0.1 * b), (0.2 * a, -0.3 * b)))


def _casting(rng: np.random.Generator) -> Workpiece:
    length, breadth = rng.uniform(110, 150), rng.uniform(80, 100)
    waves = [(rng.uniform(1, 3), *rng.uniform(0.02, 0.06, 2), rng.uniform(0, 6)) for _ in range(4)]

    def top(x: Floats, y: Floats) -> Floats:
        return 20 + sum(high * np.sin(u * x + v * y + at) for high, u, v, at in waves) - 4 * (2 * y / breadth) ** 4

    x = np.linspace(-length / 2, length / 2, int(length) + 1)
    y = np.linspace(-breadth / 2, breadth / 2, int(breadth) + 1)
    body = height_field(BODY, x, y, top, -5.0)
    body = body + _boss(rng.uniform(9, 14), 0, rng.uniform(30, 38), 0.3 * length, 0.22 * breadth)
    body = body + _boss(rng.uniform(6, 9), 0, rng.uniform(28, 34), -0.32 * length, 0.28 * breadth)
    body = body - _boss(rng.uniform(6, 9), 10, 60, 0.34 * length, -0.25 * breadth)
    rib = box(BODY, [-4, -0.3 * breadth, 0], [4, 0.3 * breadth, 30]).body.rotate([0, 0, 15])
    body = body + Shape.named(rib.translate([-0.3 * length, -0.1 * breadth, 0]), BODY)
    return Workpiece("casting", body, ((-0.08 * length, -0.25 * breadth), (0.14 * length, 0.1 * breadth)))


WORKPIECES: dict[str, Callable[[np.random.Generator], Workpiece]] = {
    "bracket": _bracket,
    "flange": _flange,
    "gear": _gear,
    "blade": _blade,
    "shaft": _shaft,
    "tray": _tray,
    "sheet": _sheet,
    "casting": _casting,
}
