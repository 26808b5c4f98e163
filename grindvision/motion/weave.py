"""Weaving: the wire swings from side to side while it goes along the seam."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError

Floats = NDArray[np.float64]

SHAPES = ("sine", "triangle")

#: Positions per swing of a sine, between which the tip goes straight.
SINE_POSITIONS = 16

#: The tip may swing no faster than this, mm/s: the reduced speed at which people may stand by (ISO 10218-1).
MAX_TIP_MM_S = 250.0


@dataclass(frozen=True)
class Weave:
    """A weave of ``width_mm`` from toe to toe, one swing to both sides every ``length_mm`` along the seam.

    ``shape`` is ``sine`` or ``triangle``. ``dwell_mm``: so far the tip goes straight along the seam at each toe, where
    it swings no further. The swing starts in the middle, towards the tool's y axis, the right of the seam.
    """

    width_mm: float
    length_mm: float
    shape: str = "sine"
    dwell_mm: float = 0.0

    def __post_init__(self) -> None:
        if self.shape not in SHAPES:
            raise InputError(f"unknown weave {self.shape!r}; choose one of {', '.join(SHAPES)}")
        if not 0 < self.width_mm <= 50:
            raise InputError(f"a weave {self.width_mm:g} mm wide; give a width above 0, 50 mm at most")
        if not 0.5 <= self.length_mm <= 200:
            raise InputError(
                f"a weave whose swing takes {self.length_mm:.3g} mm of the seam; give 0.5 to 200 mm: change the"
                " frequency or the speed along the seam"
            )
        if not 0 <= self.dwell_mm <= 0.4 * self.length_mm:
            raise InputError(
                f"a dwell of {self.dwell_mm:.3g} mm at each toe leaves no way to swing within {self.length_mm:.3g} mm;"
                f" dwell {0.4 * self.length_mm:.3g} mm at most, or swing more slowly"
            )

    def fitted(self, seam_mm: float, closed: bool = False) -> Weave:
        """The weave with its swing a little longer or shorter, so that it ends in the middle of the seam.

        A seam holds a whole number of half swings; a closed one whole swings, so that the weave meets its own start.
        """
        halves = max(1 + closed, (1 + closed) * round((2 - closed) * seam_mm / self.length_mm))
        scale = 2 * seam_mm / halves / self.length_mm
        return replace(self, length_mm=scale * self.length_mm, dwell_mm=scale * self.dwell_mm)

    def offsets_mm(self, arc_mm: ArrayLike) -> Floats:
        """How far to the side (N,) the tip is at lengths (N,) along the seam, mm."""
        arc = np.asarray(arc_mm, dtype=float)
        angle = np.interp(np.mod(arc / self.length_mm, 1.0), *self._phases())
        swing = np.sin(angle)
        return self.width_mm / 2 * (swing if self.shape == "sine" else 2 / np.pi * np.arcsin(swing))

    def positions_mm(self, seam_mm: float) -> Floats:
        """Lengths along a seam of ``seam_mm`` at which the tip needs a position, ascending, both ends among them."""
        fractions, angles = self._phases()
        count = SINE_POSITIONS if self.shape == "sine" else 4
        wanted = np.linspace(0.0, 2 * np.pi, count + 1)
        one = np.unique(np.concatenate([fractions, np.interp(wanted, angles + 1e-9 * np.arange(6), fractions)]))
        swings = np.arange(int(np.ceil(seam_mm / self.length_mm)))
        at = self.length_mm * np.unique((swings[:, None] + one).ravel().round(9))
        inside = at[(at > 0.02) & (at < seam_mm - 0.02)]
        return np.concatenate([[0.0], inside[np.diff(inside, prepend=0.0) > 0.01], [seam_mm]])

    def tip_speed_mm_s(self, speed_mm_s: float) -> float:
        """The tip's highest speed, mm/s, at a speed along the seam."""
        swinging_mm = self.length_mm - 2 * self.dwell_mm
        steepest = self.width_mm / swinging_mm * (np.pi if self.shape == "sine" else 2.0)
        return float(speed_mm_s * np.hypot(1.0, steepest))

    def check_speed(self, speed_mm_s: float) -> None:
        """Refuse a swing that is too fast for any arm.

        Raises:
            InputError: the tip would be faster than ``MAX_TIP_MM_S``.
        """
        tip_mm_s = self.tip_speed_mm_s(speed_mm_s)
        if tip_mm_s > MAX_TIP_MM_S:
            hz = speed_mm_s / self.length_mm
            raise InputError(
                f"weaving {self.width_mm:g} mm wide at {hz:.3g} Hz moves the tip at {tip_mm_s:.0f} mm/s;"
                f" {MAX_TIP_MM_S:g} is the most: weave at {hz * MAX_TIP_MM_S / tip_mm_s:.2g} Hz at most, or narrower"
            )

    def __str__(self) -> str:
        dwell = f", {self.dwell_mm:.2g} mm dwell at each toe" if self.dwell_mm else ""
        return f"{self.shape} weave {self.width_mm:g} mm wide, a swing every {self.length_mm:.3g} mm{dwell}"

    def _phases(self) -> tuple[Floats, Floats]:
        """Shares of a swing (6,) and the angle of the wave there, rad: it stands still at both toes."""
        rest = self.dwell_mm / self.length_mm
        move = (1 - 2 * rest) / 4
        fractions = np.cumsum([0.0, move, rest, 2 * move, rest, move])
        return fractions, np.pi * np.array([0.0, 0.5, 0.5, 1.5, 1.5, 2.0])
