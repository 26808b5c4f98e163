"""Surface that lies along a scanner's lines of sight: pixels mixed across edges, or a picture that was smoothed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import inverse, move_points
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.range_picture import is_one_picture
from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

COS_ALONG = 0.1
"""Cosine of the angle between normal and ray below which no scanner measures a surface: it is seen at more than 84
degrees."""

MIXED = 0.001
"""Fraction of such surfels from which a picture is said to hold mixed pixels: of scans without, it was 0 to 0.0005, of
those with up to 0.006 where one surface hides another; others show hardly any, and nothing is said."""

OTHERWISE = 0.004
"""The same of a cloud that is no single picture: echoes and rims of other views leave a few anywhere."""

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
    """In words, how much of the scans lies along the rays, and by how much they differ beside it.

    What lies there as thinly as the pixels of one picture do was mixed; more of it was seen from elsewhere.
    """
    scans = source, target
    along = [along_the_rays(scan) for scan in scans]
    shares = [float(one.mean()) for one in along]
    picture = [
        scan.viewpoint_mm is None or is_one_picture(scan.surfels, scan.viewpoint_mm) if share > MIXED else True
        for scan, share in zip(scans, shares, strict=True)
    ]
    shown = [share > (MIXED if single else OTHERWISE) for share, single in zip(shares, picture, strict=True)]
    named = [f"{share:.1%} of the {name}" for share, name, told in
             zip(shares, ("test scan", "sample"), shown, strict=True) if told]  # fmt: skip
    if not named:
        return ()
    back = inverse(registration.T_target_source)
    places = np.concatenate([source.surfels.points[along[0]], move_points(back, target.surfels.points[along[1]])])
    reach = NEAR_CELLS * difference.cell_mm
    at, _ = nearest(build_cells(places, reach), difference.surfels, reach)
    beside = np.abs(difference.signed_mm[(at >= 0) & difference.comparable])
    size = f", and beside it the two differ by up to {np.quantile(beside, 0.95):.2g} mm (95 %)" if len(beside) else ""
    said = f"{' and '.join(named)} lies along the lines of sight"
    if all(single for single, told in zip(picture, shown, strict=True) if told):
        return (
            f"{said}, where no scanner sees a surface: pixels mixed across edges, or a depth picture that was"
            f" smoothed{size}; pose and edges are wrong by some of that, and what stands out at edges may be nothing"
            " else: export without smoothing and with the edge filter on",
        )
    return (
        f"{said}, where no scanner sees a surface, and more densely than in one picture: pixels mixed across edges, or"
        f" echoes; or several views in one cloud, or a frame that is not the scanner's{size}; what stands out at edges"
        " may be nothing else, and what hides what is judged from a wrong place: export with the edge filter on, each"
        " scan in its scanner's own frame",
    )
