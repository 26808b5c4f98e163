"""What is wrong with a scanner: named error sources with units, and the smooth field distortion of one instrument."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import InputError
from grindvision.kernels import njit

Floats = NDArray[np.float64]

#: Cosines that make up a distortion field; enough that its values are close to normally distributed.
WAVES = 24


@dataclass(frozen=True)
class ScannerErrors:
    """The error budget of a scanner; every source is off at its default.

    Random, new in every scan: ``white_mm`` along the ray; ``triangulation_px`` white and ``correlated_px`` correlated
    noise of the disparity (depth error times z^2 / (f b)), the latter smoothed over ``correlation_length_px``;
    ``mixed_pixels`` is the fraction of pixels at depth steps above ``edge_mm`` that fall between front and back.
    Systematic, the same in every scan of one instrument: ``distortion_mm`` rms depth error at the reference distance
    of a smooth field with correlation length ``distortion_length_mm``, growing with z^2; ``scale`` standard deviation
    over instruments of the relative scale error.
    Lost points: steeper than ``grazing_deg`` to camera or projector; in the projector's ``shadow``.
    ``disparity_step_px`` is the step in which disparity is read out.
    """

    white_mm: float = 0.0
    triangulation_px: float = 0.0
    correlated_px: float = 0.0
    correlation_length_px: float = 3.0
    distortion_mm: float = 0.0
    distortion_length_mm: float = 70.0
    scale: float = 0.0
    grazing_deg: float | None = None
    shadow: bool = False
    mixed_pixels: float = 0.0
    edge_mm: float = 2.0
    disparity_step_px: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise InputError(f"scanner error {item.name} is {value}; it must be zero (off) or above")
        if self.mixed_pixels > 1:
            raise InputError(f"mixed_pixels is {self.mixed_pixels}; it is a fraction of pixels, at most 1")
        for name in ("correlation_length_px", "distortion_length_mm", "edge_mm"):
            if getattr(self, name) == 0:
                raise InputError(f"scanner error {name} is 0; a length must be above zero")

    def only(self, *sources: str) -> ScannerErrors:
        """Return a budget in which all sources but the named ones are off; lengths keep their values."""
        return self._off([name for name in SOURCES if name not in self._known(sources)])

    def without(self, *sources: str) -> ScannerErrors:
        """Return the budget with the named sources off."""
        return self._off(self._known(sources))

    def _off(self, sources: tuple[str, ...] | list[str]) -> ScannerErrors:
        off = ScannerErrors()
        return replace(self, **{name: getattr(off, name) for name in sources})

    def _known(self, sources: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in sources if name not in SOURCES]
        if unknown:
            raise InputError(f"no error source {', '.join(unknown)}; there are {', '.join(SOURCES)}")
        return sources


#: The sources that can be switched; the remaining fields only shape them.
SOURCES = tuple(
    item.name
    for item in fields(ScannerErrors)
    if item.name not in ("correlation_length_px", "distortion_length_mm", "edge_mm")
)


def distortion(
    points: Floats, errors: ScannerErrors, half_field_mm: Floats, reference_mm: float, instrument: np.random.Generator
) -> Floats:
    """Depth error (N,) mm of one instrument's smooth field distortion at points (N, 3) of its frame.

    The field is a sum of ``WAVES`` cosines of random direction, scaled so that its mean over the field of view at the
    reference distance, ``half_field_mm`` (2,) to both sides, is zero and its rms there is ``distortion_mm``.
    """
    if not errors.distortion_mm:
        return np.zeros(len(points))
    waves = instrument.standard_normal((WAVES, 3)) / errors.distortion_length_mm
    phases = instrument.uniform(0, 2 * np.pi, WAVES)
    x, y = np.meshgrid(np.linspace(-1, 1, 43) * half_field_mm[0], np.linspace(-1, 1, 31) * half_field_mm[1])
    plane = sum_of_cosines(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, reference_mm)]), waves, phases)
    unit = (sum_of_cosines(points, waves, phases) - plane.mean()) / plane.std()
    return errors.distortion_mm * unit * (points[:, 2] / reference_mm) ** 2


@njit(cache=True, fastmath=True)
def sum_of_cosines(points: Floats, waves: Floats, phases: Floats) -> Floats:
    """Sum over the waves (K, 3) and phases (K,) of cos(wave . point + phase) at points (N, 3).

    The phase is reduced to whole turns, and cos taken as the sine of a - within a quarter turn of zero - by its series
    up to a^17, which is exact to 1e-13: the compiler makes vector code of this, and none of the library's cosine.
    """
    turn = 2 * np.pi
    in_x, in_y, in_z, offsets = waves[:, 0] / turn, waves[:, 1] / turn, waves[:, 2] / turn, phases / turn
    sums = np.empty(len(points))
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        total = 0.0
        for k in range(len(offsets)):
            turns = x * in_x[k] + y * in_y[k] + z * in_z[k] + offsets[k]
            a = turn * (0.25 - abs(turns - np.floor(turns + 0.5)))
            b = a * a
            series = 1 - b * (1 / 210) * (1 - b * (1 / 272))
            series = 1 - b * (1 / 110) * (1 - b * (1 / 156) * series)
            series = 1 - b * (1 / 42) * (1 - b * (1 / 72) * series)
            total += a * (1 - b * (1 / 6) * (1 - b * (1 / 20) * series))
        sums[i] = total
    return sums
