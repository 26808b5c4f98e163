"""A surface that a scan shows twice: views merged with a small misfit, or a part that moved while it was scanned.

Each layer is as smooth as a scan of its own, so over a small patch the heights over a common surface fall into two
groups, and points that are neighbours belong to either. Noise makes no groups; steps and fine relief do, but there
neighbours belong to the same one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

PATCHES, PATCH_POINTS, PATCH_SURFELS = 200, 64, 8
"""So many patches are looked at, each of so many points and surfels at least: of 64 points with normal noise the groups
below hold 0.66 of the variance, give or take 0.03."""

GROUPED = 0.85
"""Share of the heights' variance that lies between two groups from which they are layers: 0.64 of normal noise, 0.75 of
noise that is spread evenly, as rounded depths are, 0.81 of waves; of layers from 4.8 standard deviations of their noise
apart."""

LEAST_GROUP = 0.15
"""A smaller share of a patch is its edge, or strays, and no layer."""

TOGETHER, DIRECTIONS = 0.5, 4
"""Correlation of the groups of nearest neighbours, in one of so many directions, from which they are relief: within 0.3
of 0 in layers, 0.7 and more along ripples and steps."""

MIN_SHARE = 0.02
"""Of the patches of scans without layers, up to 0.003 look like layers, at rims and fillets."""

FARTHEST_CELLS = 1.0
"""Layers farther apart than so many surfels are surfaces of their own, such as the two sides of a sheet."""

LARGE = 0.9
"""Quantile of the patches' heights between the layers that stands for their misfit: along a surface it does not
show."""


@dataclass(frozen=True)
class Layers:
    """How far a scan's two layers lie ``apart_mm``, and on what ``share`` of it."""

    apart_mm: float
    share: float

    def __str__(self) -> str:
        return f"two layers up to {self.apart_mm:.2g} mm apart on {self.share:.0%} of the surface"


def find_layers(scan: Scan) -> Layers | None:
    """The two layers that a scan shows of its surface; None where it shows one."""
    size = max(PATCH_POINTS, PATCH_SURFELS * len(scan.points) // len(scan.surfels))
    if len(scan.points) < size:
        return None
    starts = np.unique(np.linspace(0, len(scan.points) - size, PATCHES).astype(int))
    patches = scan.points[starts[:, None] + np.arange(size)]  # neighbours in space stand near one another
    plan, heights = _over_quadrics(patches)
    grouped, apart, upper = _groups(heights)
    chosen = np.flatnonzero((grouped > GROUPED) & (apart < FARTHEST_CELLS * scan.surfels.grid.size_mm))
    chosen = np.array([k for k in chosen if _togetherness(plan[k], upper[k]) < TOGETHER], dtype=int)
    share = len(chosen) / len(patches)
    return Layers(float(np.quantile(apart[chosen], LARGE)), share) if share >= MIN_SHARE else None


def _over_quadrics(patches: Floats) -> tuple[Floats, Floats]:
    """Places (K, n, 2) in the planes of patches (K, n, 3), and heights (K, n) over the quadrics through them."""
    patches = patches - patches.mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(patches.transpose(0, 2, 1) @ patches)
    along = patches @ axes
    heights, plan = along[:, :, 0], along[:, :, 1:]
    u, v = np.moveaxis(plan / (plan.std(axis=1, keepdims=True) + 1e-300), -1, 0)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    across = terms.transpose(0, 2, 1)
    fitted = np.linalg.pinv(across @ terms, rcond=1e-9, hermitian=True) @ (across @ heights[:, :, None])
    return plan, heights - (terms @ fitted)[:, :, 0]


def _groups(heights: Floats) -> tuple[Floats, Floats, Flags]:
    """The two groups into which heights (K, n) fall best: the share (K,) of their variance between the groups, how far
    (K,) the groups lie apart, and which (K, n) are of the upper one."""
    count = heights.shape[1]
    ordered = np.sort(heights, axis=1)
    low = np.arange(1, count)
    sums = np.cumsum(ordered, axis=1)[:, :-1]
    total = ordered.sum(axis=1, keepdims=True)
    apart = (total - sums) / (count - low) - sums / low
    between = low * (count - low) * apart**2 / count**2
    between[:, (low < LEAST_GROUP * count) | (low > (1 - LEAST_GROUP) * count)] = 0.0
    rows, best = np.arange(len(heights)), between.argmax(axis=1)
    share = between[rows, best] / np.maximum(heights.var(axis=1), 1e-300)
    return share, apart[rows, best], heights > ordered[rows, best][:, None]


def _togetherness(plan: Floats, upper: Flags) -> float:
    """Correlation of the groups of places (n, 2) with those of their nearest neighbours, the largest of all directions:
    ripples are alike along themselves."""
    ways = plan[:, None] - plan
    squares = (ways**2).sum(axis=-1)
    np.fill_diagonal(squares, np.inf)
    sectors = (np.arctan2(ways[..., 1], ways[..., 0]) % np.pi * (DIRECTIONS / np.pi)).astype(int)
    signs = (upper - upper.mean()) / max(float(upper.std()), 1e-300)
    correlations = []
    for sector in range(DIRECTIONS):
        seen = np.where(sectors == sector, squares, np.inf)
        beside = np.isfinite(seen.min(axis=1))
        if beside.any():
            correlations.append(float((signs * signs[seen.argmin(axis=1)])[beside].mean()))
    return max(correlations)
