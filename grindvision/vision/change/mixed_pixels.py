"""Surface that lies along a scanner's lines of sight: pixels mixed across edges, or a picture that was smoothed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import inverse, move_points
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

COS_ALONG = 0.1
"""Cosine of the angle between normal and ray below which no scanner measures a surface: it is seen at more than 84
degrees."""

MIXED = 0.004
"""Fraction of such surfels from which a scan is said to hold mixed pixels: of scans without, it was 0 to 0.0005, of
those with up to 0.006 where one surface hides another; others show hardly any, and nothing is said."""

NEAR_CELLS = 4.0
"""Within so many cells of such surfels others are drawn aside as well."""


def along_the_rays(scan: Scan) -> Flags:
    """Which of a scan's surfels (N,) lie along the rays of its scanner; none where its place is not known."""
    if scan.viewpoint_mm is None or scan.sided:
        return np.zeros(len(scan.surfels), dtype=bool)
    rays, normals = scan.viewpoint_mm - scan.surfels.points, scan.surfels.normals
    cosines = np.abs((rays * normals).sum(axis=1)) / np.linalg.norm(rays, axis=1)
    # a surfel without a normal is that of a few points, as at any rim
    return np.asarray((cosines < COS_ALONG) & (np.abs(normals).sum(axis=1) > 0))


def diagnose_mixed_pixels(
    source: Scan, target: Scan, registration: FineRegistration, difference: Difference
) -> tuple[str, ...]:
    """In words, how much of the scans lies along the rays, and by how much they differ beside it."""
    along = [along_the_rays(scan) for scan in (source, target)]
    shares = [float(one.mean()) for one in along]
    named = [f"{share:.1%} of the {name}" for share, name in zip(shares, ("test scan", "sample"), strict=True)
             if share > MIXED]  # fmt: skip
    if not named:
        return ()
    back = inverse(registration.T_target_source)
    places = np.concatenate([source.surfels.points[along[0]], move_points(back, target.surfels.points[along[1]])])
    reach = NEAR_CELLS * difference.cell_mm
    at, _ = nearest(build_cells(places, reach), difference.surfels, reach)
    beside = np.abs(difference.signed_mm[(at >= 0) & difference.comparable])
    size = f", and beside it the two differ by up to {np.quantile(beside, 0.95):.2g} mm (95 %)" if len(beside) else ""
    return (
        f"{' and '.join(named)} lies along the lines of sight, where no scanner sees a surface: pixels mixed across"
        f" edges, or a depth picture that was smoothed{size}; pose and edges are wrong by some of that, and what stands"
        " out at edges may be nothing else: export without smoothing and with the edge filter on",
    )
