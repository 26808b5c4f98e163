"""The part to be ground: a free-form plate with boss, rib and pocket, with or without the bead that must go."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from grindvision.cell.solids import Shape, Solid, check_size, height_field, swept
from grindvision.errors import InputError
from grindvision.extras import extra
from grindvision.records import by_content

with extra("sim"):
    import manifold3d as m3

Floats = NDArray[np.float64]
Surface = Callable[[Floats, Floats], Floats]

LENGTH_MM = 200.0
BREADTH_MM = 140.0

#: The plate's flat underside, below the lowest point of its upper face.
FLOOR_MM = -30.0

BEAD = "bead"

#: Where the standard bead's middle lies on the plate, x and y in mm, and its direction against x in degrees.
BEAD_PLACE = (0.0, -14.0, 25.0)

#: Spacing of the stations of a bead and of its ridge line, mm.
STATION_MM = 0.25


@by_content
@dataclass(frozen=True)
class Bead:
    """Weld bead with parabolic cross-section: ``ridge_mm`` (K, 3) and unit surface ``normals`` (K, 3) along it.

    ``width_mm`` across at the plate, ``height_mm`` of the ridge above it; both ends are rounded off over half a width.
    """

    ridge_mm: Floats
    normals: Floats
    width_mm: float = 4.0
    height_mm: float = 1.5

    def __post_init__(self) -> None:
        check_size("bead width", self.width_mm)
        check_size("bead height", self.height_mm)
        if not self.length_mm > self.width_mm:
            raise InputError(
                f"the bead is {self.length_mm:.3g} mm long, it must be longer than wide ({self.width_mm} mm)"
            )

    @property
    def length_mm(self) -> float:
        """Length of the ridge."""
        return float(self._stations()[-1])

    @property
    def full(self) -> NDArray[np.bool_]:
        """Mark the ridge points (K,) between the rounded ends, where the bead has its full height."""
        s = self._stations()
        return (s >= self.width_mm / 2) & (s <= s[-1] - self.width_mm / 2)

    def shape(self) -> Shape:
        """The bead as a solid that reaches a millimetre into the plate."""
        tangents = np.gradient(self.ridge_mm, axis=0)
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        left = np.cross(self.normals, tangents)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        s = self._stations()
        to_end = np.clip(np.minimum(s, s[-1] - s) / (self.width_mm / 2), 0, 1)
        swell = np.sqrt(np.maximum(1 - (1 - to_end) ** 2, 0.01))[:, None]
        across = np.linspace(1.2, -1.2, 25)
        outline = np.column_stack([across * self.width_mm / 2, -self.height_mm * across**2])
        outline = np.concatenate(
            [outline, [[outline[-1, 0], -self.height_mm - 1], [outline[0, 0], -self.height_mm - 1]]]
        )
        # Towards the ends the outline narrows, and its ridge sinks until the bead meets the plate.
        sink = (1 - swell) * self.height_mm
        up = outline[None, :, 1] - sink
        rings = self.ridge_mm[:, None, :] + (swell * outline[None, :, 0])[:, :, None] * left[:, None, :]
        return swept(BEAD, rings + up[:, :, None] * self.normals[:, None, :])

    def _stations(self) -> Floats:
        steps = np.linalg.norm(np.diff(self.ridge_mm, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


@dataclass(frozen=True)
class GrindingPart:
    """The good part and the same part with its bead, in one frame (mm, z up from the plate)."""

    sample: Solid
    test: Solid
    bead: Bead

    def __str__(self) -> str:
        return (
            f"grinding part with a bead of {self.bead.length_mm:.1f} x {self.bead.width_mm} x {self.bead.height_mm} mm"
        )


def grinding_part(
    relief: float = 1.0, length_mm: float = 30.0, width_mm: float = 4.0, height_mm: float = 1.5
) -> GrindingPart:
    """Make the standard part: a plate of about 200 x 140 mm and a bead of the size given.

    ``relief`` scales the height of everything but the bead; 0.2 makes the part hard to register.

    Raises:
        InputError: a size or the relief is not positive, or the bead leaves the plate.
    """
    for name, size in (
        ("relief", relief),
        ("bead length", length_mm),
        ("bead width", width_mm),
        ("bead height", height_mm),
    ):
        check_size(name, size)
    if length_mm > 0.5 * BREADTH_MM:
        raise InputError(f"the bead is {length_mm} mm long; on this plate it may be {0.5 * BREADTH_MM:.0f} mm")

    surface = _standard_surface(relief)
    x_mid, y_mid, rotation_deg = BEAD_PLACE
    s = np.linspace(-length_mm / 2, length_mm / 2, int(np.ceil(length_mm / STATION_MM)) + 1)
    angle = np.radians(rotation_deg) + s / 120.0
    x = x_mid + s * np.cos(angle)
    y = y_mid + s * np.sin(angle)
    normals = surface_normals(surface, x, y)
    bead = Bead(np.column_stack([x, y, surface(x, y)]) + height_mm * normals, normals, width_mm, height_mm)
    return _standard_part(relief).with_bead(bead)


@dataclass(frozen=True)
class GoodPart:
    """The part without a bead: as a shape that takes one, and as the finished solid."""

    shape: Shape
    solid: Solid

    def with_bead(self, bead: Bead) -> GrindingPart:
        """Set a bead on the part."""
        return GrindingPart(self.solid, (self.shape + bead.shape()).solid(), bead)


def good_part(surface: Surface, relief: float = 1.0) -> GoodPart:
    """Build the plate under a free-form ``surface`` z(x, y), and add boss, rib and pocket."""
    x = np.linspace(-LENGTH_MM / 2, LENGTH_MM / 2, int(LENGTH_MM) + 1)
    y = np.linspace(-BREADTH_MM / 2, BREADTH_MM / 2, int(BREADTH_MM) + 1)
    plate = height_field("plate", x, y, surface, FLOOR_MM)

    def level(x_mm: float, y_mm: float) -> float:
        return float(surface(np.array(x_mm), np.array(y_mm)))

    def pillar(
        outline: m3.CrossSection, place: tuple[float, float], rotation_deg: float, low: float, high: float
    ) -> m3.Manifold:
        return m3.Manifold.extrude(outline, high - low).rotate([0, 0, rotation_deg]).translate([*place, low])

    boss, rib, pocket = (-34.0, 34.0), (34.0, 36.0), (44.0, -30.0)
    disc = m3.CrossSection.circle(13.0, 128)
    bar = m3.CrossSection.square([62.0, 7.0], True)
    hole = m3.CrossSection.square([34.0, 22.0], True)
    body = plate + Shape.named(pillar(disc, boss, 0, FLOOR_MM + 1, level(*boss) + 11 * relief), "boss")
    body = body + Shape.named(pillar(bar, rib, -14, FLOOR_MM + 1, level(*rib) + 7 * relief), "rib")
    body = body - Shape.named(pillar(hole, pocket, 20, level(*pocket) - 7 * relief, 100.0), "pocket")
    return GoodPart(body, body.solid())


@lru_cache(maxsize=4)
def _standard_part(relief: float) -> GoodPart:
    return good_part(_standard_surface(relief), relief)


def _standard_surface(relief: float) -> Surface:
    return lambda x, y: relief * free_form(x, y)


def free_form(x: Floats, y: Floats) -> Floats:
    """Height in mm of the plate's upper face at relief 1."""
    waves = 4.0 * np.sin(x / 27.0 + 0.5) * np.cos(y / 24.0) + 2.5 * np.sin((x + 2.0 * y) / 33.0)
    return waves + 4.0 * (x / 100.0) ** 2 - 3.0 * (y / 70.0) ** 2 + 2.0 * x / 100.0


def surface_normals(surface: Surface, x: Floats, y: Floats) -> Floats:
    """Unit normals (K, 3), upwards, of z = surface(x, y)."""
    step = 1e-4
    slope_x = (surface(x + step, y) - surface(x - step, y)) / (2 * step)
    slope_y = (surface(x, y + step) - surface(x, y - step)) / (2 * step)
    normals = np.column_stack([-slope_x, -slope_y, np.ones_like(x)])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
