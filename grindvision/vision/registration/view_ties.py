"""Pairs of views as ties: what a registration says of its pair, and pairs that are refined from known poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import AmbiguousError, GrindvisionError
from grindvision.geometry import inverse, move_points
from grindvision.vision.registration.free_motions import (
    HARDLY_KNOWN,
    motion_name,
    rms_extent,
    spread_out,
    weakest_motion,
)
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.scan_registration import refine_from
from grindvision.vision.registration.verification import MIN_OVERLAP
from grindvision.vision.registration.view_poses import Pair, Tie, moved_mm
from grindvision.vision.surface.scan import Resolution, Scan, choose_resolution, coarser, prepare_scan

Floats = NDArray[np.float64]

MORE_RELIEF = "show a part with relief on all sides, or use another target"

#: Going round three views must end nearer than this fraction of the part's extent to where it began.
CLOSED = 0.03


def loop_limits(views: Sequence[Floats]) -> tuple[float, float, list[Floats]]:
    """How far (mm) from its begin a loop of three may end, the part's extent, the middles (3,) of views (M_i, 3)."""
    extent = float(np.median([rms_extent(view) for view in views]))
    return CLOSED * extent, extent, [view.mean(axis=0) for view in views]


def tie_of(fine: FineRegistration, source: Floats, held: bool = True) -> Tie:
    """What a registration of a source (N, 3) says about its pair.

    Raises:
        AmbiguousError: where it is to be ``held``, the surfaces that meet hardly hold a motion, by the pose's
            covariance; names it.
    """
    if held:
        sigma, moved = weakest_motion(fine, spread_out(source))
        extent = rms_extent(source)
        if sigma > HARDLY_KNOWN * extent:
            name = motion_name(moved, fine.T_target_source, source.mean(axis=0), extent)
            raise AmbiguousError(f"free motion: {name} is within one sigma of the registration; {MORE_RELIEF}")
    return Tie(fine.T_target_source, fine.centre_mm, fine.information / np.trace(fine.information[:3, :3]))


def refined_pairs(
    views: Sequence[Floats],
    pairs: Sequence[Pair],
    poses: Floats,
    seed: int = 0,
    held: bool = True,
    max_mm: float | None = None,
    finished: Callable[[], None] = lambda: None,
) -> tuple[dict[Pair, Tie], dict[Pair, str]]:
    """Pairs (target, source) of views (M_i, 3), mm, refined by ICP alone from known ``poses`` (N, 4, 4) in one frame.

    Args:
        seed: of the random draws.
        held: whether a pair must hold every motion by its planes and curvature. Rims, which would hold some more, cost
            more than all else.
        max_mm: how far a pair may end from the known poses; as loops of three when left out.
        finished: is called after every pair.

    Returns:
        The ties, and why other pairs were not used: little overlap, a pose elsewhere, a motion hardly held.
    """
    ties: dict[Pair, Tie] = {}
    refused: dict[Pair, str] = {}
    closed_mm, extent, middles = loop_limits(views)
    max_mm = closed_mm if max_mm is None else max_mm
    sizes = [choose_resolution(view) for view in views]
    prepared: dict[tuple[int, Resolution], Scan] = {}

    def scan(row: int, size: Resolution) -> Scan:
        if (row, size) not in prepared:
            prepared[row, size] = prepare_scan(views[row], size, np.zeros(3), None)
        return prepared[row, size]

    for target, source in pairs:
        start = inverse(poses[target]) @ poses[source]
        size = coarser(sizes[source], sizes[target])
        try:
            fine = refine_from(scan(source, size), scan(target, size), start, np.random.default_rng(seed))
            tie = tie_of(fine, views[source], held)
            moved = moved_mm(fine.T_target_source @ inverse(start), move_points(start, middles[source]), extent)
            if fine.overlap < MIN_OVERLAP:
                refused[target, source] = f"only {fine.overlap:.0%} of the views overlap"
            elif moved > max_mm:
                refused[target, source] = "does not agree with the other pairs"
            else:
                ties[target, source] = tie
        except GrindvisionError as refusal:
            refused[target, source] = str(refusal)
        finished()
    return ties, refused
