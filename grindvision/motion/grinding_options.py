"""What a shop sets for grinding: the wheel, the cut, the process, the ways in and out, with units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grindvision.errors import InputError

PATTERNS = ("bead", "raster", "contour")
"""Along the bead's centreline; in straight lines; along the rim of what is left, inwards."""

TOOLS = ("wheel", "disc")
"""A wheel grinds with its circumference, its axis across the feed; a disc with its face, tilted forward."""


CHORD_MM = 0.01
"""So far the straight way from place to place may leave the planned one: a tenth of a usual depth of cut, and a fifth
of the 0.05 mm that may be cut under the good surface."""

CUSP = 0.15
"""Height, in depths of cut, of what a tilted disc may leave between neighbouring lines."""


@dataclass(frozen=True)
class GrindingOptions:
    """Settings of ``plan_grinding``.

    The wheel: ``tool`` of ``TOOLS``, ``radius_mm``, ``width_mm`` (of a wheel), ``contact_angle_rad`` (of a disc against
    the surface). The cut: ``depth_mm`` per pass along the normal, ``overlap`` of neighbouring lines as a fraction of
    the contact's width, ``pattern`` of ``PATTERNS``, ``step_mm`` between path points at most (see ``path_step_mm``),
    ``leave_mm`` that the last pass leaves standing (left out: 1.5 standard deviations of the good surface),
    ``passes_max`` to be planned now (left out: all). The process: ``force_n`` and feed (``feed_min_mm_s`` to
    ``feed_max_mm_s``) limits, ``surface_speed_m_s`` of the wheel, ``k_mm2_n`` Preston's coefficient: depth = k p v t.
    The ways: ``lead_mm`` and ``lead_height_mm`` of lead-in and lead-out, ``retract_mm`` between lines, ``keep_out_mm``
    to what must stay, ``lead_angle_rad`` by which the tool's axis leans forward.
    """

    tool: str = "wheel"
    radius_mm: float = 20.0
    width_mm: float = 6.0
    contact_angle_rad: float = 0.26
    depth_mm: float = 0.1
    overlap: float = 0.3
    pattern: str = "bead"
    step_mm: float = 1.0
    leave_mm: float | None = None
    passes_max: int | None = None
    force_n: float = 40.0
    feed_min_mm_s: float = 1.0
    feed_max_mm_s: float = 50.0
    surface_speed_m_s: float = 20.0
    k_mm2_n: float = 2.5e-5
    lead_mm: float = 5.0
    lead_height_mm: float = 1.0
    retract_mm: float = 20.0
    keep_out_mm: float = 1.0
    lead_angle_rad: float = 0.0

    def __post_init__(self) -> None:
        for name, known in (("tool", TOOLS), ("pattern", PATTERNS)):
            if getattr(self, name) not in known:
                raise InputError(f"{name} {getattr(self, name)!r} is unknown; choose one of {', '.join(known)}")
        lengths = ("radius_mm", "width_mm", "depth_mm", "step_mm", "lead_mm", "lead_height_mm", "retract_mm")
        process = ("force_n", "feed_min_mm_s", "feed_max_mm_s", "surface_speed_m_s", "k_mm2_n")
        for name in (*lengths, *process):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"{name} is {getattr(self, name)}; give a number above zero")
        for name, low, high in (
            ("overlap", 0.0, 0.95),
            ("contact_angle_rad", 0.02, 1.2),
            ("lead_angle_rad", -1.0, 1.0),
            ("keep_out_mm", 0.0, 1e6),
            ("leave_mm", 0.0, 1e6),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"{name} is {value}; give {low:g} to {high:g}")
        if self.depth_mm >= self.radius_mm:
            raise InputError(f"a depth of {self.depth_mm:g} mm is no cut for a radius of {self.radius_mm:g} mm")
        if not self.feed_min_mm_s <= self.feed_max_mm_s:
            raise InputError(f"feeds of {self.feed_min_mm_s:g} to {self.feed_max_mm_s:g} mm/s are no range")
        if self.passes_max is not None and self.passes_max < 1:
            raise InputError(f"{self.passes_max} passes were asked for; give 1 at least")

    @property
    def path_step_mm(self) -> float:
        """Distance of path points: ``step_mm``, or less where an arc of the tool's radius leaves its chord sooner."""
        return min(self.step_mm, float(np.sqrt(8 * self.radius_mm * CHORD_MM)))

    @property
    def contact_width_mm(self) -> float:
        """Width across the feed of what one line grinds; of a tilted disc, up to a cusp of ``CUSP`` of the depth."""
        if self.tool == "wheel":
            return self.width_mm
        chord = CUSP * self.depth_mm / float(np.sin(self.contact_angle_rad))
        return (
            float(2 * np.sqrt(chord * (2 * self.radius_mm - chord))) if chord < self.radius_mm else 2 * self.radius_mm
        )
