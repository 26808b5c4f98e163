"""Scans that differ all along their rims by more than noise explains: a depth picture that was smoothed.

A smoothed picture mixes the depths on both sides of every edge: rims sink or rise, and slopes join one surface to the
next. Another view mixes others, so two scans differ along most of their rims, some places up and some down. New
material stands out only, and along few of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import inverse
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest
from grindvision.records import by_content
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.change.visibility import surrounded
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.scan import Scan, surface_in_frame

Floats = NDArray[np.float64]

RIM_CELLS = 2.5
"""Nearer to a rim than so many cells, a place is beside it: as far as ``surrounded`` looks."""

SAME_CELLS = 2.0
"""Farther from the sample than so many cells, a place shows another surface. Slopes between smoothed rims stand so far
off; of 187 raw pairs (12 kinds of parts, rough, double, with gaps, noisy, thin) none had a place between one and two
cells."""

TAIL, DEVIATIONS = 0.9, 1.645
"""Of normal errors of one sign, this share lies within so many standard deviations."""

BEYOND = 1.4
"""Times the level of detection from which both signs are beyond noise: by 0.5 to 1.1 beside rims of raw scans (rough
skin, double surface, gaps, sheared and smoothed point by point), by 1.6 to 3 where the depth pictures of one or both
were smoothed over 1.5 pixels."""

MIN_BESIDE = 100
"""Fewer surfels of one sign beside rims say nothing."""

MOSTLY = 0.5
"""A piece of which a larger share lies beside rims may be nothing but the smoothing."""


@by_content
@dataclass(frozen=True)
class SmoothedEdges:
    """How the scans differ beside their rims: ``rims_mm`` (K, 3), frame of the test scan, within ``reach_mm`` of which
    they do by up to ``differ_mm`` (90 %), where the level of detection is ``level_mm`` in the median."""

    rims_mm: Floats
    reach_mm: float
    differ_mm: float
    level_mm: float

    def share_beside(self, points: Floats) -> float:
        """Fraction of points (N, 3) of the test scan beside the rims."""
        at, _ = nearest(build_cells(self.rims_mm, self.reach_mm), points, self.reach_mm)
        return float((at >= 0).mean())

    def __str__(self) -> str:
        return (
            f"all along their rims the scans differ by up to {self.differ_mm:.2g} mm (90 %) up and down, where noise"
            f" explains {self.level_mm:.2g} mm: a depth picture that was smoothed, or pixels mixed across edges; what"
            " stands out there may be nothing else and is left out: export without smoothing and with the edge"
            " filter on"
        )


def find_smoothed_edges(
    source: Scan, target: Scan, registration: FineRegistration, difference: Difference
) -> SmoothedEdges | None:
    """How the source and the target differ beside their rims, None where it is by no more than noise explains.

    ``registration`` is T_target_source; ``difference`` that of the source at this pose.
    """
    surface = surface_in_frame(target.surfels, inverse(registration.T_target_source))
    size = difference.cell_mm
    rims = np.concatenate([one.points[~surrounded(one, one.points, one.normals)] for one in (source.surfels, surface)])
    if len(rims) == 0:
        return None
    at, _ = nearest(build_cells(rims, RIM_CELLS * size), difference.surfels, RIM_CELLS * size)
    signed, level = difference.signed_mm, difference.firm_level_mm
    beside = (at >= 0) & difference.comparable & (np.abs(signed) < SAME_CELLS * size)  # NaN is not
    times = np.abs(signed[beside]) / (level[beside] / 1.96)
    for one_sign in (times[signed[beside] > 0], times[signed[beside] < 0]):
        if len(one_sign) < MIN_BESIDE or np.quantile(one_sign, TAIL) < BEYOND * DEVIATIONS:
            return None
    differ = float(np.quantile(np.abs(signed[beside]), TAIL))
    return SmoothedEdges(rims, RIM_CELLS * size, differ, float(np.median(level[beside])))


def smoothing_doubts(difference: Difference, smoothed: SmoothedEdges | None) -> dict[int, str]:
    """Which pieces of a difference, by their number from 0, may be nothing but the smoothing, and why."""
    if smoothed is None:
        return {}
    shares = [smoothed.share_beside(piece.points) for piece in difference.clusters]
    return {
        rank: f"{share:.0%} of it lies along rims, where a depth picture that was smoothed shows as much"
        for rank, share in enumerate(shares)
        if share > MOSTLY
    }
