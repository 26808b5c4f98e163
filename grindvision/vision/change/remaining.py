"""What is left of a piece of stock after grinding, judged against a tolerance; and what was cut away below the
surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label, median_filter

from grindvision.errors import InputError
from grindvision.vision.change.stock import Flags, Floats, StockPiece
from grindvision.words import rounded

GOUGED_NODES = 9
"""Fewer connected nodes below the surface are noise, no gouge."""

SURE = 2.5
"""So many of its own standard deviations a single node must stand above the tolerance to be told from noise: of a map's
thousand nodes that stand just at it, six do so by chance."""

MAX_HIDDEN = 0.05
"""A piece of which the scan does not show more than this fraction cannot be judged."""


@dataclass(frozen=True)
class Remaining:
    """What stands at the place of a piece, against ``tolerance_mm``.

    ``height_max_mm`` and ``height_mean_mm`` with their standard deviations; ``over_mm2``: area that stands above the
    tolerance; ``gouged_mm2``: area, of the piece and around it, below the good surface by more than the level of
    detection, ``gouge_mm`` at its deepest; ``hidden_mm2`` of the piece the scan does not show. Heights are medians over
    3 x 3 nodes, as a single node's noise is no verdict; what is narrower than two nodes counts by the nodes that stand
    above the tolerance by ``SURE`` of their own standard deviations.
    """

    tolerance_mm: float
    height_max_mm: float
    height_max_sigma_mm: float
    height_mean_mm: float
    height_mean_sigma_mm: float
    over_mm2: float
    gouged_mm2: float
    gouge_mm: float
    hidden_mm2: float
    judged: bool

    @property
    def met(self) -> bool:
        """Whether nothing stands above the tolerance, nothing is gouged, and enough is shown to say so."""
        return self.judged and self.over_mm2 == 0 and self.gouged_mm2 == 0

    def __str__(self) -> str:
        verdict = "met" if self.met else "not met" if self.judged else "cannot be judged"
        return (
            f"{verdict}: at most {self.height_max_mm:.3f} +- {self.height_max_sigma_mm:.2g} mm, mean"
            f" {self.height_mean_mm:.3f} +- {self.height_mean_sigma_mm:.2g} mm; {rounded(self.over_mm2)} mm2 above"
            f" {self.tolerance_mm:g} mm, {rounded(self.gouged_mm2)} mm2 gouged"
        )


def judge_remaining(piece: StockPiece, tolerance_mm: float) -> Remaining:
    """Judge a piece that was measured again after grinding.

    Raises:
        InputError: the tolerance is not above zero, or below the level of detection.
    """
    if not 0 < tolerance_mm < np.inf:
        raise InputError(f"the tolerance is {tolerance_mm} mm; give a height above zero")
    if tolerance_mm < piece.level_mm:
        raise InputError(
            f"a tolerance of {tolerance_mm:g} mm is below the level of detection of {piece.level_mm:.2g} mm; these"
            " scans cannot show whether it is met"
        )
    known = piece.inside & ~piece.hidden & np.isfinite(piece.map.heights_mm)
    heights = smoothed(piece)
    areas = piece.map.areas_mm2
    single = np.nan_to_num(piece.map.heights_mm)
    heights = np.where(single - SURE * piece.sigma_mm > tolerance_mm, np.maximum(heights, single), heights)
    over = known & (heights > tolerance_mm)
    below = (known | (piece.unchanged & np.isfinite(piece.map.heights_mm))) & (heights < -2 * piece.level_mm)
    below = _patches(below | known & (heights < -piece.level_mm))
    inside_mm2, hidden_mm2 = float(areas[piece.inside].sum()), float(areas[piece.inside & ~known].sum())
    top = int(np.where(known, heights, -np.inf).argmax()) if known.any() else 0
    mean = float((areas * heights)[known].sum() / areas[known].sum()) if known.any() else np.nan
    weights = np.where(known, areas, 0.0) / max(float(areas[known].sum()), 1e-12)
    noise = float(piece.datum.noise.of_sums(weights[None])[0, 0])
    common = float(piece.datum.variances_mm2[known].mean()) if known.any() else np.nan
    return Remaining(
        tolerance_mm,
        float(heights.ravel()[top]) if known.any() else np.nan,
        float(piece.sigma_mm.ravel()[top]),
        mean,
        float(np.sqrt(noise + common)),
        float(areas[over].sum()),
        float(areas[below].sum()),
        float(max(-heights[below].min(), 0.0)) if below.any() else 0.0,
        hidden_mm2,
        hidden_mm2 <= MAX_HIDDEN * inside_mm2,
    )


def _patches(marks: Flags) -> Flags:
    """Nodes (R, C) of connected patches that are large enough to be told."""
    numbers, count = label(marks, np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)
    sizes[0] = 0
    return np.asarray(sizes[numbers] >= GOUGED_NODES)


def smoothed(piece: StockPiece) -> Floats:
    """Heights (R, C), each the median of the 3 x 3 nodes around it; 0 where nothing is known."""
    return np.asarray(median_filter(np.nan_to_num(piece.map.heights_mm), 3), dtype=float)
