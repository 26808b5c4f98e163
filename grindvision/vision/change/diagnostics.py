"""Mistakes that two scans give away by themselves: other units or scale, a mirror image, swapped roles, no overlap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, GrindvisionError, InputError, UnitError
from grindvision.geometry import inverse, move_points, rotate_vectors, rotation_about
from grindvision.geometry.hash_grid import bounds
from grindvision.vision.change.change_detection import Difference, find_difference
from grindvision.vision.registration.deformable import block_covariance
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.verification import VerifiedPose
from grindvision.vision.surface.scan import Scan
from grindvision.vision.surface.signed_distance import signed_distances
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]

#: Registrations of less than this share of the test scan may be chance.
LEAST_OVERLAP = 0.35

#: Two sound scanners agree on a length to about a thousandth; this is four times as much.
MOST_SCALE = 0.004

#: Share of what a change of scale does to the heights that no motion could do as well; below, as on three faces of a
#: box, which look the same at any scale, nothing can be said of it.
LEAST_SCALE_SHARE = 0.02

#: Only a mirror image that fits with this confidence is no chance: nearly flat parts fit their mirror image anyhow.
SURE = 0.5

#: Where a plane takes up more of both scans than this, the rest has a fifth of the cells: too few for a narrow bead.
#: Above the second share there is no part beside it.
MOST_PLANE, ONLY_PLANE = 0.8, 0.99

#: Of the plane's patches the directions agree within this angle; planes are tried through so many patches.
PLANE_COSINE, PLANES_TRIED = np.cos(np.radians(15)), 100

#: Scans whose extents differ by more than this factor do not show the same part in the same unit.
MOST_TIMES_LARGER = 5.0


def check_same_unit(sample: Floats, test: Floats) -> None:
    """Refuse two scans (N, 3) and (M, 3) of which one is so much larger that its numbers have another unit.

    Raises:
        UnitError: the diagonals differ by more than ``MOST_TIMES_LARGER``.
    """
    sizes = [float(np.linalg.norm(np.subtract(*bounds(points)))) for points in (sample, test)]
    if max(sizes) > MOST_TIMES_LARGER * min(sizes) > 0:
        raise UnitError(
            f"the sample is {sizes[0]:.4g} mm across, the test {sizes[1]:.4g} mm: one of the files has another unit, or"
            " shows more than the part; export both in one unit, cropped to the part"
        )


def table_doubt(sample: Surfels, test: Surfels) -> str:
    """In words, that the scans show a table more than the part; empty where they do not. Coarse surfels of each."""
    shares = [plane_share(surfels) for surfels in (sample, test)]
    if min(shares) < MOST_PLANE or max(shares) > ONLY_PLANE:
        return ""
    return (
        f"one plane takes up {shares[0]:.0%} of the sample and {shares[1]:.0%} of the test scan; if it is a table, crop"
        " it away in both: what is left for the part is too coarse to show every bead, and the pose follows the table"
    )


def plane_share(surfels: Surfels) -> float:
    """Share of the surface that lies in one plane, to a tenth of the cell size and roughness."""
    points, normals = surfels.points, surfels.normals
    within = 0.1 * surfels.grid.size_mm + 3 * float(np.median(surfels.noise_mm))

    def in_plane(place: Floats, up: Floats) -> NDArray[np.bool_]:
        return (np.abs((points - place) @ up) < within) & (np.abs(normals @ up) > PLANE_COSINE)

    tried = np.random.default_rng(0).permutation(len(points))[:PLANES_TRIED]
    best = max((in_plane(points[at], normals[at]) for at in tried), key=np.count_nonzero)
    for _ in range(3):  # a patch's own direction is too poor far away from it
        if best.sum() < 3:
            break
        place = points[best].mean(axis=0)
        best = in_plane(place, np.linalg.svd(points[best] - place, full_matrices=False)[2][2])
    return float(best.mean())


def mirrored_refusal(
    test: Floats,
    viewpoint_mm: ArrayLike | None,
    register: Callable[[Floats, ArrayLike | None], tuple[Scan, Scan, VerifiedPose]],
    refusal: DegenerateError,
) -> GrindvisionError:
    """The reason for a refused registration: ``refusal`` itself, or that ``test`` (M, 3) fits as its mirror image.

    Args:
        register: registers a test scan seen from a viewpoint and returns the pose last; raises ``DegenerateError``
            where it does not fit.
    """
    mirror = np.array([1.0, -1.0, 1.0])
    try:
        *_, pose = register(test * mirror, None if viewpoint_mm is None else viewpoint_mm * mirror)
    except DegenerateError:
        return refusal
    if pose.confidence < SURE:
        return refusal
    return InputError(
        "the test scan fits the sample only as its mirror image: one of the two was exported left-handed (two axes"
        " swapped, or one with the wrong sign); export it again; or do they show a symmetric part from its two sides?"
    )


def doubts(sample: Scan, test: Scan, registration: FineRegistration, difference: Difference) -> tuple[str, ...]:
    """What speaks against a comparison that came to an end, one sentence each; ``registration`` is T_sample_test."""
    found = [table] if (table := table_doubt(sample.voxels, test.voxels)) else []
    if registration.overlap < LEAST_OVERLAP:
        found.append(
            f"only {registration.overlap:.0%} of the test scan lies on the sample: the rest was compared with nothing,"
            " and so little hardly fixes the pose; scan with more overlap"
        )
    scale, deviation = relative_scale(sample, test, registration)
    if abs(scale - 1) > max(MOST_SCALE, 5 * deviation):
        found.append(
            f"the test scan is {abs(scale - 1):.1%} {'larger' if scale > 1 else 'smaller'} than the sample: two"
            " scanners, an old calibration or a warm part; what stands out may be nothing else, so mend that first"
        )
    if not difference.clusters and (missing := _missing_material(sample, test, registration)):
        found.append(missing)
    return tuple(found)


def relative_scale(
    sample: Scan, test: Scan, registration: FineRegistration, surfels: int = 2000, steps: int = 12
) -> tuple[float, float]:
    """How many times larger the test scan is than the sample, and the standard deviation of that for errors
    that are alike over a quarter of the scan, as those of a scanner are; infinite where the surface does not tell.

    Point-to-plane steps for translation, rotation and scale from the registered pose, with Tukey's weights: beads do
    not count.
    """
    good, transform = sample.surfels, registration.T_target_source
    chosen = np.random.default_rng(0).permutation(len(test.surfels))[:surfels]
    places = move_points(transform, test.surfels.points[chosen])
    facing = rotate_vectors(transform, test.surfels.normals[chosen])
    scale, deviation = 1.0, np.inf
    for _ in range(steps):
        heights, normals, _ = signed_distances(good, places, 2 * good.grid.size_mm)
        shown = np.isfinite(heights) & ((facing * normals).sum(axis=1) > 0.7)
        if shown.sum() < 50:
            return 1.0, np.inf
        centre = places[shown].mean(axis=0)
        away, up, left = places[shown] - centre, normals[shown], -heights[shown]
        design = np.column_stack([up, np.cross(away, up), (away * up).sum(axis=1)])
        weights = np.ones(len(left))
        for _ in range(4):
            square = (design * weights[:, None]).T @ design
            change = np.linalg.lstsq(square, (design * weights[:, None]).T @ left, rcond=1e-12)[0]
            rest = left - design @ change
            spread = 1.4826 * float(np.median(np.abs(rest))) + 1e-9
            weights = np.clip(1 - (rest / (4.685 * spread)) ** 2, 0, None) ** 2
        motions, scaling = np.hsplit(design * np.sqrt(weights)[:, None], [6])
        alone = scaling - motions @ np.linalg.lstsq(motions, scaling)[0]
        if (alone**2).sum() < LEAST_SCALE_SHARE * (scaling**2).sum():
            return 1.0, np.inf
        scale *= 1 + change[6]
        deviation = float(np.sqrt(block_covariance(places[shown], design, rest, weights, square, across=4)[6, 6]))
        rotation = rotation_about(change[3:6], float(np.linalg.norm(change[3:6]))) if change[3:6].any() else np.eye(3)
        places = (1 + change[6]) * (places - centre) @ rotation.T + centre + change[:3]
        if abs(change[6]) < MOST_SCALE / 20:
            break
    return 1 / scale, deviation


def _missing_material(sample: Scan, test: Scan, registration: FineRegistration) -> str:
    """In words, where the sample stands out of the test part: material is missing, or the two scans were swapped.

    Empty where nothing does. ``registration`` is T_sample_test.
    """
    back = inverse(registration.T_target_source)
    rotation = np.kron(np.eye(2), back[:3, :3])
    backwards = replace(
        registration,
        T_target_source=back,
        covariance=rotation @ registration.covariance @ rotation.T,
        centre_mm=move_points(back, registration.centre_mm),
    )
    try:
        pieces = find_difference(test, sample, backwards).clusters
    except DegenerateError:
        return ""
    if not pieces:
        return ""
    return (
        f"nothing stands out of the good part, but in {len(pieces)} place(s) material is missing (the largest:"
        f" {pieces[0].area_mm2:.3g} mm2, {pieces[0].peak_mm:.2f} mm deep); if that is the bead, SAMPLE and TEST were"
        " swapped"
    )
